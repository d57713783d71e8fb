"""Is this checkout as fast as another one? Both by turns; the ratio of their medians.

    git worktree add /tmp/before COMMIT
    python benchmarks/against.py /tmp/before --rounds 5

Both use the packages of this environment. Plain SAC at one update per five environment steps, alone and one process
per core; what it finds is kept in benchmarks/results/against.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from speed import CASES, HERE, facts, run

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
                rates[name].append(run(case, command)["updates_per_second"])
            ratio = statistics.median(rates["this"]) / statistics.median(rates["other"])
            print(f"round {turn + 1}/{options.rounds}  {case.name}: {ratio:.3f} of the other's speed", flush=True)
            record["cases"][case.name]["ratio"] = ratio
            options.results.write_text(json.dumps(record, indent=1) + "\n")


def commit(root: Path) -> str:
    asked = ["git", "-C", str(root), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
