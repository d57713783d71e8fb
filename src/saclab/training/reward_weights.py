"""What the reward terms are weighed by at a moment of training."""

from __future__ import annotations

import numpy as np

from saclab.settings import AlgorithmSettings


def reward_weights(settings: AlgorithmSettings, share: float, best_return: float | None) -> np.ndarray:
    """f32[T]: the weight of each reward term in the reward that is learned from; the remainder's is 1.

    Args:
        settings: with the weights that stay, and the schedules of those that change.
        share: of the planned updates that are made.
        best_return: the highest mean evaluation return so far; None before the first evaluation.
    """
    scheduled = {term.name: term for term in settings.scheduled_terms}
    constant = iter(settings.reward_weights)
    named = [
        scheduled[name].weight(share, best_return) if name in scheduled else next(constant, 1.0)
        for name in settings.terms_of_reward
    ]
    return np.array([*named, 1.0], np.float32)
