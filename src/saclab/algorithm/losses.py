"""The losses of SAC, as functions of numbers: no network appears here. That of the critics is their head's (Eq. 3)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp


def actor_loss(log_prob: jax.Array, q: jax.Array, alpha: jax.Array) -> jax.Array:
    """Mean of α log π(a|s) − Q(s, a) (Eq. 5): f32[] from f32[B], f32[B] and f32[]."""
    return jnp.mean(alpha * log_prob - q)


def temperature_loss(log_alpha: jax.Array, entropy: jax.Array, target_entropy: jax.Array, factor: str) -> jax.Array:
    """(log α or α) · (entropy − target entropy) (Eq. 8): f32[] from three f32[]; `factor` is a key of FACTORS."""
    return FACTORS[factor](log_alpha) * (entropy - target_entropy)


FACTORS: dict[str, Callable[[jax.Array], jax.Array]] = {"log_alpha": lambda log_alpha: log_alpha, "alpha": jnp.exp}
