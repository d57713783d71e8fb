"""Train the runs of a grid on a Ray cluster whose machines share the runs' folder.

Each task has an actor of its own. All that it does is to start the same worker process as the local launcher and to
pass on what that says, so a run's bits are those that it has anywhere else. Ray starts nothing again by itself: a task
whose worker is lost is handed in anew here, and goes on from its last checkpoint.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from saclab.config import require
from saclab.errors import UserError, unknown_name
from saclab.extras import required
from saclab.grid.launch import POLL_SECONDS
from saclab.grid.plan import Cell
from saclab.grid.tasks import RunStatus, Task, make_statuses, make_tasks
from saclab.grid.worker_process import WorkerProcess
from saclab.machine import thread_limits, usable_cores
from saclab.training.common_checkpoint import checkpoint_steps
from saclab.training.requests import Requests

LAUNCHERS = ("local", "ray")
LOSSES = 3  # of a run's worker without a new checkpoint in between; one more, and the run has failed
PATIENCE = 90  # seconds; a machine that the cluster has lost needs a minute to notice and to end its workers
ANSWER_SECONDS = 10
OBJECT_STORE_BYTES = 2**27  # of a cluster started here: only words pass through it
GPU_MEMORY = 0.75  # of a GPU, which JAX takes at its start; those that share one take it of their share
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_DEDUP_LOGS_SKIP_REGEX": "."}
"""No word to Ray's makers; none of Ray's in the user's terminal, where it would print a page for each lost worker."""
TOLD = ("JAX_", "XLA_")  # variables with which the user tells JAX and XLA what to do


@dataclass(frozen=True)
class Cluster:
    """Where a grid is trained, and what each of its tasks is given there."""

    address: str | None = None
    """Of the cluster; None for RAY_ADDRESS, else the one that runs on this machine, else one that is started."""
    cpus: float = 1
    """Cores that Ray sets aside for a task."""
    gpus: float = 0.0
    """GPUs, or the part of one; 0 trains on the cores."""

    def __post_init__(self) -> None:
        require(0 < self.cpus < inf, "ray_cpus", self.cpus, "use a number greater than 0")
        require(
            0 <= self.gpus <= 1 or (self.gpus < inf and self.gpus == int(self.gpus)),
            "ray_gpus", self.gpus, "use 0, a part of 1, or a whole number",
        )  # fmt: skip


def chosen_cluster(launcher: str, threads: int, address: str | None, cpus: float | None, gpus: float) -> Cluster | None:
    """The cluster that the settings of a comparison ask for; None for local workers.

    Raises:
        UserError: for an unknown launcher, or a value that cannot work.
    """
    if launcher not in LAUNCHERS:
        raise unknown_name("launcher", launcher, LAUNCHERS)
    if launcher == "ray":
        return Cluster(address, threads if cpus is None else cpus, gpus)
    for name, value in {"ray_address": address, "ray_cpus": cpus, "ray_gpus": gpus or None}.items():
        require(value is None, name, value, "it needs --launcher ray")
    return None


def launch(
    cells: Sequence[Cell],
    workers: int | None,
    threads: int,
    requests: Requests,
    checkpoint_minutes: float = 10,
    batch: int = 0,
    cluster: Cluster | None = None,
) -> Iterator[list[RunStatus]]:
    """As `saclab.grid.launch.launch`, on a Ray cluster.

    Args:
        cells: the runs of the grid; their folders are the same ones on all machines.
        workers: tasks on the cluster at a time; None leaves it to the cluster's room.
        threads: cores that XLA uses in each worker.
        requests: asks the grid to stop.
        checkpoint_minutes: wall-clock time between checkpoints.
        batch: how many runs of the same structure are trained as one batch; 0 for each run alone.
        cluster: which one; None for the first that is found, with a core per task.

    Raises:
        UserError: if Ray is not installed, the cluster does not answer, or one started here has too little for a task.
    """
    cluster = cluster or Cluster()
    statuses = make_statuses(cells)
    with connected(cluster) as ray:
        if lack := lacking_room(ray, cluster):
            for run in statuses:
                run.warnings += [f"{lack}: it waits for one"] if run.status == "waiting" else []
        grid = Grid(ray, cluster, make_tasks(statuses, batch), threads, checkpoint_minutes, batch)
        try:
            while grid.placed or (grid.waiting and not requests.stop):
                if requests.stop:
                    grid.stop()
                else:
                    grid.place(workers)
                grid.listen()
                yield statuses
        finally:
            grid.close()
    yield statuses


