"""Workers on a Ray cluster whose machines share the runs' folder.

Each task has an actor of its own. All that it does is to start the same worker process as a local grid and to pass on
what that says, so a run's bits are those that it has anywhere else. Ray starts nothing again by itself: a task whose
worker is lost is handed in anew by `saclab.grid.launch`, and goes on from its last checkpoint.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from saclab.grid.cluster import Cluster, connected, in_short, lacking_room
from saclab.grid.pool import POLL_SECONDS, End, Report, WorkerPool
from saclab.grid.tasks import Task
from saclab.grid.worker_process import WorkerProcess
from saclab.machine import thread_limits
from saclab.trackers.asked import NOWHERE, VARIABLES, WANDB_HERE, Tracking

PATIENCE = 90  # seconds; a machine that the cluster has lost needs a minute to notice and to end its workers
GPU_MEMORY = 0.75  # of a GPU, which JAX takes at its start; those that share one take it of their share
TOLD = ("JAX_", "XLA_", *VARIABLES)  # variables with which the user tells JAX, XLA and trackers what to do


@contextmanager
def ray_pool(
    cluster: Cluster,
    threads: int,
    checkpoint_minutes: float = 10,
    workers: int | None = None,
    tracking: Tracking = NOWHERE,
) -> Iterator[WorkerPool]:
    """A pool of workers on a cluster.

    Args:
        cluster: which one, and what each task is given there.
        threads: cores that XLA uses in each worker.
        checkpoint_minutes: wall-clock time between checkpoints.
        workers: tasks on the cluster at a time; None leaves it to the cluster's room.
        tracking: where the runs' numbers are sent.

    Raises:
        UserError: if Ray is not installed, the cluster does not answer, or one started here has too little for a task.
    """
    with connected(cluster) as ray:
        lack = lacking_room(ray, cluster)
        note = f"{lack}: it waits for one" if lack else None
        pool = RayPool(ray, cluster, threads, checkpoint_minutes, workers, note, tracking)
        try:
            yield pool
        finally:
            pool.close()


class Worker(NamedTuple):
    """A task that has been handed to the cluster."""

    task: Task
    actor: Any
    heard: bool = False
    """Whether it has answered yet; before, it waits for room."""


@dataclass
class RayPool:
    """The workers of a cluster; see `WorkerPool`."""

    ray: Any
    cluster: Cluster
    threads: int
    checkpoint_minutes: float
    places: int | None
    note: str | None
    tracking: Tracking
    replaces_lost: bool = True
    workers: dict[Any, Worker] = field(default_factory=dict)
    """Answer that is awaited -> the worker that gives it."""

    @cached_property
    def actor_type(self) -> Any:
        """What makes a worker process on the cluster, which Ray does not start again."""
        return self.ray.remote(WorkerProcess).options(
            num_cpus=self.cluster.cpus, num_gpus=self.cluster.gpus, max_restarts=0, max_task_retries=0
        )

    def start(self, task: Task) -> bool:
        variables = worker_variables(self.threads, self.cluster.gpus)
        for_environments = max(1, int(self.cluster.cpus))
        told = task.to_dict(self.checkpoint_minutes, self.tracking, workers=for_environments, patience=PATIENCE)
        self._ask(Worker(task, self.actor_type.remote(told, variables, str(Path.cwd()), dies_with_launcher=True)))
        return False

    def _ask(self, worker: Worker) -> None:
        self.workers[worker.actor.poll.remote(POLL_SECONDS)] = worker

    def poll(self) -> list[Report]:
        if not self.workers:
            return []
        answers, _ = self.ray.wait(list(self.workers), num_returns=len(self.workers), timeout=POLL_SECONDS)
        return [self._report(answer) for answer in answers]

    def _report(self, answer: Any) -> Report:
        worker = self.workers.pop(answer)
        try:
            told = self.ray.get(answer)
        except self.ray.exceptions.RayError as error:
            self.ray.kill(worker.actor)  # it may only have been out of reach
            return Report(worker.task, [], End(None, f"{type(error).__name__}: {in_short(error)}"))
        if told["code"] is None:
            self._ask(worker._replace(heard=True))
            return Report(worker.task, told["messages"])
        self.ray.kill(worker.actor)
        return Report(worker.task, told["messages"], End(told["code"], told["errors"]))

    def stop(self, task: Task) -> bool:
        answer, worker = next((answer, worker) for answer, worker in self.workers.items() if worker.task is task)
        if worker.heard:
            worker.actor.stop.remote()
        else:
            self.ray.kill(worker.actor)
            del self.workers[answer]
        return worker.heard

    def close(self) -> None:
        """Let those that train save and stop, and leave no actor behind."""
        for saved in [worker.actor.finish.remote() for worker in self.workers.values() if worker.heard]:
            with suppress(self.ray.exceptions.RayError):
                self.ray.get(saved)
        for worker in self.workers.values():
            self.ray.kill(worker.actor)


def worker_variables(threads: int, gpus: float) -> dict[str, str]:
    """Environment variables of a worker on any machine; where Ray has set one of them, this one counts.

    What the user has told JAX, XLA and trackers here holds there. A task that has reserved no GPU sees none; for the
    others Ray has named theirs in CUDA_VISIBLE_DEVICES.
    """
    share = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{GPU_MEMORY * gpus:.3f}"} if gpus < 1 else {}
    told = {name: value for name, value in os.environ.items() if name.startswith(TOLD) and name != WANDB_HERE}
    return ({"CUDA_VISIBLE_DEVICES": ""} if gpus == 0 else share) | told | thread_limits(threads)
