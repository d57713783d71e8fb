"""Draws of a run's exploration: uniform actions at first, then noise for the policy, fresh or held for some steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from saclab.training import seeds
from saclab.training.captured import require_like, restore_generator
from saclab.training.checkpoint import Arrays


class Exploration:
    """Draws of one run, for N environments."""

    def __init__(self, seed: int, environments: int, action_size: int, longest_noise: int) -> None:
        """The state before the first step.

        Args:
            seed: of the run.
            environments: N.
            action_size: A.
            longest_noise: most steps for which one draw is held (as in FlashSAC).
        """
        self.generator = seeds.generator(seed, "exploration")
        self.shape = environments, action_size
        lengths = np.arange(1, longest_noise + 1)
        self.length_shares = lengths**-2.0 / np.sum(lengths**-2.0)
        """f64[longest_noise]: the probability of each number of steps."""
        self.held = np.zeros(self.shape, np.float32)
        self.steps_left = np.zeros(environments, np.int64)
        """i64[N]: how many steps `held` is kept for."""

    def uniform_action(self) -> np.ndarray:
        """f32[N, A] in [-1, 1]."""
        return self.generator.uniform(-1, 1, self.shape).astype(np.float32)

    def noise(self) -> np.ndarray:
        """f32[N, A], standard normal."""
        drawn = self.generator.standard_normal(self.shape, np.float32)
        if len(self.length_shares) == 1:
            return drawn
        lengths = 1 + self.generator.choice(len(self.length_shares), len(self.held), p=self.length_shares)
        fresh = self.steps_left == 0
        self.held = np.where(fresh[:, None], drawn, self.held)
        self.steps_left = np.where(fresh, lengths, self.steps_left) - 1
        return self.held.copy()

    def capture(self) -> tuple[dict[str, Any], Arrays]:
        """The generator's state, and the noise that is held, if any can be."""
        arrays: Arrays = {"held": self.held, "steps_left": self.steps_left} if len(self.length_shares) > 1 else {}
        return dict(self.generator.bit_generator.state), arrays

    def restore(self, state: object, arrays: Arrays) -> None:
        """Continue from `capture`; raises CheckpointError for what it cannot have given."""
        restore_generator("exploration", self.generator, state)
        if len(self.length_shares) > 1:
            self.held = require_like("held noise", arrays.get("held"), self.held)
            self.steps_left = require_like("steps of held noise", arrays.get("steps_left"), self.steps_left)
