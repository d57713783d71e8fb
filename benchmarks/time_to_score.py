"""Seconds until a policy is good: what a user of a CPU waits for.

    python benchmarks/time_to_score.py HalfCheetah-v4 --peers .venv-peers/bin/python [--only 'sac-auto, fast' sac-auto]
    python benchmarks/time_to_score.py HalfCheetah-v4 --table

Each contestant trains from the start of its process until the mean return of an evaluation of five episodes, one every
5,000 environment steps, reaches the environment's highest score; start, evaluations, files and compilation (nothing is
compiled before) are counted in. One core each, as many side by side as there are cores; seed by seed, contestants in
turn. What is kept already is not run again, so the measurement can be stopped and go on; `--only` chooses
contestants. A run that never gets there ends after 200,000 steps, after 1,000,000 where an update follows every fifth
step ("1:5", and `fast` on Humanoid), so all make as many updates: by the costs of docs/variants/README.md some twenty
minutes of sac-auto on a core, three to six hours of tqc, xqc and droq.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "contestants"))
from keep import facts  # noqa: E402
from score_watch import ScoreJob  # noqa: E402

from saclab.machine import thread_limits, usable_cores  # noqa: E402
from saclab.protocols import make_config  # noqa: E402

SCORES = {"HalfCheetah-v4": (3000, 5000), "Humanoid-v4": (1000,)}
MOST_STEPS = 200_000
SMALL_BATCHES: dict[str, str | int | float] = {
    "batch_size": 64, "random_steps": 5_000,
    "actor_learning_rate": 2e-3, "critic_learning_rate": 2e-3, "temperature_learning_rate": 2e-3,
}  # fmt: skip
"""What `fast` is on HalfCheetah-v4, to be tried elsewhere."""
SACLAB: dict[str, dict[str, str | int | float]] = {
    "sac-auto, fast": {"variant": "sac-auto", "protocol": "fast"},
    "sac-auto": {"variant": "sac-auto", "protocol": "standard"},
    "sac-auto, 1:5": {"variant": "sac-auto", "protocol": "standard", "update_interval": 5},
    "sac-auto, small batches": {"variant": "sac-auto", "protocol": "standard", **SMALL_BATCHES},
    "sac-auto, small batches, 1:5": {
        "variant": "sac-auto", "protocol": "standard", **SMALL_BATCHES, "update_interval": 5,
    },
    "droq": {"variant": "droq", "protocol": "standard"},
    "tqc": {"variant": "tqc", "protocol": "standard"},
    "xqc": {"variant": "xqc", "protocol": "standard"},
}  # fmt: skip
PEER = "Stable-Baselines3 SAC"
Evaluations = list[tuple[float, int, float]]
"""Seconds, environment steps, mean return."""


class Race(NamedTuple):
    environment: str
    peers: Path | None
    kept: Path

    def known(self) -> dict[str, dict[str, Any]]:
        """Contestant -> seed -> its evaluations, and when and on what they were made."""
        return json.loads(self.kept.read_text())["contestants"] if self.kept.exists() else {}

    def keep(self, contestant: str, seed: int, evaluations: Evaluations) -> None:
        every = self.known()
        every.setdefault(contestant, {})[str(seed)] = facts() | {"evaluations": evaluations}
        self.kept.write_text(json.dumps({"contestants": every}) + "\n")

    def command(self, contestant: str) -> list[str]:
        if contestant == PEER:
            return [str(self.peers), str(HERE / "contestants" / "stable_baselines3_score.py")]
        return [sys.executable, str(HERE / "contestants" / "saclab_score.py")]

    def run(self, contestant: str, seed: int, core: int) -> Evaluations:
        settings = SACLAB.get(contestant, {})
        most_steps = MOST_STEPS * steps_per_update(self.environment, settings)
        with tempfile.TemporaryDirectory() as folder:
            job = ScoreJob(
                self.environment, seed, max(SCORES[self.environment]), most_steps, 5_000, 5, folder, time.time(),
                settings,
            )  # fmt: skip
            done = subprocess.run(
                [*self.command(contestant), job.to_json()], check=False, capture_output=True, text=True,
                env=os.environ | thread_limits(1) | {"XDG_CACHE_HOME": folder},
                preexec_fn=lambda: os.sched_setaffinity(0, [core]),
            )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{contestant}, seed {seed}, failed:\n{done.stderr[-3000:]}")
        return json.loads(done.stdout.splitlines()[-1])


def steps_per_update(environment: str, settings: dict[str, Any]) -> int:
    """Environment steps before each update of a contestant; one for the peer, whose default it is."""
    if not settings:
        return 1
    own = dict(settings)
    variant, protocol = own.pop("variant"), own.pop("protocol")
    return make_config(environment, variant, protocol, overrides=own).training.update_interval


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=SCORES)
    parser.add_argument("--peers", type=Path, help="Python of the environment that holds Stable-Baselines3")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", nargs="+", default=[*SACLAB, PEER], choices=[*SACLAB, PEER])
    parser.add_argument("--table", action="store_true", help="only print what is kept")
    options = parser.parse_args()
    race = Race(options.environment, options.peers, HERE / "results" / f"time-to-score-{options.environment}.json")
    if PEER in options.only and not options.table and options.peers is None:
        parser.error(
            f"{PEER} needs --peers, the Python of the environment that `make peers` sets up; or leave it out of --only"
        )
    if not options.table:
        run_all(race, [(name, seed) for seed in range(options.seeds) for name in options.only])
    print_table(race)


def run_all(race: Race, wanted: list[tuple[str, int]]) -> None:
    cores: queue.Queue[int] = queue.Queue()
    for core in usable_cores():
        cores.put(core)

    keeping = threading.Lock()

    def one(name: str, seed: int) -> None:
        core = cores.get()
        try:
            evaluations = race.run(name, seed, core)
        finally:
            cores.put(core)
        with keeping:
            race.keep(name, seed, evaluations)
        print(f"{name}, seed {seed}: {evaluations[-1]}", flush=True)

    known = race.known()
    missing = [(name, seed) for name, seed in wanted if str(seed) not in known.get(name, {})]
    with ThreadPoolExecutor(len(usable_cores())) as pool:
        for done in [pool.submit(one, *job) for job in missing]:
            done.result()


def reached(evaluations: Evaluations, score: float) -> tuple[float, int] | None:
    """Seconds and steps of the first evaluation that reaches the score."""
    return next(((seconds, steps) for seconds, steps, value in evaluations if value >= score), None)


def print_table(race: Race) -> None:
    scores = SCORES[race.environment]
    print("| contestant | " + " | ".join(f"seconds to {score} | steps" for score in scores) + " |")
    print("|---" * (1 + 2 * len(scores)) + "|")
    for name, seeds in race.known().items():
        print(f"| {name} | " + " | ".join(cell for score in scores for cell in cells(seeds, score)) + " |")


def cells(seeds: dict[str, Any], score: float) -> Iterator[str]:
    """The median over the seeds that reached it, and each seed's in brackets."""
    found = [reached(kept["evaluations"], score) for _, kept in sorted(seeds.items())]
    for place, unit in ((0, 1), (1, 1000)):
        values = [each[place] / unit for each in found if each]
        each = ", ".join("–" if hit is None else f"{hit[place] / unit:.0f}" for hit in found)
        middle = f"{statistics.median(values):.0f}" if len(values) == len(found) else "–"
        yield f"{middle} ({each})" if unit == 1 else f"{middle}k ({each})"


if __name__ == "__main__":
    main()