class Placed(NamedTuple):
    """A task that has been handed to the cluster."""

    task: Task
    actor: Any

    @property
    def started(self) -> bool:
        """Whether its worker has been heard of; before, it waits for room."""
        return self.task.runs[0].status != "waiting"


@dataclass
class Grid:
    """The tasks of a grid: those that wait here, and those that the cluster has been given."""

    ray: Any
    cluster: Cluster
    waiting: list[Task]
    threads: int
    checkpoint_minutes: float
    batch: int
    placed: dict[Any, Placed] = field(default_factory=dict)
    """By the answer that is awaited of each."""
    losses: dict[Path, tuple[int, int]] = field(default_factory=dict)
    """Run folder -> workers lost since its newest checkpoint, and that one's step."""
    stopping: bool = False

    @cached_property
    def actor_type(self) -> Any:
        """What makes a worker process on the cluster, which Ray does not start again."""
        return self.ray.remote(WorkerProcess).options(
            num_cpus=self.cluster.cpus, num_gpus=self.cluster.gpus, max_restarts=0, max_task_retries=0
        )

    def place(self, at_once: int | None) -> None:
        """Hand waiting tasks to the cluster."""
        variables = worker_variables(self.threads, self.cluster.gpus)
        for_environments = max(1, int(self.cluster.cpus))
        while self.waiting and (at_once is None or len(self.placed) < at_once):
            task = self.waiting.pop(0)
            told = task.to_dict(self.checkpoint_minutes, workers=for_environments, patience=PATIENCE)
            actor = self.actor_type.remote(told, variables, str(Path.cwd()), dies_with_launcher=True)
            self.placed[actor.poll.remote(POLL_SECONDS)] = Placed(task, actor)

    def listen(self) -> None:
        """Take in what the workers say, and how they end."""
        if not self.placed:
            return
        answers, _ = self.ray.wait(list(self.placed), num_returns=len(self.placed), timeout=POLL_SECONDS)
        for answer in answers:
            task, actor = placed = self.placed.pop(answer)
            try:
                told = self.ray.get(answer)
            except self.ray.exceptions.RayError as error:
                self._lost(placed, f"{type(error).__name__}: {in_short(error)}")
                continue
            if not placed.started:
                task.start()
            for message in told["messages"]:
                task.enter(message)
            if told["code"] is None:
                self.placed[actor.poll.remote(POLL_SECONDS)] = placed
            else:
                self._ended(placed, told["code"], told["errors"])

    def stop(self) -> None:
        """Let every worker save and stop, and take back the tasks that wait for room."""
        if self.stopping:
            return
        self.stopping = True
        for answer, placed in list(self.placed.items()):
            if placed.started:
                placed.actor.stop.remote()
            else:
                self.ray.kill(placed.actor)
                del self.placed[answer]

    def close(self) -> None:
        """Leave no worker behind, however the grid ends; those that train save first."""
        self.stop()
        for saved in [placed.actor.finish.remote() for placed in self.placed.values()]:
            with suppress(self.ray.exceptions.RayError):
                self.ray.get(saved)
        for placed in self.placed.values():
            self.ray.kill(placed.actor)

    def _ended(self, placed: Placed, code: int, errors: str) -> None:
        """A worker that somebody else than this grid has killed or told to stop is lost."""
        killed = code == -signal.SIGKILL
        if self.stopping or not killed:
            placed.task.ended(code, self.stopping, errors)
        if not self.stopping and any(run.status in ("running", "interrupted") for run in placed.task.runs):
            self._lost(placed, "it was killed" if killed else "it was told to stop")
        else:
            self.ray.kill(placed.actor)

    def _lost(self, placed: Placed, why: str) -> None:
        """The runs that have not ended wait for another worker."""
        self.ray.kill(placed.actor)  # it may only have been out of reach
        for run in placed.task.runs:
            if run.cell.finished:
                run.status, run.fraction = "finished", 1.0
            elif run.status == "running" and self.stopping:
                run.status = "interrupted"
            elif run.status != "failed" and not self.stopping:
                self._wait_again(run, why)
        self.waiting[:0] = make_tasks(placed.task.runs, self.batch)

    def _wait_again(self, run: RunStatus, why: str) -> None:
        """Or fail, if this has happened too often since the run got any further."""
        step = max(checkpoint_steps(run.cell.folder), default=0)
        before, last_step = self.losses.get(run.cell.folder, (0, step))
        losses = before + 1 if step == last_step else 1
        self.losses[run.cell.folder] = losses, step
        if losses > LOSSES:
            run.status = "failed"
            run.message = f"its worker was lost {losses} times without a checkpoint in between: {why}"
        else:
            run.lose_worker(why)


