"""A perceptron with batch normalisation, after XQC (Palenicek et al. 2025): of the inputs and of each hidden layer.

    BN -> [Dense without bias -> BN -> non-linearity] per hidden layer -> Dense

While it learns, a batch is normalised by its own mean and variance; while it acts, by the running ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import ACTIVATIONS, Array, Design, Network, orthogonal, project_kernels, split

MOMENTUM = 0.99
EPSILON = 1e-3

Moments = Callable[[int, Array], Any]
"""(number of a normalisation, its input f32[B, W]) -> the mean and variance f32[W] by which it is normalised."""


class Layers(NamedTuple):
    """The parts of the packed vector."""

    kernels: list[Array]
    """f32[inputs, outputs] of each dense layer."""
    last_bias: Array
    affine: list[Array]
    """Scale and bias f32[2, W] of each normalisation."""
    running: list[Array]
    """Running mean and variance f32[2, W] of each normalisation."""


class Shape(NamedTuple):
    """The sizes of a network and its non-linearity."""

    sizes: tuple[int, ...]
    """Inputs, hidden layers, outputs."""
    activation: str

    @property
    def kernels(self) -> list[tuple[int, int]]:
        return list(pairwise(self.sizes))

    @property
    def normalised(self) -> tuple[int, ...]:
        """Widths of the normalisations."""
        return self.sizes[:-1]

    @property
    def packed(self) -> tuple[int, ...]:
        """Sizes of the parts of the packed vector."""
        pairs = tuple(2 * width for width in self.normalised)
        return (*(fan_in * fan_out for fan_in, fan_out in self.kernels), self.sizes[-1], *pairs, *pairs)

    def unpack(self, vector: Array) -> Layers:
        parts, count = split(vector, self.packed), len(self.kernels)
        kernels = [part.reshape(shape) for part, shape in zip(parts[:count], self.kernels, strict=True)]
        pairs = [part.reshape(2, -1) for part in parts[count + 1 :]]
        return Layers(kernels, parts[count], pairs[:count], pairs[count:])


def batch_norm_mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """Kernels start orthogonal (gain √2, that of the last layer 1), biases at 0, scales at 1."""
    shape = Shape((inputs, *hidden_layers, outputs), design.activation)

    def project(vector: jax.Array) -> jax.Array:
        return project_kernels(vector, shape.packed, dict(enumerate(shape.kernels)), design.projection)

    return Network(
        init=lambda key: project(initial(shape, key)),
        apply=partial(apply, shape),
        train=partial(train, shape),
        project=project,
        size=sum(shape.packed),
        statistics=2 * sum(shape.normalised),
    )


def initial(shape: Shape, key: jax.Array) -> jax.Array:
    keys = jax.random.split(key, len(shape.kernels))
    gains = [2**0.5] * (len(keys) - 1) + [1.0]
    kernels = [
        orthogonal(layer_key, kernel, gain).ravel()
        for gain, layer_key, kernel in zip(gains, keys, shape.kernels, strict=True)
    ]
    affine = [jnp.repeat(jnp.array([1.0, 0.0]), width) for width in shape.normalised]
    running = [jnp.repeat(jnp.array([0.0, 1.0]), width) for width in shape.normalised]
    return jnp.concatenate([*kernels, jnp.zeros(shape.sizes[-1]), *affine, *running])


def apply(shape: Shape, vector: Array, *inputs: Array) -> Array:
    """The network as it acts: normalised by the running moments."""
    layers = shape.unpack(vector)
    return forward(shape, layers, inputs, lambda number, x: layers.running[number])


def train(shape: Shape, vector: jax.Array, *inputs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The network as it learns: normalised by the moments of the batch, towards which the running ones move."""
    layers, moved = shape.unpack(vector), []

    def moments(number: int, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean, variance = jnp.mean(x, axis=0), jnp.var(x, axis=0)
        seen = jnp.stack([mean, variance])
        moved.append((MOMENTUM * layers.running[number] + (1 - MOMENTUM) * seen).ravel())
        return mean, variance

    outputs = forward(shape, layers, inputs, moments)
    return outputs, jax.lax.stop_gradient(jnp.concatenate(moved))


def forward(shape: Shape, layers: Layers, inputs: tuple[Array, ...], moments: Moments) -> Array:
    nonlinearity = ACTIVATIONS[shape.activation]
    x = inputs[0].__array_namespace__().concat(inputs, axis=-1)
    for number, kernel in enumerate(layers.kernels):
        x = normalise(x, *moments(number, x), *layers.affine[number])
        x = (x if number == 0 else nonlinearity(x)) @ kernel
    return x + layers.last_bias


def normalise(x: Array, mean: Array, variance: Array, scale: Array, bias: Array) -> Array:
    """(x − mean) / √(variance + ε) · scale + bias, by the last axis."""
    xp: Any = x.__array_namespace__()
    return (x - mean) / xp.sqrt(variance + EPSILON) * scale + bias
