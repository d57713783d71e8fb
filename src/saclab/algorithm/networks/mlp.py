"""A multi-layer perceptron."""

from __future__ import annotations

from itertools import pairwise

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import (
    ACTIVATIONS,
    INITIALISATIONS,
    Array,
    Design,
    Network,
    product,
    project_kernels,
    split,
)


def mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """[Dense -> non-linearity] per hidden layer -> Dense."""
    layers = list(pairwise((inputs, *hidden_layers, outputs)))
    sizes = tuple(part for fan_in, fan_out in layers for part in (fan_in * fan_out, fan_out))
    nonlinearity = ACTIVATIONS[design.activation]
    initial = INITIALISATIONS[design.initialisation]

    def init(key: jax.Array) -> jax.Array:
        keys = jax.random.split(key, len(layers))
        return project(jnp.concatenate([initial(own, *shape) for own, shape in zip(keys, layers, strict=True)]))

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
        return project_kernels(vector, sizes, kernels, design.projection)

    return Network(init, apply, train, project, sum(sizes))