def worker_variables(threads: int, gpus: float) -> dict[str, str]:
    """Environment variables of a worker on any machine; where Ray has set one of them, this one counts.

    What the user has told JAX and XLA here holds there. A task that has reserved no GPU sees none; for the others
    Ray has named theirs in CUDA_VISIBLE_DEVICES.
    """
    share = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{GPU_MEMORY * gpus:.3f}"} if gpus < 1 else {}
    told = {name: value for name, value in os.environ.items() if name.startswith(TOLD)}
    return ({"CUDA_VISIBLE_DEVICES": ""} if gpus == 0 else share) | told | thread_limits(threads)


def in_short(error: Exception) -> str:
    """What an error of Ray's comes down to: its last line, where the lines before are a stack, without advice."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].split(". ")[0].rstrip(".") if lines else type(error).__name__


def lacking_room(ray: Any, cluster: Cluster) -> str | None:
    """What to say of a cluster that has no machine large enough for a task; None if it has one."""
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(has.get("CPU", 0) >= cluster.cpus and has.get("GPU", 0) >= cluster.gpus for has in machines):
        return None
    return f"no machine of the Ray cluster has {cluster.cpus:g} cores and {cluster.gpus:g} GPUs for a task"


@contextmanager
def connected(cluster: Cluster) -> Iterator[Any]:
    """Ray, connected to the cluster; a connection that this program has already is used, and is kept.

    Raises:
        UserError: if Ray is not installed, the cluster does not answer, or one started here has too little for a task.
    """
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)  # read when Ray is imported
    ray = required("ray", "ray", "--launcher ray")
    if ray.is_initialized():
        yield ray
        return
    with sigterm_handler_kept():
        started_here = connect(ray, cluster.address or os.environ.get("RAY_ADDRESS"))
    try:
        if started_here and (lack := lacking_room(ray, cluster)):
            raise UserError(f"{lack}: use less with --ray-cpus and --ray-gpus, or another cluster with --ray-address")
        yield ray
    finally:
        ray.shutdown()


def connect(ray: Any, address: str | None) -> bool:
    """To the cluster that is named, or the one found on this machine, or one that is started; whether it was started.

    The address "local" always starts one.
    """
    quiet: dict[str, Any] = {"logging_level": logging.CRITICAL, "log_to_driver": False}
    if address != "local":
        try:
            if address and address != "auto":
                require_answer(address)
            ray.init(address=address or "auto", **quiet)
            return False
        except (OSError, ValueError, RuntimeError) as error:
            if address or not isinstance(error, ConnectionError):  # else there is none, and one is started
                where = f"at {address}" if address else "of this machine"
                raise UserError(f"cannot use the Ray cluster {where}: {in_short(error)}") from error
    ray.init(
        address="local", num_cpus=len(usable_cores()), object_store_memory=OBJECT_STORE_BYTES,
        include_dashboard=False, **quiet,
    )  # fmt: skip
    return True


def require_answer(address: str) -> None:
    """Raise OSError or ValueError if nothing listens at an address such as host:6379; Ray itself tries for minutes."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not port.isdecimal():
        raise ValueError("write it as host:port")
    socket.create_connection((host.strip("[]"), int(port)), ANSWER_SECONDS).close()


@contextmanager
def sigterm_handler_kept() -> Iterator[None]:
    """Take back what `ray.init` does with SIGTERM: it would end the program and nothing would be said of the grid."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)
