"""What the outside asks of a run or of a grid of runs; looked at after every step."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Requests:
    stop: int = 0
    """Save and stop; the number of the signal that asked for it, or any other number but 0."""
    save: bool = False
    """Save and go on."""


class Stopped(Exception):  # noqa: N818 - no error
    """Asked to stop in the middle of an evaluation, whose episodes so far count for nothing."""
