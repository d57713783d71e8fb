"""What a Q-network predicts: a number, a distribution over values, or quantiles of one.

C: critics, n: outputs of a head, m: numbers of a target, which is n unless the critics were pooled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.networks.network import Array
from saclab.settings import AlgorithmSettings


class CriticHead(NamedTuple):
    """Pure functions on the outputs f32[..., n] of a Q-network; the first two take NumPy arrays too."""

    outputs: int
    """n."""
    prediction: Callable[[Array], Array]
    """f32[..., n] -> f32[..., n]: what critics are reduced by and snapshots averaged over."""
    mean: Callable[[Array], Array]
    """Prediction f32[..., n] -> Q f32[...]."""
    backup: Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]
    """(prediction of the next state f32[B, m], reward f32[B], discount f32[B], entropy term f32[B]) -> the prediction
    f32[B, m] that R + γ (Z(s′, a′) − α log π) has. `discount` is 0 after a terminal state."""
    loss: Callable[[jax.Array, jax.Array], jax.Array]
    """(outputs f32[C, B, n], target f32[B, m]) -> f32[], summed over the critics."""


def scalar(settings: AlgorithmSettings) -> CriticHead:
    """Q itself; the loss is the mean of ½ (Q(s, a) − target)² (Eq. 3)."""

    def backup(prediction: jax.Array, reward: jax.Array, discount: jax.Array, entropy_term: jax.Array) -> jax.Array:
        return (reward + discount * (prediction[:, 0] - entropy_term))[:, None]

    def loss(outputs: jax.Array, target: jax.Array) -> jax.Array:
        return jnp.sum(jnp.mean(0.5 * jnp.square(outputs - target[None])[..., 0], axis=1))

    return CriticHead(1, lambda outputs: outputs, lambda prediction: prediction[..., 0], backup, loss)


def categorical(settings: AlgorithmSettings) -> CriticHead:
    """Probabilities of evenly spaced values; the loss is the cross-entropy (Bellemare et al. 2017, C51)."""
    atoms, bound = settings.critic_atoms, settings.critic_bound
    values = np.linspace(-bound, bound, atoms, dtype=np.float32)
    spacing = 2 * bound / (atoms - 1)

    def prediction(outputs: Array) -> Array:
        """Softmax."""
        xp = outputs.__array_namespace__()
        weights = xp.exp(outputs - xp.max(outputs, axis=-1, keepdims=True))
        return weights / xp.sum(weights, axis=-1, keepdims=True)

    def backup(probability: jax.Array, reward: jax.Array, discount: jax.Array, entropy_term: jax.Array) -> jax.Array:
        """The moved values are clipped to the bounds, and each gives its probability to its two neighbours."""
        moved = reward[:, None] + discount[:, None] * (values[None] - entropy_term[:, None])  # f32[B, n]
        moved = jnp.clip(moved, -bound, bound)
        distance = jnp.abs(moved[:, :, None] - values) / spacing  # f32[B, n, n], in spacings
        return jnp.einsum("bi,bij->bj", probability, jnp.maximum(1 - distance, 0))

    def loss(outputs: jax.Array, target: jax.Array) -> jax.Array:
        return jnp.sum(jnp.mean(-jnp.sum(target[None] * jax.nn.log_softmax(outputs, axis=-1), axis=-1), axis=1))

    return CriticHead(atoms, prediction, lambda probability: probability @ values, backup, loss)


def quantile(settings: AlgorithmSettings) -> CriticHead:
    """Quantiles at the levels (i + ½)/n; the loss is that of QR-DQN with κ = 1 (Dabney et al. 2018)."""
    levels = (np.arange(settings.critic_atoms, dtype=np.float32) + np.float32(0.5)) / np.float32(settings.critic_atoms)

    def mean(quantiles: Array) -> Array:
        return quantiles.__array_namespace__().mean(quantiles, axis=-1)

    def backup(quantiles: jax.Array, reward: jax.Array, discount: jax.Array, entropy_term: jax.Array) -> jax.Array:
        return reward[:, None] + discount[:, None] * (quantiles - entropy_term[:, None])

    def loss(outputs: jax.Array, target: jax.Array) -> jax.Array:
        """The mean over the batch and all pairs of a quantile and a number of the target."""
        error = target[None, :, None, :] - outputs[..., None]  # f32[C, B, n, m]
        size = jnp.abs(error)
        huber = jnp.where(size > 1, size - 0.5, 0.5 * error * error)
        weight = jnp.where(error < 0, 1 - levels[:, None], levels[:, None])
        return jnp.sum(jnp.mean(weight * huber, axis=(1, 2, 3)))

    return CriticHead(settings.critic_atoms, lambda outputs: outputs, mean, backup, loss)


HEADS: dict[str, Callable[[AlgorithmSettings], CriticHead]] = {
    "scalar": scalar,
    "categorical": categorical,
    "quantile": quantile,
}
