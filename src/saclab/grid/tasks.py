"""What one worker process trains, and what is known of it while it does: the part that every launcher shares."""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from saclab.grid.groups import run_groups
from saclab.grid.plan import Cell
from saclab.grid.rate import RateMeter
from saclab.signals import EXIT_STATUS, how_it_ended
from saclab.trackers.asked import NOWHERE, Tracking
from saclab.training.lock import holder

Status = Literal["waiting", "running", "finished", "interrupted", "failed"]


@dataclass
class RunStatus:
    """What is known of a run of the grid while it goes on."""

    cell: Cell
    status: Status = "waiting"
    fraction: float = 0.0
    updates: int = 0
    episodes: int = 0
    evaluations: int = 0
    """How many it has told of."""
    evaluation_return: float | None = None
    message: str = ""
    """Why it failed."""
    broken: bool = False
    """Whether something in the run itself was the cause: a number that is not finite, or its environment."""
    warnings: list[str] = field(default_factory=list)
    """What the run said of itself that the user should know."""
    stalled: bool = False
    """Whether its environment has not come back for long: it may hang."""
    elsewhere: str = ""
    """The id of another process that trains it, for whose end it waits."""
    meter: RateMeter = field(default_factory=RateMeter, repr=False)

    @property
    def state(self) -> str:
        """The status in words."""
        if self.elsewhere:
            return f"waits for process {self.elsewhere}"
        return "hangs?" if self.stalled and self.status == "running" else self.status

    def enter(self, message: dict[str, object]) -> None:
        """Take in one line of the worker."""
        match message:
            case {"event": "progress", "fraction": float(fraction), "updates": int(updates), "episodes": int(episodes)}:
                self.fraction, self.updates, self.episodes = fraction, updates, episodes
                self.meter.enter(time.monotonic(), fraction, updates)
            case {"event": "evaluated", "evaluation": int(number), "mean_return": float(mean)}:
                self.evaluations, self.evaluation_return = number, mean
            case {"event": "warned" | "stalled", "message": str(text)}:
                self.warnings.append(text)
            case {"event": "finished"}:
                self.status, self.fraction = "finished", 1.0
            case {"event": "interrupted"}:
                self.status = "interrupted"
            case {"event": "in_use"}:
                self.status = "waiting"
            case {"event": "failed", "message": str(text), **more}:
                self.status, self.message, self.broken = "failed", text, more.get("broken") is True

    def lose_worker(self, why: str) -> None:
        """Wait for another worker, which goes on from the last checkpoint."""
        self.warnings.append(f"its worker was lost ({why}): continued from the last checkpoint")
        self.status, self.meter, self.stalled = "waiting", RateMeter(), False


@dataclass(eq=False)
class Task:
    """A run alone, or runs that are trained as one run group."""

    runs: list[RunStatus]
    slots: int
    """Places in the run group, at least as many as runs; 0 for a run alone."""

    @property
    def stalled(self) -> bool:
        return any(run.stalled for run in self.runs)

    @property
    def started(self) -> bool:
        return all(run.status != "waiting" for run in self.runs)

    def found_elsewhere(self) -> bool:
        """Look at the folders: note what has finished; whether another process trains one of its runs."""
        for run in self.runs:
            run.elsewhere = holder(run.cell.folder) or ""
            if not run.elsewhere and run.cell.finished:
                run.status, run.fraction = "finished", 1.0
        return any(run.elsewhere for run in self.runs)

    def start(self) -> None:
        for run in self.runs:
            if run.status != "finished":  # by another process
                run.status = "running"

    def to_dict(
        self,
        checkpoint_minutes: float,
        tracking: Tracking = NOWHERE,
        cores: Sequence[int] = (),
        workers: int = 1,
        patience: float = 0,
    ) -> dict[str, Any]:
        """What `saclab.grid.worker` takes on its standard input.

        Args:
            checkpoint_minutes: wall-clock time between checkpoints.
            tracking: where the runs' numbers are sent.
            cores: it keeps to these; none leaves them to the system.
            workers: of a run group, the processes that step environments.
            patience: seconds that it waits for a run folder that is in use.
        """
        runs = [{"config": run.cell.config.to_dict(), "folder": str(run.cell.folder)} for run in self.runs]
        return {
            "runs": runs,
            "slots": self.slots,
            "workers": workers,
            "checkpoint_minutes": checkpoint_minutes,
            "tracking": asdict(tracking),
            "cores": list(cores),
            "patience": patience,
        }

    def enter(self, message: dict[str, Any]) -> None:
        """Take in one line of the worker, which says of which run it speaks."""
        self.runs[message["run"]].enter(message)
        if message["event"] in ("progress", "warned", "stalled"):  # the runs of a group are stepped together
            for run in self.runs:
                run.stalled = message["event"] == "stalled"

    def cannot_start(self, error: OSError) -> None:
        """Note that no process could be started for it."""
        for run in self.runs:
            if run.status != "finished":
                run.status, run.message = "failed", f"cannot be started: {error}"

    def ended(self, code: int, stopping: bool, errors: str) -> None:
        """Note how the process ended; a worker that said nothing of a run's end has failed it.

        One that was told to stop before it could listen, while it was still importing, or that could not save in time,
        has lost nothing that was saved.
        """
        for run in self.runs:
            if run.status != "running":
                continue
            if code == 0:
                run.status, run.fraction = "finished", 1.0
            elif code in EXIT_STATUS.values() or (stopping and code == -signal.SIGTERM):
                run.status = "interrupted"
            else:
                run.status = "failed"
                run.message = f"its worker ended ({how_it_ended(code, errors)})"


def make_statuses(cells: Sequence[Cell]) -> list[RunStatus]:
    """One per run of the grid."""
    return [RunStatus(cell, "finished", 1.0) if cell.finished else RunStatus(cell) for cell in cells]


def make_tasks(statuses: Sequence[RunStatus], batch: int) -> list[Task]:
    """The unfinished runs, each alone, or up to `batch` of the same structure as one run group; in the grid's order."""
    waiting = [status for status in statuses if status.status == "waiting"]
    if batch == 0:
        return [Task([status], 0) for status in waiting]
    groups = run_groups([status.cell for status in waiting], batch)
    return [Task([waiting[index] for index in group.members], group.slots) for group in groups]
