"""What a grid is trained with: how its runs are computed, and nothing of what they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

from saclab.config import Config
from saclab.errors import require
from saclab.grid.cluster import Cluster, chosen_cluster
from saclab.grid.groups import run_groups
from saclab.grid.local import local_pool
from saclab.grid.plan import Cell, require_startable
from saclab.grid.pool import WorkerPool
from saclab.grid.ray import ray_pool
from saclab.limits import require_threads
from saclab.machine import accelerator, usable_cores
from saclab.trackers.asked import NOWHERE, Tracking

BATCH_ON_ACCELERATOR = 16
"""Runs that are trained together, unless another number is asked for."""


class Resources(NamedTuple):
    """Processes, threads and machines, all chosen."""

    workers: int | None
    """Tasks at a time, or the processes that step the environments of a run group; None leaves it to a cluster."""
    threads: int
    """Cores that XLA uses in each worker."""
    batch: int
    """How many runs of the same structure are trained as one run group; 0 for each alone."""
    cluster: Cluster | None
    """None for local workers."""

    def pool(self, checkpoint_minutes: float, tracking: Tracking = NOWHERE) -> AbstractContextManager[WorkerPool]:
        """The workers of `saclab.grid.launch.launch`."""
        if self.cluster is not None:
            return ray_pool(self.cluster, self.threads, checkpoint_minutes, self.workers, tracking)
        assert self.workers is not None
        return local_pool(self.workers, self.threads, checkpoint_minutes, self.batch, tracking)

    def require_startable(self, cells: Sequence[Cell]) -> None:
        """Raise UserError before anything is started if an environment, a folder or the memory will not do."""
        if self.cluster is not None:
            require_startable(cells, 0, "--workers", here=False)  # its machines have memory and files of their own
        elif not self.batch:
            assert self.workers is not None
            require_startable(cells, min(self.workers, len(cells)), "--workers")
        else:  # on a device, the run group itself looks at its memory
            require_startable(cells, 0 if accelerator() else min(self.batch, len(cells)), "--batch")

    def note(self, cells: Sequence[Cell]) -> str:
        """What a user should know of a grid that is trained in run groups; empty if each run is trained alone."""
        return group_note(cells, self.batch) if self.batch else ""


def chosen_resources(
    workers: int | None = None,
    threads: int | None = None,
    batch: int | None = None,
    launcher: str = "local",
    ray_address: str | None = None,
    ray_cpus: float | None = None,
    ray_gpus: float = 0.0,
) -> Resources:
    """Choose all that is not said; the arguments are those of `saclab.compare`.

    Raises:
        UserError: for a value that cannot work.
    """
    require(workers is None or workers >= 1, "workers", workers, "use at least 1")
    require_threads(threads)
    batch = chosen_batch(batch, launcher, ray_gpus)
    cores = len(usable_cores())
    threads = threads or (cores if batch and launcher == "local" else max(1, int(ray_cpus or 1)))
    cluster = chosen_cluster(launcher, threads, ray_address, ray_cpus, ray_gpus)
    if cluster is None:
        workers = workers or (cores if batch else max(1, cores // threads))
    return Resources(workers, threads, batch, cluster)


def chosen_batch(batch: int | None, launcher: str = "local", ray_gpus: float = 0.0) -> int:
    """How many runs are trained together; None leaves it to where they are trained.

    Raises:
        SettingError: for a negative number.
    """
    if batch is None:
        return BATCH_ON_ACCELERATOR if (ray_gpus > 0 if launcher == "ray" else accelerator()) else 0
    require(batch >= 0, "batch", batch, "use a number of runs, or 0 to train each alone")
    return batch


def group_note(cells: Sequence[Cell], batch: int) -> str:
    """What a user should know of a grid that is trained in run groups of at most `batch`."""
    from saclab.training.starts import ratio_note

    groups = run_groups([cell for cell in cells if not cell.finished], batch)
    sizes = ", ".join(str(len(group.members)) for group in groups) or "none to do"
    machine = f"run groups of {sizes} run(s), each with the machine to itself"
    return "; ".join([machine, *(by_variant(cells, say) for say in (acting_note, ratio_note))])


def acting_note(config: Config) -> str:
    if config.training.acting_delay:
        return "the policy that acts is one round of updates behind (acting_delay 1)"
    return "the environments wait for the updates (--acting-delay 1 is faster: it steps them meanwhile)"


def by_variant(cells: Sequence[Cell], say: Callable[[Config], str]) -> str:
    """What is to be said of the runs: once if it is the same of all, else each with the variants that it is true of."""
    said: dict[str, dict[str, None]] = {}
    for cell in cells:
        said.setdefault(say(cell.config), {})[cell.config.variant] = None
    if len(said) == 1:
        return next(iter(said))
    return "; ".join(f"{', '.join(variants)}: {text}" for text, variants in said.items())
