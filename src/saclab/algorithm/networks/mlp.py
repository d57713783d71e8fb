"""A multi-layer perceptron."""

from __future__ import annotations

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.networks.network import ACTIVATIONS, Array, Network, product, project_kernels, split


def mlp(
    inputs: int, hidden_layers: tuple[int, ...], outputs: int, activation: str, projection: str = "none"
) -> Network:
    """Weights and biases start uniform in ±1/√inputs of the layer, as PyTorch's do."""
    layers = list(pairwise((inputs, *hidden_layers, outputs)))
    sizes = tuple(part for fan_in, fan_out in layers for part in (fan_in * fan_out, fan_out))
    nonlinearity = ACTIVATIONS[activation]

    def init(key: jax.Array) -> jax.Array:
        parts = []
        for layer_key, (fan_in, fan_out) in zip(jax.random.split(key, len(layers)), layers, strict=True):
            bound = 1 / np.sqrt(fan_in)
            parts.append(jax.random.uniform(layer_key, ((fan_in + 1) * fan_out,), minval=-bound, maxval=bound))
        return project(jnp.concatenate(parts))

    def apply(vector: Array, *inputs: Array) -> Array:
        parts = iter(split(vector, sizes))
        x: tuple[Array, ...] = inputs
        for fan_in, fan_out in layers[:-1]:
            x = (nonlinearity(product(x, next(parts).reshape(fan_in, fan_out)) + next(parts)),)
        return product(x, next(parts).reshape(layers[-1])) + next(parts)

    def train(vector: jax.Array, *inputs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return apply(vector, *inputs), jnp.zeros(0, vector.dtype)

    def project(vector: jax.Array) -> jax.Array:
        kernels = {2 * number: shape for number, shape in enumerate(layers)}
        return project_kernels(vector, sizes, kernels, projection)

    return Network(init, apply, train, project, sum(sizes))
