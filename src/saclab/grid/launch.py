"""The loop that trains a grid: it hands out tasks, listens, stops, and lets the runs of lost workers go on."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from saclab.grid.plan import Cell
from saclab.grid.pool import POLL_SECONDS, End, WorkerPool
from saclab.grid.tasks import RunStatus, Task, make_statuses, make_tasks
from saclab.signals import how_it_ended
from saclab.training.common_checkpoint import checkpoint_steps
from saclab.training.requests import Requests

LOOK_SECONDS = 1.0  # between two looks at the runs of other processes
LOSSES = 3  # of a run's worker without a new checkpoint in between; one more, and the run has failed


def launch(
    cells: Sequence[Cell], pool: AbstractContextManager[WorkerPool], requests: Requests, batch: int = 0
) -> Iterator[list[RunStatus]]:
    """Train every unfinished cell; yields all statuses several times a second.

    A failed run does not stop the others. A run that another process trains is waited for; if that process ends before
    the run does, it goes on here. When `requests.stop` is set, every worker saves its runs and stops; at the end no
    worker is left behind, however this generator ends.

    Args:
        cells: the runs of the grid.
        pool: where they are trained; `saclab.grid.local.local_pool` or `saclab.grid.ray.ray_pool` makes one.
        requests: asks the grid to stop.
        batch: how many runs of the same structure are trained as one run group; 0 for each run alone.

    Raises:
        UserError: if the pool cannot be made.
    """
    statuses = make_statuses(cells)
    with pool as workers:
        grid = Grid(workers, make_tasks(statuses, batch), batch)
        grid.note(grid.waiting)
        while grid.running or (grid.waiting and not requests.stop):
            if requests.stop:
                grid.stop()
            else:
                grid.start()
            grid.listen()
            yield statuses
    yield statuses


@dataclass
class Grid:
    """The tasks of a grid: those that wait here, and those that the pool has been given."""

    pool: WorkerPool
    waiting: list[Task]
    batch: int
    running: list[Task] = field(default_factory=list)
    given_up: set[Path] = field(default_factory=set)
    """Folders of runs that are to go no further, while the others do."""
    losses: dict[Path, tuple[int, int]] = field(default_factory=dict)
    """Run folder -> workers lost since its newest checkpoint, and that one's step."""
    stopping: bool = False
    elsewhere: bool = False
    """Whether a task waits for another process."""
    next_look: float = 0.0

    def note(self, tasks: Sequence[Task]) -> None:
        """Let runs that wait say what the pool has to say of them."""
        for task in tasks:
            for run in task.runs:
                run.warnings += [self.pool.note] if self.pool.note else []

    def start(self) -> None:
        """Hand waiting tasks to the pool, as far as it has places."""
        if self.elsewhere and time.monotonic() < self.next_look:
            return
        self.next_look = time.monotonic() + LOOK_SECONDS
        self.elsewhere = False
        for task in tuple(self.waiting):
            if self.pool.places is not None and self.busy >= self.pool.places:
                return
            if task.found_elsewhere():
                self.elsewhere = True
                continue
            self.waiting.remove(task)
            if all(run.status == "finished" for run in task.runs):
                continue
            try:
                begun = self.pool.start(task)
            except OSError as error:  # a folder that cannot be written to stops no other run
                task.cannot_start(error)
                continue
            self.running.append(task)
            if begun:
                task.start()

    @property
    def busy(self) -> int:
        """Places that are taken: a task that hangs leaves its own to another."""
        return sum(not task.stalled for task in self.running)

    def stop(self) -> None:
        """Let every worker save and stop, and take back the tasks that wait for room."""
        if self.stopping:
            return
        self.stopping = True
        self.running = [task for task in self.running if self.pool.stop(task)]

    def give_up(self, runs: Sequence[RunStatus]) -> None:
        """Let some runs go no further, while the others do; a run group ends only as a whole."""
        new = [task for task in (*self.waiting, *self.running) if not self._is_given_up(task)]
        self.given_up |= {run.cell.folder for run in runs}
        for task in filter(self._is_given_up, new):
            if task in self.waiting:
                self.waiting.remove(task)
                self._lay_down(task)
            elif not self.pool.stop(task):  # it had not begun
                self.running.remove(task)
                self._lay_down(task)

    def _is_given_up(self, task: Task) -> bool:
        return all(run.cell.folder in self.given_up for run in task.runs)

    def _lay_down(self, task: Task) -> None:
        for run in task.runs:
            run.status = run.status if run.status in ("finished", "failed") else "interrupted"

    def _wait_for_room(self, task: Task) -> None:
        """Let the runs of a task that wait again be taken up anew, unless they are given up."""
        if self._is_given_up(task):
            self._lay_down(task)
        self.waiting[:0] = make_tasks(task.runs, self.batch)

    def listen(self) -> None:
        """Take in what the workers say, and how they end."""
        if not self.running:
            time.sleep(POLL_SECONDS)
        for task, messages, end in self.pool.poll():
            lost = end is not None and end.code is None
            if not (task.started or lost):
                task.start()
            for message in messages:
                task.enter(message)
            if end is not None:
                self.running.remove(task)
                self._ended(task, end)

    def _ended(self, task: Task, end: End) -> None:
        """Note the end of a worker; if somebody else than this grid has killed or stopped it, it may be replaced."""
        if end.code is None:
            self._lost(task, end.words)
            return
        stopping = self._stopping(task)
        replaced = self.pool.replaces_lost and not stopping
        if replaced and end.code == -signal.SIGKILL:
            self._lost(task, how_it_ended(end.code, end.words))
            return
        task.ended(end.code, stopping, end.words)
        self._wait_for_room(task)  # those of which another process was faster
        if replaced and any(run.status in ("running", "interrupted") for run in task.runs):
            self._lost(task, "told to stop")

    def _stopping(self, task: Task) -> bool:
        """Whether a task was told to stop."""
        return self.stopping or self._is_given_up(task)

    def _lost(self, task: Task, why: str) -> None:
        """Let the runs that have not ended wait for another worker."""
        stopping = self._stopping(task)
        for run in task.runs:
            if run.cell.finished:
                run.status, run.fraction = "finished", 1.0
            elif run.status == "running" and stopping:
                run.status = "interrupted"
            elif run.status != "failed" and not stopping:
                self._wait_again(run, why)
        self._wait_for_room(task)

    def _wait_again(self, run: RunStatus, why: str) -> None:
        """Let a run wait, or fail if this has happened too often since it got any further."""
        step = max(checkpoint_steps(run.cell.folder), default=0)
        before, last_step = self.losses.get(run.cell.folder, (0, step))
        losses = before + 1 if step == last_step else 1
        self.losses[run.cell.folder] = losses, step
        if losses > LOSSES:
            run.status = "failed"
            run.message = f"its worker was lost {losses} times without a checkpoint in between ({why})"
        else:
            run.lose_worker(why)
