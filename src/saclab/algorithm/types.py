"""The types that carry the data. B: batch, O: observation, A: action, C: critics, K: target snapshots,
W: entropy window, T: reward terms, M: metrics, P: numbers of one network, packed into one vector.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np


class Batch(NamedTuple):
    """Transitions drawn from replay."""

    observation: jax.Array
    """f32[B, O]."""
    action: jax.Array
    """f32[B, A] in [-1, 1]."""
    reward_terms: jax.Array
    """f32[B, T]: what the reward is the weighted sum of; T = 1 is the reward itself."""
    next_observation: jax.Array
    """f32[B, O]."""
    terminated: jax.Array
    """f32[B], 1 where the episode ended in a terminal state. A time limit (truncation) is not one."""


class Context(NamedTuple):
    """What the run knows at an update."""

    step: jax.Array | np.int32
    """i32[]: updates made before. Runs that are mapped over share it, so that a period is a branch, not a choice."""
    reward_weights: jax.Array | np.ndarray
    """f32[T]."""
    reward_scale: jax.Array | np.float32
    """f32[]: rewards are divided by it."""
    observation_moments: jax.Array | np.ndarray | None = None
    """f32[2, O]: mean and deviation by which observations are normalised; None where they are not."""


class Trained(NamedTuple):
    """Something that Adam trains."""

    weights: jax.Array
    """f32[...]."""
    moments: Any
    """Adam's: count i32[], mu and nu of the weights' shape."""


class LearnerState(NamedTuple):
    """A pytree of arrays only, of the same shapes for all values of the plain numbers: it can be vmapped over runs,
    donated and saved.
    """

    actor: Trained
    """Weights f32[P]."""
    critic: Trained
    """Weights f32[C, P]."""
    temperature: Trained
    """Weights f32[]: log α. That of a fixed one has moments too, and a learning rate of 0."""
    targets: jax.Array
    """f32[K, C, P]: ring of target networks; `targets.live_slot` says which one follows the critic."""
    entropy_terms: jax.Array
    """f32[W, B]: ring of α·log π of the last W minibatches, from zeros."""
    report: Any
    """f32[M], by name inside an update: what the last one reported. A part that it left out is repeated."""
    key: jax.Array
    """u32[2]: never changes; update t draws from `fold_in(key, t)`."""
