"""By what observations are normalised: the running mean and deviation of those that a run's environments have shown.

Transitions are stored as they came. The networks hold the moments that they normalise by (`normalised_inputs`), so
that whoever has the parameters of a policy, be it a process, a checkpoint or a user, has its normalisation.
"""

from __future__ import annotations

import numpy as np

from saclab.training.captured import require_like
from saclab.training.checkpoint import Arrays
from saclab.training.running import merged

EPSILON = 1e-8


class ObservationMoments:
    """The moments of one run."""

    def __init__(self, kind: str, observation_size: int) -> None:
        """The state before the first step; `kind` is the setting `observation_normalisation`."""
        self.kind = kind
        self.count = np.zeros(1)
        """f64[1]: observations seen."""
        self.mean = np.zeros(observation_size)
        """f64[O]."""
        self.variance = np.ones(observation_size)
        """f64[O]: 1 before the first observation."""

    @property
    def active(self) -> bool:
        """Whether observations are normalised at all."""
        return self.kind != "none"

    def enter(self, observation: np.ndarray) -> None:
        """Take in the observations f32[N, O] from which a step was taken."""
        if self.active:
            seen = observation.astype(np.float64)
            self.count, self.mean, self.variance = merged(self.count, self.mean, self.variance, seen)

    @property
    def value(self) -> np.ndarray | None:
        """Mean and deviation f32[2, O]; None if nothing is normalised."""
        if not self.active:
            return None
        return np.stack([self.mean, np.sqrt(self.variance + EPSILON)]).astype(np.float32)

    def capture(self) -> Arrays:
        """Empty if nothing is normalised."""
        return {"count": self.count, "mean": self.mean, "variance": self.variance} if self.active else {}

    def restore(self, arrays: Arrays) -> None:
        """Continue from `capture`; raises CheckpointError for what it cannot have given."""
        for name, now in self.capture().items():
            setattr(self, name, require_like(f"the observations' {name}", arrays.get(name), now))
