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
from saclab.training.local_engine import LocalEngine
from saclab.training.process import prepare_process

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


def prepared(changes: dict[str, Any]) -> LocalEngine:
    """A run with a full replay buffer, past its random steps and its compilation."""
    config = make_config("HalfCheetah-v4", "sac", "paper", overrides={"random_steps": 1024, **changes})
    engine = LocalEngine.new(config)
    while engine.run.counters.updates < 10:
        engine.step()
    replay = engine.replay
    filled = replay.added
    rest = np.arange(filled, replay.capacity)
    replay.rows[rest] = replay.rows[rest % filled]
    replay.added = max(filled, replay.capacity)
    return engine


def milliseconds_per_update(engine: LocalEngine) -> float:
    counters = engine.run.counters
    began, first = time.perf_counter(), counters.updates
    while counters.updates < first + UPDATES:
        engine.step()
    engine.run.close_window()
    return 1000 * (time.perf_counter() - began) / (counters.updates - first)


def main() -> None:
    prepare_process()
    engines = {name: prepared(changes) for name, changes in ROWS}
    times: dict[str, list[float]] = {name: [] for name in engines}
    for _ in range(ROUNDS):
        for name, engine in engines.items():
            times[name].append(milliseconds_per_update(engine))
    operations = {
        name: update_operations(engine.run.config.algorithm, engine.replay.layout) for name, engine in engines.items()
    }
    first = ROWS[0][0]
    keep("growth", operations=operations, milliseconds_per_update=times)
    print("| | operations | ms per update | cost |\n|---|---|---|---|")
    for name, values in times.items():
        cost = statistics.median(value / base for value, base in zip(values, times[first], strict=True))
        ratio = operations[name] / operations[first]
        print(f"| {name} | {ratio:.2f}× | {statistics.median(values):.2f} | {cost:.2f}× |", flush=True)


if __name__ == "__main__":
    main()
