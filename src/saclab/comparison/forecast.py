"""How long a grid will take, from a few measured updates of each kind of run on this machine."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from saclab.comparison.grid import Cell
from saclab.comparison.launch import thread_limits
from saclab.config import Config

WARM_UPDATES, MEASURED_UPDATES = 5, 40


class Cost(NamedTuple):
    """Seconds, measured."""

    per_update: float
    """With the environment steps that belong to it."""
    per_step: float
    """One environment step alone."""


def forecast_hours(cells: Sequence[Cell], workers: int, threads: int) -> float:
    """Hours until every unfinished cell is at its limits, if all goes on as a few updates of each kind did.

    Raises:
        UserError: if an environment cannot be made.
    """
    kinds: dict[tuple[str, str], Config] = {}
    unfinished = [cell.config for cell in cells if not cell.finished]
    for config in unfinished:
        kinds.setdefault((config.environment, config.variant), config)
    costs = dict(zip(kinds, measure_in_process([*kinds.values()], threads), strict=True))
    seconds = [run_seconds(config, costs[config.environment, config.variant]) for config in unfinished]
    longest = max(seconds, default=0.0)
    return max(sum(seconds) / workers, longest) / 3600


def run_seconds(config: Config, cost: Cost) -> float:
    """Seconds of a run that goes to its nearest limit of steps or updates, its tests counted in."""
    training = config.training
    limits = []
    if training.max_updates is not None:
        limits.append(training.random_steps + training.max_updates / training.update_to_data_ratio)
    if training.max_steps is not None:
        limits.append(training.max_steps)
    if training.max_episodes is not None:
        limits.append(training.random_steps + training.max_episodes * 1000)
    steps = min(limits)
    updates = training.updates_due(int(steps))
    if training.evaluation_interval_episodes is not None:
        # test episodes are about as long as training episodes, so their number says how many steps they cost
        tested = steps * training.evaluation_episodes / training.evaluation_interval_episodes
    else:
        assert training.evaluation_interval_steps is not None
        tested = steps / training.evaluation_interval_steps * training.evaluation_episodes * 1000
    return updates * cost.per_update + (training.random_steps + tested) * cost.per_step


def measure_in_process(configs: Sequence[Config], threads: int) -> list[Cost]:
    """Measure each configuration one after the other, in a process with as many threads as a worker has."""
    process = subprocess.run(
        [sys.executable, "-m", "saclab.comparison.forecast"],
        input=json.dumps([config.to_dict() for config in configs]).encode(),
        stdout=subprocess.PIPE,
        check=True,
        env=os.environ | thread_limits(threads),
    )
    return [Cost(*values) for values in json.loads(process.stdout)]


def measure(config: Config) -> Cost:
    """Train for a moment: nothing is written."""
    from saclab.training.process import prepare_process
    from saclab.training.run import Run

    prepare_process()
    random_steps = config.algorithm.batch_size
    without_end = dataclasses.replace(
        config.training, random_steps=random_steps, max_updates=None, max_steps=sys.maxsize
    )
    run = Run(dataclasses.replace(config, training=without_end))
    began = time.perf_counter()
    while run.counters.steps < random_steps:
        run.step()
    per_step = (time.perf_counter() - began) / run.counters.steps
    while run.counters.updates < WARM_UPDATES:
        run.step()
    run.learner_state.actor.block_until_ready()
    began, first = time.perf_counter(), run.counters.updates
    while run.counters.updates < first + MEASURED_UPDATES:
        run.step()
    run.learner_state.actor.block_until_ready()
    per_update = (time.perf_counter() - began) / (run.counters.updates - first)
    run.close()
    return Cost(per_update, per_step)


def main() -> None:
    configs: list[dict[str, Any]] = json.load(sys.stdin)
    print(json.dumps([measure(Config.from_dict(config)) for config in configs]))


if __name__ == "__main__":
    main()
