"""The settings that are plain numbers, as arguments of the compiled functions: one program serves all their values."""

from __future__ import annotations

from typing import Any

import numpy as np

from saclab.settings import AlgorithmSettings, plain_numbers

Scalars = dict[str, Any]
"""Name of a setting -> f32[] or i32[], NumPy or JAX; [R] where runs are mapped over."""

OF_THE_CONTEXT = ("reward_weights",)
"""Settings that are arguments of the update in its Context."""


def scalars(settings: AlgorithmSettings, action_size: int, planned_updates: int | None = None) -> Scalars:
    """The plain numbers of one run.

    Args:
        settings: of the run.
        action_size: A; the default target entropy is −A.
        planned_updates: the length of the learning rates' schedule; None if they are constant.
    """
    learned = settings.temperature == "learned"
    given = {
        "temperature_learning_rate": settings.temperature_learning_rate if learned else 0.0,
        "target_entropy": -action_size if settings.target_entropy is None else settings.target_entropy,
    }
    numbers = {name: given.get(name, getattr(settings, name)) for name in plain_numbers() if name not in OF_THE_CONTEXT}
    whole = {name for name in numbers if type(getattr(AlgorithmSettings, name)) is int}
    kinds = {name: np.int32 if name in whole else np.float32 for name in numbers}
    return {"planned_updates": np.float32(planned_updates or 1)} | {
        name: kinds[name](value) for name, value in numbers.items()
    }
