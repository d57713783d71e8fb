"""A race: saclab and its peers train the same job on this machine, in turn, and a table of the ratios.

    python benchmarks/speed.py --peers .venv-peers/bin/python [--rounds 3] [--only TEXT]

End to end: environment, replay, acting, updates, logging, evaluations and the best policy's file; each library by its
own loop, evaluations side by side in all of them, but for RLtools (contestants/rltools_run.py says what it leaves out).
Plain SAC with Table 1 of the paper. Every round runs all contestants of a case one after the other, so a ratio compares
neighbours in time; medians over rounds are reported. Imports, compilation and the first updates are outside the rate
and shown as the seconds from the start of the process to the first update.

A case is a single run that may use all cores, a single run on one core, or a grid: as many runs at once as there are
cores, one core each, whose rates are added. What each is compared with in the end is the machine: the time that the
update's matrix products and the raw simulator need (machine_limit.py, measured in the same round), the steps of
saclab's evaluations counted in.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "contestants"))
from keep import facts  # noqa: E402
from stopwatch import Job  # noqa: E402

from saclab.machine import thread_limits, usable_cores  # noqa: E402

SACLAB = {
    "saclab": (),
    "saclab, acting_delay 1": (("acting_delay", 1),),
    "saclab, averaged": (("variant", "averaged"),),
}
# Name -> script, and the word that tells it what to race with: a package, a BLAS.
PEERS = {
    "Stable-Baselines3": ("stable_baselines3_run.py", "stable-baselines3"),
    "SBX": ("stable_baselines3_run.py", "sbx-rl"),
    "Tianshou": ("tianshou_run.py", "tianshou"),
    "RLtools, MKL": ("rltools_run.py", "mkl"),
    "RLtools, OpenBLAS": ("rltools_run.py", "openblas"),
    "TorchRL": ("torchrl_run.py", "torchrl"),
}
RLTOOLS = ("RLtools, MKL", "RLtools, OpenBLAS")


@dataclass(frozen=True)
class Place:
    """Which cores a case may use, and who races there."""

    cores: Callable[[list[int]], list[list[int]]]
    """The machine's cores -> those of each process."""
    contestants: tuple[str, ...]


PLACES = {
    "single run": Place(lambda cores: [cores], (*SACLAB, *PEERS)),
    "one core": Place(lambda cores: [cores[:1]], ("saclab", "Stable-Baselines3", "SBX", *RLTOOLS)),
    "grid": Place(
        lambda cores: [[core] for core in cores],
        ("saclab", "saclab, averaged", "Stable-Baselines3", "SBX", *RLTOOLS),
    ),
}


@dataclass(frozen=True)
class Case:
    environment: str
    update_interval: int
    place: str
    """A key of PLACES."""
    timed_updates: int
    evaluation_interval_steps: int
    evaluation_episodes: int
    warm_updates: int = 100

    @property
    def name(self) -> str:
        return f"{self.environment}, 1:{self.update_interval}, {self.place}"

    def processes(self) -> list[list[int]]:
        """The cores of each process."""
        return PLACES[self.place].cores(usable_cores())


# Two evaluation steps per training step, as under `paper` with episodes of 1000 steps; windows of whole evaluations.
CASES = [
    Case(environment, interval, place, timed_updates, evaluation_interval, episodes)
    for interval, place, timed_updates, evaluation_interval, episodes in (
        (5, "single run", 400, 2000, 4), (5, "one core", 400, 2000, 4), (1, "one core", 500, 500, 1),
        (5, "grid", 400, 2000, 4),
    )
    for environment in ("HalfCheetah-v4", "Humanoid-v4")
]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, required=True, help="Python of the environment that holds the peers")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--results", type=Path, default=HERE / "results" / "speed.json")
    options = parser.parse_args()
    cases = [case for case in CASES if options.only in case.name]
    if not links_openblas():
        print("RLtools races with MKL only: there is no OpenBLAS to link (Debian: libopenblas-dev)", flush=True)
    record: dict[str, Any] = {**facts(), "cases": {}}
    for turn in range(options.rounds):
        for case in cases:
            entry = record["cases"].setdefault(case.name, {"rounds": []})
            entry["rounds"].append(race(case, options.peers))
            options.results.write_text(json.dumps(record, indent=1) + "\n")
            told = {name: round(result["updates_per_second"], 1) for name, result in entry["rounds"][-1].items()}
            print(f"round {turn + 1}/{options.rounds}  {case.name}: {told}", flush=True)


