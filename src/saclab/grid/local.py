"""Workers on this machine: a process per task, one core each by default."""

from __future__ import annotations

import os
import selectors
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from saclab.grid.pool import POLL_SECONDS, End, Report, WorkerPool
from saclab.grid.tasks import Task
from saclab.grid.worker_process import WorkerProcess
from saclab.machine import thread_limits, usable_cores
from saclab.trackers.asked import NOWHERE, Tracking


@contextmanager
def local_pool(
    workers: int, threads: int, checkpoint_minutes: float = 10, batch: int = 0, tracking: Tracking = NOWHERE
) -> Iterator[WorkerPool]:
    """A pool of local processes.

    Args:
        workers: tasks at a time; of a run group, which has the machine to itself, the processes that step environments.
        threads: cores that XLA uses in each worker.
        checkpoint_minutes: wall-clock time between checkpoints.
        batch: how many runs make a run group; 0 if each is trained alone.
        tracking: where the runs' numbers are sent.
    """
    with selectors.DefaultSelector() as selector:
        pool = LocalPool(selector, 1 if batch else workers, workers, threads, checkpoint_minutes, tracking)
        try:
            yield pool
        finally:
            pool.close()


class Worker(NamedTuple):
    """A task, the process that trains it, and the cores that it keeps to."""

    task: Task
    process: WorkerProcess
    cores: list[int]


class LocalPool:
    """The worker processes of this machine; see `WorkerPool`."""

    replaces_lost = False  # who kills a process here means the run
    note = None

    def __init__(
        self,
        selector: selectors.BaseSelector,
        places: int,
        environment_workers: int,
        threads: int,
        minutes: float,
        tracking: Tracking,
    ) -> None:
        self.selector, self.places = selector, places
        self.environment_workers, self.threads = environment_workers, threads
        self.checkpoint_minutes, self.tracking = minutes, tracking
        self.free_cores = core_groups(places, threads)
        self.workers: dict[int, Worker] = {}
        """File descriptor of what a worker says -> the worker."""

    def start(self, task: Task) -> bool:
        cores = self.free_cores.pop(0) if self.free_cores else []  # none is left by those that hang
        told = task.to_dict(self.checkpoint_minutes, self.tracking, cores, self.environment_workers)
        try:
            process = WorkerProcess(told, thread_limits(self.threads))
        except OSError:
            self.free_cores.insert(0, cores)
            raise
        self.workers[process.output.fileno()] = Worker(task, process, cores)
        self.selector.register(process.output, selectors.EVENT_READ)
        return True

    def poll(self) -> list[Report]:
        reports = []
        for key, _ in self.selector.select(POLL_SECONDS):
            task, process, cores = self.workers[key.fd]
            messages, end = process.read(), None
            if process.silent:
                self.selector.unregister(process.output)
                del self.workers[key.fd]
                self.free_cores.append(cores)
                end = End(*process.ended())
            reports.append(Report(task, messages, end))
        return reports

    def stop(self, task: Task) -> bool:
        for worker in self.workers.values():
            if worker.task is task:
                worker.process.stop()
        return True

    def close(self) -> None:
        """Tell all that still train to save and stop, and wait until they have."""
        for worker in self.workers.values():
            worker.process.stop()
        for worker in self.workers.values():
            worker.process.finish()


def core_groups(workers: int, threads: int) -> list[list[int]]:
    """The cores that each worker keeps to; empty lists leave them to the system.

    Only workers that fill the machine are held to their cores: the process that steps the environments and XLA's
    thread then share one, and its cache. Fewer would meet those of another grid on the same cores.
    """
    cores = usable_cores()
    if len(cores) != workers * threads or not hasattr(os, "sched_setaffinity"):
        return [[] for _ in range(workers)]
    return [cores[first : first + threads] for first in range(0, len(cores), threads)]
