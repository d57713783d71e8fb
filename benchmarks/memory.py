"""The peak of a run's memory, against its replay buffer and its parameters.

    python benchmarks/memory.py

Each row is a training in a process of its own whose replay buffer is filled to the end, with evaluations and a
checkpoint. "Constant" is the peak less 1.3 times the bytes of replay, parameters, moments and snapshots.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile

from keep import keep

ROWS = [
    ("HalfCheetah-v4", "sac", 1_000),
    ("HalfCheetah-v4", "sac", 200_000),
    ("HalfCheetah-v4", "averaged", 1_000_000),
    ("Humanoid-v4", "sac", 200_000),
    ("Humanoid-v4", "averaged", 400_000),
]

MEASURE = """
import json, resource, sys
from pathlib import Path
import jax, numpy as np
from saclab.protocols import make_config
from saclab.training.loop import train
from saclab.training.local_engine import LocalEngine
environment, variant, capacity, folder = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
config = make_config(environment, variant, "paper", overrides={
    "replay_capacity": capacity, "random_steps": 500, "evaluation_interval_episodes": None,
    "evaluation_interval_steps": 1000, "max_steps": 1500})
seen = {}
made = LocalEngine.__init__
def make(engine, *arguments):
    made(engine, *arguments)
    seen["engine"] = engine
LocalEngine.__init__ = make
for event in train(config, folder / "run"):
    if "filled" not in seen and seen["engine"].run.counters.updates > 10:
        seen["filled"] = True
        replay = seen["engine"].replay
        replay.rows[replay.added:] = 1.0  # as full as at the end of a long run, and so is the checkpoint
        replay.added = max(replay.added, replay.capacity)
engine = seen["engine"]
learner = sum(leaf.nbytes for leaf in jax.tree.leaves(engine.learner_state))
print(json.dumps([resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, engine.replay.rows.nbytes, learner]))
"""
MIB = 2**20


def main() -> None:
    print("| | replay, MiB | learner, MiB | peak, MiB | constant, MiB |\n|---|---|---|---|---|")
    kept = []
    for environment, variant, capacity in ROWS:
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [sys.executable, "-c", MEASURE, environment, variant, str(capacity), folder],
                stdout=subprocess.PIPE, check=True,
            )  # fmt: skip
        peak, replay, learner = (value / MIB for value in json.loads(done.stdout))
        constant = peak - 1.3 * (replay + learner)
        what = f"{environment}, {variant}, {capacity:,}"
        print(f"| {what} | {replay:.0f} | {learner:.0f} | {peak:.0f} | {constant:.0f} |", flush=True)
        kept.append({"what": what, "replay": replay, "learner": learner, "peak": peak, "constant": constant})
    keep("memory", mebibytes=kept)


if __name__ == "__main__":
    main()
