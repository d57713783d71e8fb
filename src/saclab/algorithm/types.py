"""The types that carry the data. B: batch, O: observation, A: action, C: critics, K: target snapshots,
W: entropy window, P: parameters of one network, packed into one vector.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import optax


class Batch(NamedTuple):
    """Transitions drawn from replay."""

    observation: jax.Array
    """f32[B, O]."""
    action: jax.Array
    """f32[B, A] in [-1, 1]."""
    reward: jax.Array
    """f32[B]."""
    next_observation: jax.Array
    """f32[B, O]."""
    terminated: jax.Array
    """f32[B], 1 where the episode ended in a terminal state. A time limit (truncation) is not one."""


class TargetState(NamedTuple):
    """What the next state's value is computed from, beside the actor."""

    snapshots: jax.Array
    """f32[K, C, P]: ring of target networks; `targets.live_slot` says which one follows the critic."""
    entropy_terms: jax.Array
    """f32[W, B]: ring of α·log π of the last W minibatches, from zeros."""


class Optimizers(NamedTuple):
    """Adam's moments for each thing that is trained."""

    actor: optax.OptState
    critic: optax.OptState
    temperature: optax.OptState


class LearnerState(NamedTuple):
    """A pytree of arrays only: it can be vmapped over runs, donated and saved."""

    actor: jax.Array
    """f32[P]."""
    critic: jax.Array
    """f32[C, P]."""
    target: TargetState
    log_alpha: jax.Array
    """f32[]: logarithm of the temperature."""
    optimizers: Optimizers
    key: jax.Array
    """u32[2]: never changes; update t draws from `fold_in(key, t)`."""
    step: jax.Array
    """i32[]: updates made."""


class Metrics(NamedTuple):
    """What one update reports; each f32[]."""

    critic_loss: jax.Array
    """Eq. 3, summed over the critics."""
    actor_loss: jax.Array
    """Eq. 5: the paper's policy loss."""
    temperature_loss: jax.Array
    """Eq. 8; 0 if the temperature is fixed."""
    temperature: jax.Array
    """α used in this update."""
    entropy: jax.Array
    """Mean of −log π over the batch, in nats, for actions in [-1, 1]."""
    q_mean: jax.Array
    """Mean of the critics on the batch's actions."""
    q_spread: jax.Array
    """Mean over the batch of the standard deviation between critics."""
    target_mean: jax.Array
    """Mean of the critics' regression target."""
    snapshot_spread: jax.Array
    """Mean over the batch of the standard deviation between the K snapshots' values; 0 for K = 1."""
