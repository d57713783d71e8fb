"""The temperature α: fixed, or learned by dual descent (Eq. 8). Both are a pair of pure functions on log α."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from saclab.config import AlgorithmSettings


class Temperature(NamedTuple):
    init: Callable[[jax.Array], optax.OptState]
    """log α -> optimizer state."""
    update: Callable[[jax.Array, optax.OptState, jax.Array], tuple[jax.Array, optax.OptState, jax.Array]]
    """(log α, optimizer state, log π f32[B]) -> (log α, optimizer state, loss f32[])."""


def fixed(settings: AlgorithmSettings, action_size: int) -> Temperature:
    """α never changes."""
    return Temperature(
        init=lambda log_alpha: optax.EmptyState(),
        update=lambda log_alpha, state, log_prob: (log_alpha, state, jnp.zeros_like(log_alpha)),
    )


def learned(settings: AlgorithmSettings, action_size: int) -> Temperature:
    """Adam on log α; the loss is (log α or α) · mean(−log π − target entropy)   (Eq. 8)."""
    target_entropy = -float(action_size) if settings.target_entropy is None else settings.target_entropy
    optimizer = optax.adam(settings.temperature_learning_rate)
    factor = {"log_alpha": lambda log_alpha: log_alpha, "alpha": jnp.exp}[settings.temperature_gradient]

    def loss(log_alpha: jax.Array, log_prob: jax.Array) -> jax.Array:
        return jnp.multiply(factor(log_alpha), jnp.mean(-log_prob - target_entropy))

    def update(
        log_alpha: jax.Array, state: optax.OptState, log_prob: jax.Array
    ) -> tuple[jax.Array, optax.OptState, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(log_alpha, jax.lax.stop_gradient(log_prob))
        change, state = optimizer.update(gradient, state)
        return log_alpha + change, state, value

    return Temperature(optimizer.init, update)


TEMPERATURES: dict[str, Callable[[AlgorithmSettings, int], Temperature]] = {"fixed": fixed, "learned": learned}
