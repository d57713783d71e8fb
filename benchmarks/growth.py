"""How the cost of an update grows, on HalfCheetah-v4's sizes: with batch, width, snapshots, environments, replay size.

    NPROC=1 OPENBLAS_NUM_THREADS=1 python benchmarks/growth.py

One setting is changed at a time. "Operations" are those of the matrix products, as a multiple of the first row's: where
the cost grows less than they do, something else takes the time. An update is timed with its draw from a full replay
buffer and with the environment steps that belong to it (1:5). Medians of alternating rounds over all rows.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
from keep import keep
from operations import update_operations

from saclab.protocols import make_config
from saclab.training.process import prepare_process
from saclab.training.run import Run

ROUNDS, UPDATES = 5, 40
ROWS: list[tuple[str, dict[str, Any]]] = [
    ("plain SAC: batch 256, 2 × 256 units, replay of 2e5", {}),
    ("batch 64", {"batch_size": 64}),
    ("batch 1024", {"batch_size": 1024}),
    ("2 × 128 units", {"hidden_layers": (128, 128)}),
    ("2 × 512 units", {"hidden_layers": (512, 512)}),
    ("K = 5", {"snapshots": 5}),
    ("K = 10", {"snapshots": 10}),
    ("K = 20", {"snapshots": 20}),
    ("4 environments", {"parallel_environments": 4}),
    ("16 environments", {"parallel_environments": 16}),
    ("replay of 1e4", {"replay_capacity": 10_000}),
    ("replay of 1e6", {"replay_capacity": 1_000_000}),
]


def prepared(changes: dict[str, Any]) -> Run:
    """A run with a full replay buffer, past its random steps and its compilation."""
    run = Run(make_config("HalfCheetah-v4", "sac", "paper", overrides={"random_steps": 1024, **changes}))
    while run.counters.updates < 10:
        run.step()
    filled = run.replay.added
    rest = np.arange(filled, run.replay.capacity)
    run.replay.rows[rest] = run.replay.rows[rest % filled]
    run.replay.added = max(filled, run.replay.capacity)
    return run


def milliseconds_per_update(run: Run) -> float:
    began, first = time.perf_counter(), run.counters.updates
    while run.counters.updates < first + UPDATES:
        run.step()
    run.window_array()
    run.window = []
    return 1000 * (time.perf_counter() - began) / (run.counters.updates - first)


def main() -> None:
    prepare_process()
    runs = {name: prepared(changes) for name, changes in ROWS}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            times[name].append(milliseconds_per_update(run))
    operations = {name: update_operations(run.config.algorithm, run.replay.layout) for name, run in runs.items()}
    first = ROWS[0][0]
    keep("growth", operations=operations, milliseconds_per_update=times)
    print("| | operations | ms per update | cost |\n|---|---|---|---|")
    for name, values in times.items():
        cost = statistics.median(value / base for value, base in zip(values, times[first], strict=True))
        ratio = operations[name] / operations[first]
        print(f"| {name} | {ratio:.2f}× | {statistics.median(values):.2f} | {cost:.2f}× |", flush=True)


if __name__ == "__main__":
    main()
