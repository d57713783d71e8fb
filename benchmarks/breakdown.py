"""Where the milliseconds of a training go, on one core: by part of the loop, and by kind of operation in the update.

    NPROC=1 OPENBLAS_NUM_THREADS=1 python benchmarks/breakdown.py HalfCheetah-v4 [--variant averaged] [--updates 500]

The parts of the loop are timed inside a real training under the paper's protocol, each without the parts that it
calls; what none of them holds is "everything else", so the rows add up to the whole. Waiting for the update is the
update's. Of an update, the matrix products are done once more alone, in one program; XLA's own profiler slows an update
by half, so it is not used here.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import mujoco
from keep import keep
from operations import matrix_products

from saclab.environments.vector import TrainingEnvironments
from saclab.protocols import make_config
from saclab.replay import ReplayBuffer
from saclab.training.evaluation import Evaluator
from saclab.training.events import UpdatesLogged
from saclab.training.local_engine import LocalEngine
from saclab.training.loop import train
from saclab.training.process import prepare_process

WARM_UPDATES = 100


class Clock:
    """Seconds by part; a part's time does not hold that of the parts inside it."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.inside: list[float] = []

    def timed(self, part: str, function: Callable[..., Any], wait: bool = False) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            self.inside.append(0.0)
            began = time.perf_counter()
            result = function(*arguments, **named)
            if wait:
                jax.block_until_ready(result)
            seconds = time.perf_counter() - began
            self.seconds[part] += seconds - self.inside.pop()
            if self.inside:
                self.inside[-1] += seconds
            return result

        return call


@contextmanager
def clocked() -> Iterator[Clock]:
    """Every part of the loop tells the clock."""
    clock = Clock()
    parts = [
        (LocalEngine, "_next_action", "acting"),
        (TrainingEnvironments, "step", "environment around the simulator"),
        (ReplayBuffer, "add", "replay: store"),
        (ReplayBuffer, "sample", "replay: draw"),
        (Evaluator, "run", "evaluations around the simulator"),
        (mujoco, "mj_step", "simulator"),
    ]
    with ExitStack() as stack:
        for owner, name, part in parts:
            stack.enter_context(mock.patch.object(owner, name, clock.timed(part, getattr(owner, name))))
        made = LocalEngine.__init__

        def make(engine: LocalEngine, *arguments: Any) -> None:
            made(engine, *arguments)
            engine.update = clock.timed("update", engine.update, wait=True)

        stack.enter_context(mock.patch.object(LocalEngine, "__init__", make))
        yield clock


def loop_breakdown(environment: str, variant: str, updates: int) -> dict[str, float]:
    """Milliseconds per update by part, and of the whole."""
    settings = {
        "random_steps": 1000, "max_updates": WARM_UPDATES + updates, "log_interval": WARM_UPDATES,
        "evaluation_interval_episodes": None, "evaluation_interval_steps": 2000, "evaluation_episodes": 4,
    }  # fmt: skip
    config = make_config(environment, variant, "paper", overrides=settings)
    start = 0.0
    with tempfile.TemporaryDirectory() as folder, clocked() as clock:
        for event in train(config, Path(folder) / "run"):
            match event:
                case UpdatesLogged(updates=made) if made == WARM_UPDATES:
                    clock.seconds.clear()
                    start = time.perf_counter()
                case UpdatesLogged(updates=made) if made == WARM_UPDATES + updates:
                    whole = time.perf_counter() - start
                    parts = dict(clock.seconds)
                    break
    parts["everything else: loop, logs, events"] = whole - sum(parts.values())
    return {part: 1000 * seconds / updates for part, seconds in [*parts.items(), ("whole", whole)]}


def update_breakdown(environment: str, variant: str, updates: int) -> dict[str, float]:
    """Milliseconds of one update: its matrix products done alone, calling XLA, and all that is left."""
    settings = {"random_steps": 1000, "replay_capacity": 10_000}
    engine = LocalEngine.new(make_config(environment, variant, "paper", overrides=settings))
    run = engine.run
    while run.counters.updates < WARM_UPDATES:
        engine.step()
    rows = engine.replay.sample(run.sampling, run.config.algorithm.batch_size)
    products = matrix_products(run.config.algorithm, engine.replay.layout)
    operands = [[jnp.ones(shape) for shape in product.shapes] for product in products]

    def given() -> tuple[Any, ...]:
        """What an update takes; it gives the state's memory away, so the state is never the same one."""
        return engine.numbers, engine.learner_state, rows, engine.context

    def update() -> None:
        engine.learner_state, metrics = engine.update(*given())
        metrics.block_until_ready()

    @jax.jit
    def all_products(operands: list[list[jax.Array]]) -> list[jax.Array]:
        return [product.multiply(*pair) for product, pair in zip(products, operands, strict=True)]

    nothing = jax.jit(lambda numbers, state, rows, context: (state, rows[0]))
    timed = {
        "whole": update,
        "matrix products": lambda: jax.block_until_ready(all_products(operands)),
        "calling XLA": lambda: jax.block_until_ready(nothing(*given())),
    }
    milliseconds = alternating(timed, updates)
    engine.close()
    parts = {name: milliseconds[name] for name in ("matrix products", "calling XLA")}
    parts["matrix products"] -= parts["calling XLA"]
    parts["everything else XLA does"] = milliseconds["whole"] - sum(parts.values())
    return {**parts, "whole": milliseconds["whole"]}


def alternating(timed: dict[str, Callable[[], object]], calls: int, rounds: int = 10) -> dict[str, float]:
    """Median milliseconds of each, in rounds that hold all of them."""
    times: dict[str, list[float]] = {name: [] for name in timed}
    for _ in range(rounds):
        for name, work in timed.items():
            work()
            began = time.perf_counter()
            for _ in range(calls // rounds):
                work()
            times[name].append(1000 * (time.perf_counter() - began) / (calls // rounds))
    return {name: statistics.median(values) for name, values in times.items()}


def show(title: str, parts: dict[str, float]) -> None:
    print(f"\n{title}")
    for part, milliseconds in sorted(parts.items(), key=lambda item: (item[0] == "whole", -item[1])):
        print(f"  {part:<42}{milliseconds:8.2f} ms {milliseconds / parts['whole']:6.0%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment")
    parser.add_argument("--variant", default="sac")
    parser.add_argument("--updates", type=int, default=400, help="a multiple of 100")
    options = parser.parse_args()
    prepare_process()
    what = f"{options.environment}, {options.variant}"
    loop = loop_breakdown(options.environment, options.variant, options.updates)
    show(f"{what}: per update, with its 5 environment steps and their share of the evaluations", loop)
    update = update_breakdown(options.environment, options.variant, options.updates)
    show(f"{what}: one update", update)
    keep(f"breakdown-{options.environment}-{options.variant}", loop_milliseconds=loop, update_milliseconds=update)


if __name__ == "__main__":
    main()
