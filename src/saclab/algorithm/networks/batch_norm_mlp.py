"""A perceptron with batch normalisation, after XQC (Palenicek et al. 2025): of the inputs and of each hidden layer.

    BN -> [Dense without bias -> BN -> non-linearity] per hidden layer -> Dense

While it learns, a batch is normalised by its own mean and variance; while it acts, by the running ones.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import ACTIVATIONS, Array, Network, split, unit_columns

MOMENTUM = 0.99
EPSILON = 1e-3


def normalise(x: Array, mean: Array, variance: Array, scale: Array, bias: Array) -> Array:
    """(x − mean) / √(variance + ε) · scale + bias, by the last axis."""
    xp: Any = x.__array_namespace__()
    return (x - mean) / xp.sqrt(variance + EPSILON) * scale + bias


def batch_norm_mlp(
    inputs: int, hidden_layers: tuple[int, ...], outputs: int, activation: str, projection: str = "none"
) -> Network:
    """Kernels start orthogonal (gain √2, that of the last layer 1), biases at 0, scales at 1."""
    kernels = list(pairwise((inputs, *hidden_layers, outputs)))
    widths = (inputs, *hidden_layers)  # of the normalisations
    sizes = (
        *(fan_in * fan_out for fan_in, fan_out in kernels), outputs,
        *(2 * width for width in widths), *(2 * width for width in widths),
    )  # fmt: skip
    count, statistics = len(kernels), 2 * sum(widths)
    nonlinearity = ACTIVATIONS[activation]

    def parts_of(vector: Array) -> tuple[list[Array], Array, list[Array], list[Array]]:
        """Kernels, the last bias, scale and bias f32[2, W] and running mean and variance f32[2, W] of each layer."""
        parts = split(vector, sizes)
        pairs = [part.reshape(2, -1) for part in parts[count + 1 :]]
        weights = [part.reshape(shape) for part, shape in zip(parts[:count], kernels, strict=True)]
        return weights, parts[count], pairs[:count], pairs[count:]

    def init(key: jax.Array) -> jax.Array:
        keys = jax.random.split(key, count)
        gains = [2**0.5] * (count - 1) + [1.0]
        weights = [
            jax.nn.initializers.orthogonal(gain)(layer_key, shape, jnp.float32).ravel()
            for gain, layer_key, shape in zip(gains, keys, kernels, strict=True)
        ]
        affine = [jnp.concatenate([jnp.ones(width), jnp.zeros(width)]) for width in widths]
        running = [jnp.concatenate([jnp.zeros(width), jnp.ones(width)]) for width in widths]
        return project(jnp.concatenate([*weights, jnp.zeros(outputs), *affine, *running]))

    def forward(vector: Array, inputs: tuple[Array, ...], moments: Any) -> Array:
        """`moments(layer, x)` gives the mean and variance f32[W] by which a layer is normalised."""
        weights, last_bias, affine, _ = parts_of(vector)
        x = inputs[0].__array_namespace__().concat(inputs, axis=-1)
        for layer in range(count):
            x = normalise(x, *moments(layer, x), *affine[layer])
            x = (x if layer == 0 else nonlinearity(x)) @ weights[layer]
        return x + last_bias

    def apply(vector: Array, *inputs: Array) -> Array:
        running = parts_of(vector)[3]
        return forward(vector, inputs, lambda layer, x: running[layer])

    def train(vector: jax.Array, *inputs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        running, moved = parts_of(vector)[3], []

        def moments(layer: int, x: jax.Array) -> tuple[jax.Array, jax.Array]:
            mean, variance = jnp.mean(x, axis=0), jnp.var(x, axis=0)
            seen = jax.lax.stop_gradient(jnp.stack([mean, variance]))
            moved.append((MOMENTUM * running[layer] + (1 - MOMENTUM) * seen).ravel())
            return mean, variance

        outputs = forward(vector, inputs, moments)
        return outputs, jax.lax.stop_gradient(jnp.concatenate(moved))

    def project(vector: jax.Array) -> jax.Array:
        if projection == "none":
            return vector
        parts = split(vector, sizes)
        for number, shape in enumerate(kernels):
            parts[number] = unit_columns(parts[number].reshape(shape)).ravel()
        return jnp.concatenate(parts)

    return Network(init, apply, train, project, sum(sizes), statistics)
