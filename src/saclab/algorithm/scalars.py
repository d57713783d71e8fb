"""The settings that are plain numbers, as arguments of the compiled functions: one program serves all their values."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from saclab.settings import AlgorithmSettings, plain_numbers

Scalars = dict[str, Any]
"""Name of a setting -> f32[] or i32[], NumPy or JAX; [R] where runs are mapped over."""

ELSEWHERE = ("reward_weights", "reward_schedule", "target_entropy_per_action")
"""Settings that reach the update in its Context, or as part of another number."""

NAMES = ("planned_updates", *(name for name in plain_numbers() if name not in ELSEWHERE))
WHOLE = tuple(name for name in NAMES[1:] if type(getattr(AlgorithmSettings, name)) is int)


def scalars(settings: AlgorithmSettings, action_size: int, planned_updates: int | None = None) -> Scalars:
    """The plain numbers of one run.

    Args:
        settings: of the run.
        action_size: A.
        planned_updates: the length of the learning rates' schedule; None if they are constant.
    """
    learned, target_entropy = settings.temperature == "learned", settings.target_entropy
    if target_entropy is None:
        target_entropy = settings.target_entropy_per_action * action_size
    given = {
        "temperature_learning_rate": settings.temperature_learning_rate if learned else 0.0,
        "target_entropy": target_entropy,
    }
    numbers = {name: given.get(name, getattr(settings, name)) for name in NAMES[1:]}
    return {"planned_updates": np.float32(planned_updates or 1)} | {
        name: np.int32(value) if name in WHOLE else np.float32(value) for name, value in numbers.items()
    }


def pack(numbers: Scalars) -> np.ndarray:
    """i32[N]: all in one array, floating-point numbers as their bits, since each argument of a call takes its time."""
    return np.array([np.asarray(numbers[name]).view(np.int32) for name in NAMES])


def unpack(packed: jax.Array) -> Scalars:
    """What was packed into i32[N]."""
    reals = jax.lax.bitcast_convert_type(packed, jnp.float32)
    return {name: (packed if name in WHOLE else reals)[place] for place, name in enumerate(NAMES)}
