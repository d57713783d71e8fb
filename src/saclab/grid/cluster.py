"""A Ray cluster: which one, what each task is given there, and how it is connected to or started."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from typing import Any

from saclab.errors import UserError, require, unknown_name
from saclab.extras import required
from saclab.machine import usable_cores

LAUNCHERS = ("local", "ray")
ANSWER_SECONDS = 10
OBJECT_STORE_BYTES = 2**27  # of a cluster started here: only words pass through it
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_DEDUP_LOGS_SKIP_REGEX": "."}
"""No word to Ray's makers; none of Ray's in the user's terminal, where it would print a page for each lost worker."""


@dataclass(frozen=True)
class Cluster:
    """Where a grid is trained, and what each of its tasks is given there."""

    address: str | None = None
    """Where it answers; None for RAY_ADDRESS, else the one that runs on this machine, else one that is started."""
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
    """Use the cluster that is named, or the one found on this machine, or start one; whether it was started.

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
