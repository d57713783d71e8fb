"""Train the runs of a grid in local worker processes: one process per run, one core each by default."""

from __future__ import annotations

import os
import selectors
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from saclab.grid.plan import Cell
from saclab.grid.tasks import RunStatus, Task, make_statuses, make_tasks
from saclab.grid.worker_process import WorkerProcess
from saclab.machine import thread_limits, usable_cores
from saclab.training.requests import Requests

POLL_SECONDS = 0.25


def launch(
    cells: Sequence[Cell],
    workers: int,
    threads: int,
    requests: Requests,
    checkpoint_minutes: float = 10,
    batch: int = 0,
) -> Iterator[list[RunStatus]]:
    """Train every unfinished cell; yields all statuses several times a second.

    A failed run does not stop the others. When `requests.stop` is set, every worker saves its runs and stops; at the
    end no worker is left behind, however this generator ends.

    Args:
        cells: the runs of the grid.
        workers: runs at a time; of a batch, which has the machine to itself, the processes that step environments.
        threads: cores that XLA uses in each worker.
        requests: asks the grid to stop.
        checkpoint_minutes: wall-clock time between checkpoints.
        batch: how many runs of the same structure are trained as one batch; 0 for each run alone.
    """
    statuses = make_statuses(cells)
    waiting = make_tasks(statuses, batch)
    at_once = workers if batch == 0 else 1
    running: dict[int, Worker] = {}
    free_cores = core_groups(at_once, threads)
    stopping = False
    with selectors.DefaultSelector() as selector:
        try:
            while running or (waiting and not requests.stop):
                while waiting and len(running) < at_once and not requests.stop:
                    task, cores = waiting.pop(0), free_cores.pop(0)
                    task.start()
                    process = WorkerProcess(task.to_dict(checkpoint_minutes, cores, workers), thread_limits(threads))
                    running[process.output.fileno()] = Worker(task, process, cores)
                    selector.register(process.output, selectors.EVENT_READ)
                if requests.stop and not stopping:
                    stopping = True
                    for worker in running.values():
                        worker.process.stop()
                for key, _ in selector.select(POLL_SECONDS):
                    task, process, cores = running[key.fd]
                    for message in process.read():
                        task.enter(message)
                    if process.silent:
                        selector.unregister(process.output)
                        del running[key.fd]
                        free_cores.append(cores)
                        code, errors = process.ended()
                        task.ended(code, stopping, errors)
                yield statuses
        finally:
            for worker in running.values():
                worker.process.stop()
            for worker in running.values():
                worker.process.finish()
    yield statuses


class Worker(NamedTuple):
    """A task, the process that trains it, and the cores that it keeps to."""

    task: Task
    process: WorkerProcess
    cores: list[int]


def core_groups(workers: int, threads: int) -> list[list[int]]:
    """The cores that each worker keeps to; empty lists leave them to the system.

    Only workers that fill the machine are held to their cores: the process that steps the environments and XLA's
    thread then share one, and its cache. Fewer would meet those of another grid on the same cores.
    """
    cores = usable_cores()
    if len(cores) != workers * threads or not hasattr(os, "sched_setaffinity"):
        return [[] for _ in range(workers)]
    return [cores[first : first + threads] for first in range(0, len(cores), threads)]
