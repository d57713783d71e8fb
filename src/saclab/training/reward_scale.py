"""What rewards are divided by: running statistics of the discounted return of the training episodes.

As in SimbaV2, XQC and FlashSAC, rewards are stored as they came and divided when a batch is drawn, so that every
stored transition has today's scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from saclab.training.captured import require_like
from saclab.training.checkpoint import Arrays
from saclab.training.running import merged

EPSILON = 1e-8
FIRST_COUNT = 1e-4  # of the start's variance of 1

SCALES: dict[str, Callable[[float, float], float]] = {
    "none": lambda variance, largest: 1.0,
    "deviation": lambda variance, largest: math.sqrt(variance) + EPSILON,
    "deviation_or_bound": lambda variance, largest: max(math.sqrt(variance + EPSILON), largest),
}
"""Name -> (variance of the return, its largest value over the critics' bound) -> the scale."""


class RewardScale:
    """What divides the rewards of one run, over its N environments."""

    def __init__(self, kind: str, environments: int, discount: float, bound: float) -> None:
        """The state before the first step.

        Args:
            kind: the setting `reward_scaling`.
            environments: N.
            discount: γ of the returns.
            bound: the largest return that the critics can represent.
        """
        self.kind, self.discount, self.bound = kind, discount, bound
        self.returns = np.zeros(environments)
        """f64[N]: G, discounted from each episode's start."""
        self.moments = np.array([FIRST_COUNT, 0.0, 1.0])
        """f64[3]: count, mean and variance of G over all steps."""
        self.largest = np.zeros(1)
        """f64[1]: the largest |G|."""

    def enter(self, reward: np.ndarray, ended: np.ndarray) -> None:
        """Take in the rewards f32[N] of a step and whether an episode ended with it bool[N].

        G ← γ (1 − ended) G + r, as the authors of SimbaV2 have it: the last step of an episode forgets those before.
        """
        if not self.active:
            return
        self.returns = self.discount * (1 - ended) * self.returns + reward
        count, mean, variance = self.moments
        self.moments = np.array(merged(count, mean, variance, self.returns))
        self.largest = np.maximum(self.largest, np.abs(self.returns).max())

    def enter_stream(self, rewards: np.ndarray, ended: np.ndarray) -> None:
        """Take in the rewards f32[M] of steps that one environment took in turn, and whether each ended an episode."""
        if not self.active:
            return
        running, returns = 0.0, np.zeros(len(rewards))
        for step, (reward, last) in enumerate(zip(rewards.tolist(), ended.tolist(), strict=True)):
            running = reward if last else self.discount * running + reward
            returns[step] = running
        count, mean, variance = self.moments
        self.moments = np.array(merged(count, mean, variance, returns))
        self.largest = np.maximum(self.largest, np.abs(returns).max())

    @property
    def active(self) -> bool:
        """Whether rewards are divided by anything but 1."""
        return self.kind != "none"

    @property
    def value(self) -> np.float32:
        """What rewards are divided by now."""
        return np.float32(SCALES[self.kind](self.moments[2], self.largest[0] / self.bound))

    def capture(self) -> Arrays:
        """Empty if nothing is scaled."""
        if not self.active:
            return {}
        return {"returns": self.returns, "moments": self.moments, "largest": self.largest}

    def restore(self, arrays: Arrays) -> None:
        """Continue from `capture`; raises CheckpointError for what it cannot have given."""
        for name, now in self.capture().items():
            setattr(self, name, require_like(f"the reward scale's {name}", arrays.get(name), now))
