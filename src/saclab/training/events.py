"""What a run tells while it goes on. Progress bars, event files and other consumers read these and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np


class Started(NamedTuple):
    run: Path
    resumed_at_step: int
    """0 for a new run."""
    notes: tuple[str, ...]
    """What the user should know: the update-to-data ratio, warnings of a resumed run."""


class Progress(NamedTuple):
    steps: int
    updates: int
    episodes: int
    fraction: float
    """Share of the run that is done, by whichever limit is nearest."""
    seconds: float
    """Wall-clock time of the run so far, earlier sessions counted in."""


class EpisodeEnded(NamedTuple):
    episode: int
    steps: int
    updates: int
    total_reward: float
    running_average: float
    length: int


class UpdatesLogged(NamedTuple):
    """The mean of each metric over a window of updates."""

    steps: int
    updates: int
    means: dict[str, float]


class Evaluated(NamedTuple):
    evaluation: int
    steps: int
    updates: int
    episodes: int
    total_rewards: np.ndarray
    """f64[episodes]."""
    best: bool
    """Whether its mean is the run's best so far."""


class Warned(NamedTuple):
    """Something looks wrong; told once."""

    message: str


class Saved(NamedTuple):
    checkpoint: Path
    seconds: float
    """What the save took."""


class Finished(NamedTuple):
    reason: str
    steps: int
    updates: int
    episodes: int
    best_return: float
    final_return: float


class Failed(NamedTuple):
    """A run met a number that is not finite, or its environment broke; the others of its run group go on."""

    message: str
    not_finite: bool = True
    """Whether it is about a number that is not finite."""
    traceback: str = ""
    """Where the environment's own code raised an error, if it did."""


class Interrupted(NamedTuple):
    """Stopped on request; the run can be resumed from its checkpoint."""

    steps: int


Event = Started | Progress | EpisodeEnded | UpdatesLogged | Evaluated | Warned | Saved | Finished | Failed | Interrupted
