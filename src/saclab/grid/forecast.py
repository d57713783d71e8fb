"""How long a grid will take, from a few measured updates of each kind of run on this machine."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

from saclab.config import Config
from saclab.environments.foreign import prints_apart
from saclab.errors import TrainingFailed
from saclab.exits import end_after
from saclab.grid.plan import Cell
from saclab.grid.tasks import make_statuses, make_tasks
from saclab.limits import LARGEST_COUNT
from saclab.machine import thread_limits
from saclab.signals import die_with, how_it_ended

if TYPE_CHECKING:
    from saclab.training.engine import Engine, EngineBuilder

WARM_UPDATES, MEASURED_UPDATES = 5, 40


class Cost(NamedTuple):
    """Seconds, measured."""

    per_update: float
    """One update, with the environment steps that belong to it."""
    per_step: float
    """One environment step alone."""


class Kind(NamedTuple):
    """What is measured: a run alone, or a run group."""

    configs: tuple[Config, ...]
    slots: int
    """Room of the run group's program; 0 for a run alone."""
    workers: int
    """Processes that step the environments of a run group."""


def forecast_hours(cells: Sequence[Cell], workers: int, threads: int, batch: int = 0) -> float:
    """Hours until every unfinished cell is at its limits, if all goes on as a few updates of each kind did.

    Args:
        cells: the grid.
        workers: as `launch.launch` takes it.
        threads: as `launch.launch` takes it.
        batch: as `launch.launch` takes it.

    Raises:
        UserError: if an environment cannot be made.
    """
    tasks = make_tasks(make_statuses(cells), batch)
    kinds: dict[object, Kind] = {}
    names = []
    for task in tasks:
        configs = tuple(run.cell.config for run in task.runs)
        names.append((configs[0].environment, task.slots, *sorted({config.variant for config in configs})))
        kinds.setdefault(names[-1], Kind(configs, task.slots, workers))
    costs = dict(zip(kinds, measure_in_process([*kinds.values()], threads), strict=True))
    seconds = [
        max(run_seconds(run.cell.config, costs[name]) for run in task.runs)
        for task, name in zip(tasks, names, strict=True)
    ]
    longest = max(seconds, default=0.0)
    return max(sum(seconds) / (1 if batch else workers), longest) / 3600


def run_seconds(config: Config, cost: Cost) -> float:
    """Seconds of a run that goes to its nearest limit of steps or updates, its evaluations counted in."""
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
        # evaluation episodes are about as long as training episodes, so their number says how many steps they cost
        evaluated = steps * training.evaluation_episodes / training.evaluation_interval_episodes
    else:
        assert training.evaluation_interval_steps is not None
        evaluated = steps / training.evaluation_interval_steps * training.evaluation_episodes * 1000
    return updates * cost.per_update + (training.random_steps + evaluated) * cost.per_step


def measure_in_process(kinds: Sequence[Kind], threads: int) -> list[Cost]:
    """Measure each kind one after the other, in a process with as many threads as a worker has.

    Raises:
        TrainingFailed: if that process ends without an answer.
    """
    described = [([config.to_dict() for config in kind.configs], kind.slots, kind.workers) for kind in kinds]
    process = subprocess.run(
        [sys.executable, "-m", "saclab.grid.forecast"],
        input=json.dumps({"parent": os.getpid(), "kinds": described}),
        capture_output=True,
        text=True,
        errors="replace",  # an environment may print anything
        env=os.environ | thread_limits(threads),
        start_new_session=True,  # Ctrl-C is for this process, and that one dies with it
    )
    if process.returncode:
        raise TrainingFailed(f"no forecast ({how_it_ended(process.returncode, process.stderr)})")
    return [Cost(*values) for values in json.loads(process.stdout)]


def measure(kind: Kind) -> Cost:
    """Train for a moment: nothing is written. In a run group, an update is one of all its runs."""
    from saclab.training.engine import build_new
    from saclab.training.process import prepare_process

    prepare_process()
    with closing(build_new(builder_of(kind))) as engine:
        run = engine.runs[0]
        counters, random_steps = run.counters, run.config.training.random_steps
        began = time.perf_counter()
        while counters.steps < random_steps:
            step(engine)
        per_step = (time.perf_counter() - began) / counters.steps
        go_on(engine, WARM_UPDATES)
        engine.actor(0)  # waits for the updates
        began, first = time.perf_counter(), counters.updates
        go_on(engine, first + MEASURED_UPDATES)
        engine.actor(0)
        return Cost((time.perf_counter() - began) / (counters.updates - first), per_step)


def go_on(engine: Engine, updates: int) -> None:
    """Step until so many updates are made: not until the end of a round, which may have a hundred thousand."""
    run = engine.runs[0]

    def enough() -> bool:
        return run.counters.updates >= updates

    while not enough():
        if run.updates_left > 0:
            engine.make_updates(enough)
        else:
            step(engine, enough)


def step(engine: Engine, should_pause: Callable[[], bool] = lambda: False) -> None:
    """One step; raises RunBroken if it ends a run, which would never come to its updates."""
    for broken in engine.step(should_pause).broken.values():
        raise broken.error


def builder_of(kind: Kind) -> EngineBuilder:
    """The builder of the engine that would train these runs."""
    from saclab.batch.builder import DeviceBuilder
    from saclab.training.local_engine import LocalBuilder

    configs = [endless(config) for config in kind.configs]
    return DeviceBuilder(configs, kind.slots, kind.workers) if kind.slots else LocalBuilder(configs[0])


def endless(config: Config) -> Config:
    """The same run with the shortest random phase and no end."""
    training = dataclasses.replace(
        config.training, random_steps=config.algorithm.batch_size, max_updates=None, max_steps=LARGEST_COUNT
    )
    return dataclasses.replace(config, training=training)


def main() -> int:
    """Measure what standard input says; the exit status."""
    task = json.load(sys.stdin)
    die_with(task["parent"])
    kinds = [
        Kind(tuple(Config.from_dict(config) for config in configs), slots, workers)
        for configs, slots, workers in task["kinds"]
    ]
    with prints_apart() as answers:
        try:
            os.write(answers, json.dumps([measure(kind) for kind in kinds]).encode())
        except Exception as error:
            status, line = end_after(error)
            print(line, file=sys.stderr)
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