def links_openblas() -> bool:
    """Whether a program that asks for `-lblas`, as RLtools does, gets OpenBLAS."""
    try:
        return hasattr(ctypes.CDLL("libblas.so"), "openblas_get_config")
    except OSError:
        return False


def race(case: Case, peers: Path) -> dict[str, dict[str, Any]]:
    """One round: contestant -> its result; the entry `limit` is the machine's."""
    processes = in_processes(case, lambda _: [sys.executable, str(HERE / "machine_limit.py"), case.environment])
    results = {}
    for name in PLACES[case.place].contestants:
        if name == "RLtools, OpenBLAS" and not links_openblas():
            continue
        if name in SACLAB:
            results[name] = run(case, [sys.executable, str(HERE / "contestants" / "saclab_run.py")], SACLAB[name])
        else:
            script, package = PEERS[name]
            results[name] = run(case, [str(peers), str(HERE / "contestants" / script)], package=package)
    return {"limit": limit(case, processes, results["saclab"]["test_steps_per_step"]), **results}


def limit(case: Case, processes: list[dict[str, Any]], evaluation_steps_per_step: float) -> dict[str, Any]:
    """Updates per second if nothing took time but the matrix products and the simulator."""
    rates = {}
    for variant in ("sac", "averaged"):
        seconds = [
            facts["update_operations"][variant] / facts["operations_per_second"]
            + case.update_interval * (1 + evaluation_steps_per_step) * facts["raw_step_seconds"]
            for facts in processes
        ]
        rates[variant] = sum(1 / each for each in seconds)
    return {"updates_per_second": rates["sac"], "averaged": rates["averaged"], "processes": processes}


def run(
    case: Case, command: list[str], settings: tuple[tuple[str, str | float], ...] = (), package: str | None = None
) -> dict[str, Any]:
    """The job of a case by one contestant; of a grid the rates and the memory are sums, the rest is the mean."""
    with tempfile.TemporaryDirectory() as folder:

        def full_command(number: int) -> list[str]:
            job = Job(
                case.environment, case.update_interval, case.warm_updates, case.timed_updates,
                case.evaluation_interval_steps, case.evaluation_episodes, f"{folder}/{number}", time.time(),
                settings=settings,
            )  # fmt: skip
            return [*command, job.to_json(), *([package] if package else [])]

        reports = in_processes(case, full_command)
    return {
        "updates_per_second": sum(report["updates_per_second"] for report in reports),
        "cpu_seconds_per_1000_updates": mean(1000 * r["cpu_seconds"] / r["updates"] for r in reports),
        "first_update_seconds": mean(report["first_update_seconds"] for report in reports),
        "peak_bytes": sum(report["peak_bytes"] for report in reports),
        "versions": reports[0]["versions"],
        "test_steps_per_step": reports[0].get("test_steps_per_step"),
    }


def in_processes(case: Case, command: Any) -> list[dict[str, Any]]:
    """What the command prints as its last line, from each process of the case, all at the same time."""
    places = case.processes()
    processes = [
        subprocess.Popen(
            command(number), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=os.environ | (thread_limits(1) if len(cores) == 1 else {}),
            preexec_fn=lambda cores=cores: os.sched_setaffinity(0, cores),
        )
        for number, cores in enumerate(places)
    ]  # fmt: skip
    reports = []
    for process in processes:
        output, errors = process.communicate()
        if process.returncode != 0:
            sys.exit(f"{process.args} failed:\n{errors[-3000:]}")
        reports.append(json.loads(output.splitlines()[-1]))
    return reports


def mean(values: Any) -> float:
    values = list(values)
    return float(sum(values) / len(values))


if __name__ == "__main__":
    main()
