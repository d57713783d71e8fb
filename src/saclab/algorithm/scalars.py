"""The settings that are plain numbers, as arguments of the compiled functions: one program serves all their values."""

from __future__ import annotations

from typing import Any

import numpy as np

from saclab.settings import AlgorithmSettings

Scalars = dict[str, Any]
"""Name of a setting -> f32[] or i32[], NumPy or JAX; [R] where runs are mapped over."""


def scalars(settings: AlgorithmSettings, action_size: int, planned_updates: int | None = None) -> Scalars:
    """The plain numbers of one run.

    Args:
        settings: of the run.
        action_size: A; the default target entropy is −A.
        planned_updates: the length of the learning rates' schedule; None if they are constant.
    """
    learned = settings.temperature == "learned"
    target_entropy = -action_size if settings.target_entropy is None else settings.target_entropy
    return {
        "discount": np.float32(settings.discount),
        "critic_learning_rate": np.float32(settings.critic_learning_rate),
        "actor_learning_rate": np.float32(settings.actor_learning_rate),
        "temperature_learning_rate": np.float32(settings.temperature_learning_rate if learned else 0),
        "adam_beta_1": np.float32(settings.adam_beta_1),
        "adam_beta_2": np.float32(settings.adam_beta_2),
        "final_learning_rate_share": np.float32(settings.final_learning_rate_share),
        "planned_updates": np.float32(planned_updates or 1),
        "polyak_rate": np.float32(settings.polyak_rate),
        "snapshot_interval": np.int32(settings.snapshot_interval),
        "initial_temperature": np.float32(settings.initial_temperature),
        "target_entropy": np.float32(target_entropy),
    }
