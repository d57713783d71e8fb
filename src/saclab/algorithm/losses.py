"""The two losses of SAC, as functions of numbers: no network appears here."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def critic_target(reward: jax.Array, terminated: jax.Array, next_value: jax.Array, discount: float) -> jax.Array:
    """R + γ V(s′), without V(s′) after a terminal state (Eq. 3): f32[B] from three f32[B]."""
    return reward + discount * (1 - terminated) * next_value


def critic_loss(q: jax.Array, target: jax.Array) -> jax.Array:
    """Mean of ½ (Q(s, a) − target)², summed over the critics (Eq. 3): f32[] from f32[C, B] and f32[B]."""
    return jnp.sum(jnp.mean(0.5 * jnp.square(q - target[None, :]), axis=1))


def actor_loss(log_prob: jax.Array, q: jax.Array, alpha: jax.Array) -> jax.Array:
    """Mean of α log π(a|s) − Q(s, a) (Eq. 5): f32[] from f32[B], f32[B] and f32[]."""
    return jnp.mean(alpha * log_prob - q)
