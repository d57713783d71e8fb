"""Is this checkout as fast as another one? Both by turns; the ratio of their medians.

    git worktree add /tmp/before COMMIT
    python benchmarks/against.py /tmp/before --rounds 5

Both use the packages of this environment. Plain SAC at one update per five environment steps, in each place of the race
(speed.py); what it finds is kept in benchmarks/results/against.json. A run beside which other processes took more than
a tenth of a core is made again: a run on two cores falls to half its pace when one of them is taken.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from speed import CASES, HERE, Case, facts, run

SCRIPT = str(HERE / "contestants" / "saclab_run.py")
HOUSE = HERE.parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the root of the other checkout")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", default="1:5", help="cases whose name contains this")
    parser.add_argument("--results", type=Path, default=HERE / "results" / "against.json")
    options = parser.parse_args()
    roots = {"other": options.other.resolve(), "this": HOUSE}
    record: dict[str, Any] = {**facts(), "commits": {name: commit(root) for name, root in roots.items()}, "cases": {}}
    cases = [case for case in CASES if options.only in case.name]
    for turn in range(options.rounds):
        for case in cases:
            rates = record["cases"].setdefault(case.name, {name: [] for name in roots})
            for name, root in sorted(roots.items(), reverse=turn % 2 == 1):
                command = ["env", f"PYTHONPATH={root / 'src'}", sys.executable, SCRIPT]
                rates[name].append(undisturbed_rate(case, command))
            ratio = statistics.median(rates["this"]) / statistics.median(rates["other"])
            print(f"round {turn + 1}/{options.rounds}  {case.name}: {ratio:.3f} of the other's speed", flush=True)
            record["cases"][case.name]["ratio"] = ratio
            options.results.write_text(json.dumps(record, indent=1) + "\n")


def undisturbed_rate(case: Case, command: list[str], attempts: int = 5) -> float:
    """Updates per second of a run that had the machine to itself."""
    for _ in range(attempts):
        others_before, start = seconds_of_others(), time.perf_counter()
        rate: float = run(case, command)["updates_per_second"]
        others = (seconds_of_others() - others_before) / (time.perf_counter() - start)
        if others < 0.1:
            return rate
        print(f"  other processes took {others:.2f} cores: again", flush=True)
    raise SystemExit("this machine is not idle: stop what else runs on it")


def seconds_of_others() -> float:
    """CPU seconds since the start of the machine of all but the finished children of this process; Linux."""
    user, nice, system = (int(ticks) for ticks in Path("/proc/stat").read_text().split()[1:4])
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (user + nice + system) / os.sysconf("SC_CLK_TCK") - children.ru_utime - children.ru_stime


def commit(root: Path) -> str:
    asked = ["git", "-C", str(root), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
