"""Networks whose inputs are normalised by moments that they are given.

The moments are the last numbers of the packed vector, behind the network's own: what has the parameters has the
normalisation. Actions are part of a Q-network's inputs and stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import Array, Network


def normalised_inputs(network: Network, inputs: int) -> Network:
    """`network` on (inputs − mean) / deviation; they start as 0 and 1."""

    def normalise(moments: Array, parts: tuple[Array, ...]) -> list[Array]:
        mean, deviation = moments.reshape(2, inputs)
        ends = accumulate(part.shape[-1] for part in parts)
        places = [slice(end - part.shape[-1], end) for part, end in zip(parts, ends, strict=True)]
        return [(part - mean[place]) / deviation[place] for part, place in zip(parts, places, strict=True)]

    def init(key: jax.Array) -> jax.Array:
        return jnp.concatenate([network.init(key), jnp.repeat(jnp.array([0.0, 1.0]), inputs)])

    def apply(vector: Array, *parts: Array) -> Array:
        return network.apply(vector[: network.size], *normalise(vector[network.size :], parts))

    def train(vector: jax.Array, *parts: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        given = jax.lax.stop_gradient(vector[network.size :])
        outputs, statistics = network.train(vector[: network.size], *normalise(given, parts), key=key)
        return outputs, jnp.concatenate([statistics, given])

    def project(vector: jax.Array) -> jax.Array:
        return jnp.concatenate([network.project(vector[: network.size]), vector[network.size :]])

    return Network(init, apply, train, project, network.size + 2 * inputs, network.statistics + 2 * inputs)


INPUT_NORMALISATIONS: dict[str, Callable[[Network, int], Network]] = {
    "none": lambda network, inputs: network,
    "running": normalised_inputs,
}
"""Name -> (network, inputs) -> network."""


def with_moments(vectors: jax.Array, inputs: int, moments: Array) -> jax.Array:
    """Packed vectors f32[..., P] of networks with normalised inputs that have these moments from now on.

    Args:
        vectors: of networks of `inputs` inputs, the observation first.
        inputs: the observation's size, and of a Q-network the action's too.
        moments: mean and deviation f32[2, O].
    """
    actions = inputs - moments.shape[1]
    every = jnp.concatenate([moments, jnp.repeat(jnp.array([[0.0], [1.0]]), actions, axis=1)], axis=1).ravel()
    return vectors.at[..., -2 * inputs :].set(every)
