"""What a grid asks of the place where its tasks are trained, be it this machine or a cluster."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from saclab.grid.tasks import Task

POLL_SECONDS = 0.25


class End(NamedTuple):
    """How a worker ended."""

    code: int | None
    """Exit status, below 0 for a signal; None if it was lost with its machine, or is out of reach."""
    words: str
    """What it has written to its standard error, or why it was lost."""


class Report(NamedTuple):
    """News of one worker."""

    task: Task
    messages: list[dict[str, Any]]
    """What it has said since the last report."""
    end: End | None = None


class WorkerPool(Protocol):
    """Workers, each of which trains one task in a process of its own.

    Pools are made by context managers. Leaving one leaves no worker behind: those that train save their runs first.
    """

    @property
    def places(self) -> int | None:
        """Tasks at a time; None hands over all: the pool keeps those that have to wait for room."""

    @property
    def replaces_lost(self) -> bool:
        """Whether the runs of a worker that somebody else killed or stopped go on in another one."""

    @property
    def note(self) -> str | None:
        """What is to be said of the runs that wait."""

    def start(self, task: Task) -> bool:
        """Hand over a task; whether its worker runs already, or waits for room until its first report."""

    def poll(self) -> list[Report]:
        """Wait a moment, or until there are news, and return them."""

    def stop(self, task: Task) -> bool:
        """Tell a worker to save and stop, which it will report; False if its task waited for room and is taken back."""
