"""The temperature α: fixed, or learned by dual descent (Eq. 8). Each is a pair of pure functions on log α."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from saclab.algorithm.numbers import Numbers
from saclab.config import AlgorithmSettings


class Temperature(NamedTuple):
    init: Callable[[jax.Array], optax.OptState]
    """log α -> optimizer state."""
    update: Callable[[jax.Array, optax.OptState, jax.Array], tuple[jax.Array, optax.OptState, jax.Array]]
    """(log α, optimizer state, log π f32[B]) -> (log α, optimizer state, loss f32[])."""


def fixed(settings: AlgorithmSettings, numbers: Numbers) -> Temperature:
    """α never changes."""
    return Temperature(
        init=lambda log_alpha: optax.EmptyState(),
        update=lambda log_alpha, state, log_prob: (log_alpha, state, jnp.zeros_like(log_alpha)),
    )


def learned(settings: AlgorithmSettings, numbers: Numbers) -> Temperature:
    """Adam on log α; the loss is (log α or α) · mean(−log π − target entropy)   (Eq. 8)."""
    optimizer = optax.adam(numbers.temperature_learning_rate)
    factor = {"log_alpha": lambda log_alpha: log_alpha, "alpha": jnp.exp}[settings.temperature_gradient]

    def loss(log_alpha: jax.Array, log_prob: jax.Array) -> jax.Array:
        return jnp.multiply(factor(log_alpha), jnp.mean(-log_prob - numbers.target_entropy))

    def update(
        log_alpha: jax.Array, state: optax.OptState, log_prob: jax.Array
    ) -> tuple[jax.Array, optax.OptState, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(log_alpha, jax.lax.stop_gradient(log_prob))
        change, state = optimizer.update(gradient, state)
        return log_alpha + change, state, value

    return Temperature(optimizer.init, update)


def either(settings: AlgorithmSettings, numbers: Numbers) -> Temperature:
    """Fixed or learned as `numbers.temperature_learned` says, which may be traced: for runs of one batch."""
    never, always = fixed(settings, numbers), learned(settings, numbers)

    def update(
        log_alpha: jax.Array, state: optax.OptState, log_prob: jax.Array
    ) -> tuple[jax.Array, optax.OptState, jax.Array]:
        constant, _, no_loss = never.update(log_alpha, state, log_prob)
        chosen: tuple[jax.Array, optax.OptState, jax.Array] = jax.tree.map(
            partial(jnp.where, numbers.temperature_learned),
            always.update(log_alpha, state, log_prob),
            (constant, state, no_loss),
        )
        return chosen

    return Temperature(always.init, update)


TEMPERATURES: dict[str, Callable[[AlgorithmSettings, Numbers], Temperature]] = {
    "fixed": fixed, "learned": learned, "either": either,
}  # fmt: skip
