"""What each variant costs on HalfCheetah-v4, as a multiple of plain SAC at an update per environment step.

    NPROC=1 OPENBLAS_NUM_THREADS=1 taskset -c 0 python benchmarks/family.py

Each at its own batch, networks and update-to-data ratio, but for rows that have to be told something of the
environment. "Operations" are those of the matrix products. A step of the
environment is timed with its updates and their draws from replay, in blocks of `SECONDS`, all variants by turns; the
medians over the rounds.
"""

from __future__ import annotations

import statistics
import time

from keep import keep
from operations import update_operations

from saclab.protocols import make_config
from saclab.training.local_engine import LocalEngine
from saclab.training.process import prepare_process
from saclab.variants import VARIANTS

ROUNDS, SECONDS, ENVIRONMENT = 3, 2.0, "HalfCheetah-v4"


def prepared(variant: str) -> LocalEngine:
    """A run past its random steps and its compilation."""
    overrides = {"random_steps": 1024, "replay_capacity": 100_000}
    engine = LocalEngine.new(make_config(ENVIRONMENT, variant, "standard", overrides=overrides))
    while engine.run.counters.updates < 4:
        engine.step()
    return engine


def seconds_per_step(engine: LocalEngine) -> float:
    """Seconds of an environment step with its updates."""
    counters = engine.run.counters
    began, first = time.perf_counter(), counters.steps
    while time.perf_counter() - began < SECONDS:
        engine.step()
    engine.run.close_window()
    return (time.perf_counter() - began) / (counters.steps - first)


def operations_per_step(engine: LocalEngine) -> float:
    config = engine.run.config
    return config.training.update_to_data_ratio * update_operations(config.algorithm, engine.replay.layout)


def main() -> None:
    prepare_process()
    engines = {variant: prepared(variant) for variant, row in VARIANTS.items() if not row.needs}
    seconds: dict[str, list[float]] = {variant: [] for variant in engines}
    for _ in range(ROUNDS):
        for variant, engine in engines.items():
            seconds[variant].append(seconds_per_step(engine))
    operations = {variant: operations_per_step(engine) for variant, engine in engines.items()}
    keep("family", operations_per_step=operations, seconds_per_step=seconds)
    print("| variant | updates per step | ms per update | ms per step | cost | operations |\n|---|---|---|---|---|---|")
    for variant, values in seconds.items():
        ratio = engines[variant].run.config.training.update_to_data_ratio
        cost = statistics.median(value / base for value, base in zip(values, seconds["sac"], strict=True))
        median = 1000 * statistics.median(values)
        print(
            f"| {variant} | {ratio:g} | {median / ratio:.1f} | {median:.1f} | {cost:.2f}× "
            f"| {operations[variant] / operations['sac']:.2f}× |"
        )


if __name__ == "__main__":
    main()
