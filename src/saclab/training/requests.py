"""What the outside asks of a run or of a grid of runs; looked at after every step, and within what takes longer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Requests:
    stop: int = 0
    """Save and stop; the number of the signal that asked for it, or any other number but 0."""
    save: bool = False
    """Save and go on."""
    saving: bool = False
    """Whether a checkpoint is being written now: the answer of the run, for whoever waits for its stop."""

    @contextmanager
    def while_saving(self) -> Iterator[None]:
        """Around the writing of a checkpoint, which is waited for however long it takes."""
        self.saving = True
        try:
            yield
        finally:
            self.saving = False


class Stopped(Exception):  # noqa: N818 - no error
    """Asked to stop in the middle of an evaluation, which counts for nothing and is made again."""
