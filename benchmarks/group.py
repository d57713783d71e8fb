"""What an update costs within a group of runs on a CPU: the same updates, their arrays laid out in four ways.

    python benchmarks/group.py HalfCheetah-v4 [--variant averaged] [--runs 16]

Milliseconds of an update of one run, medians over rounds that hold all ways, and what parts of it take done alone. None
has a replay buffer or an environment.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import cycle
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from breakdown import alternating
from keep import keep
from operations import matrix_products

from saclab.algorithm.scalars import unpack
from saclab.algorithm.types import Context, LearnerState
from saclab.config import Config
from saclab.machine import usable_cores
from saclab.protocols import make_config
from saclab.replay import RowLayout
from saclab.settings import structure
from saclab.training.learners import initial_learner, learner_of, numbers_of
from saclab.training.local_engine import LocalEngine
from saclab.training.process import compiled, prepare_process

ROUNDS = 10
STEP = np.int32(0)
"""At which every part of a variant is updated."""
Work = Callable[[], object]
Given = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Of a run: its plain numbers, rows f32[B, width], the weights and the scale of its rewards."""


class Ways:
    """Updates of as many runs as there are configs, each on a batch of its own."""

    def __init__(self, configs: list[Config], layout: RowLayout) -> None:
        self.runs = len(configs)
        self.learner = learner_of(structure(configs[0].algorithm), layout)
        self.layout = layout
        self.states = [initial_learner(config, layout) for config in configs]
        rows = np.random.default_rng(0).random((self.runs, configs[0].algorithm.batch_size, layout.width), np.float32)
        weights, scale = jnp.ones(layout.reward_terms), jnp.float32(1)
        self.given = [
            (jnp.asarray(numbers_of(config, layout)), jnp.asarray(own), weights, scale)
            for config, own in zip(configs, rows, strict=True)
        ]

    def one(self, step: jax.Array, given: Given, state: LearnerState) -> LearnerState:
        numbers, rows, weights, scale = given
        return self.learner.update(unpack(numbers), state, self.layout.unpack(rows), Context(step, weights, scale))

    def separate(self, states: list[LearnerState]) -> Work:
        """Runs by turns, each with arrays of its own."""
        states, turns, call = list(map(copied, states)), cycle(range(len(states))), compiled(self.one, donate_argnums=2)

        def work() -> None:
            run = next(turns)
            states[run] = jax.block_until_ready(call(STEP, self.given[run], states[run]))

        return work

    def together(self, mapped: Callable[[jax.Array, Given, LearnerState], LearnerState]) -> Work:
        """All runs in one call, each array one for all of them."""
        given, state = stacked(self.given), stacked(self.states)
        call = compiled(mapped, donate_argnums=2)

        def work() -> None:
            nonlocal state
            state = jax.block_until_ready(call(STEP, given, state))

        return work


def copied(tree: Any) -> Any:
    return jax.tree.map(jnp.copy, tree)


def stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def products(config: Config, layout: RowLayout, runs: int) -> Work:
    """The update's matrix products, of so many runs side by side."""
    found = matrix_products(config.algorithm, layout)
    operands = [[jnp.ones((runs, *shape)) for shape in product.shapes] for product in found]
    call = compiled(jax.vmap(lambda each: [one.multiply(*pair) for one, pair in zip(found, each, strict=True)]))
    return lambda: jax.block_until_ready(call(operands))


def milliseconds(ways: Ways, config: Config, layout: RowLayout) -> dict[str, float]:
    """Of one run's update, by the way in which it is made."""

    def in_turn(work: Callable[[jax.Array, Given, LearnerState], LearnerState]) -> Callable[..., LearnerState]:
        return lambda step, given, state: jax.lax.map(lambda each: work(step, *each), (given, state))

    of_one: dict[str, Work] = {
        "alone": ways.separate(ways.states[:1]),
        "by turns, arrays of their own": ways.separate(ways.states),
        "matrix products, alone": products(config, layout, 1),
    }
    of_all: dict[str, Work] = {
        "side by side, arrays for all (what a group does)": ways.together(jax.vmap(ways.one, in_axes=(None, 0, 0))),
        "one after the other, arrays for all": ways.together(in_turn(ways.one)),
        "copying a run's part of arrays for all, out and back": ways.together(
            in_turn(lambda _step, _given, state: jax.lax.optimization_barrier(state))
        ),
        "matrix products, side by side": products(config, layout, ways.runs),
    }

    def as_often(work: Work) -> Work:
        """For as many runs as the others."""

        def again() -> None:
            for _ in range(ways.runs):
                work()

        return again

    timed = {name: as_often(work) for name, work in of_one.items()} | of_all
    return {name: value / ways.runs for name, value in alternating(timed, 3 * ROUNDS, ROUNDS).items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment")
    parser.add_argument("--variant", default="averaged")
    parser.add_argument("--runs", type=int, default=16)
    options = parser.parse_args()
    prepare_process()
    small = {"replay_capacity": 10_000}
    configs = [
        make_config(options.environment, options.variant, "standard", seed, overrides=small)
        for seed in range(options.runs)
    ]
    engine = LocalEngine.new(configs[0])
    layout = engine.replay.layout
    engine.close()
    found = milliseconds(Ways(configs, layout), configs[0], layout)
    for name, value in found.items():
        print(f"  {name:<55}{value:8.2f} ms {1000 / value:8.0f} a second")
    name = f"group-{options.environment}-{options.variant}-{len(usable_cores())}-core"
    keep(name, runs=options.runs, milliseconds=found)


if __name__ == "__main__":
    main()
