"""Perceptrons with batch normalisation of the inputs and of each hidden layer.

`batch_norm_mlp`, after XQC (Palenicek et al. 2025):

    BN -> [Dense without bias -> BN -> non-linearity] per hidden layer -> Dense

`batch_renorm_mlp`, after CrossQ (Bhatt et al. 2024), whose normalisation is batch renormalisation (Ioffe 2017):

    BRN -> [Dense -> non-linearity -> BRN] per hidden layer -> Dense

While a network learns, a batch is normalised by its own mean and variance; while it acts, by the running ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import (
    ACTIVATIONS,
    INITIALISATIONS,
    Array,
    Design,
    Network,
    orthogonal,
    project_kernels,
    split,
)

MOMENTUM = 0.99
EPSILON = 1e-3
LARGEST_RATIO, LARGEST_SHIFT = 3.0, 5.0
"""Bounds of the correction that batch renormalisation makes: r and d of its paper."""
WARM_UPDATES = 100_000
"""Updates of a network before batch renormalisation corrects anything: the running moments must have settled."""

Moments = Callable[[int, Array], Any]
"""(number of a normalisation, its input f32[B, W]) -> the mean and variance f32[W] by which it is normalised."""


class Layers(NamedTuple):
    """The parts of the packed vector."""

    kernels: list[Array]
    """f32[inputs, outputs] of each dense layer."""
    biases: list[Array]
    """f32[outputs] of each dense layer that has one."""
    affine: list[Array]
    """Scale and bias f32[2, W] of each normalisation."""
    running: list[Array]
    """Running mean and variance f32[2, W] of each normalisation."""
    updates: list[Array]
    """f32[1]: how often the network has learnt, if it renormalises."""


class Shape(NamedTuple):
    """The sizes of a network and its non-linearity."""

    sizes: tuple[int, ...]
    """Inputs, hidden layers, outputs."""
    activation: str
    renormalised: bool
    """Whether it is a `batch_renorm_mlp`."""

    @property
    def kernels(self) -> list[tuple[int, int]]:
        return list(pairwise(self.sizes))

    @property
    def biases(self) -> tuple[int, ...]:
        return self.sizes[1:] if self.renormalised else self.sizes[-1:]

    @property
    def normalised(self) -> tuple[int, ...]:
        """Widths of the normalisations."""
        return self.sizes[:-1]

    @property
    def statistics(self) -> int:
        return 2 * sum(self.normalised) + self.renormalised

    @property
    def packed(self) -> tuple[int, ...]:
        """Sizes of the parts of the packed vector."""
        kernels, pairs = [i * o for i, o in self.kernels], [2 * width for width in self.normalised]
        return (*kernels, *self.biases, *pairs, *pairs, *[1] * self.renormalised)

    def unpack(self, vector: Array) -> Layers:
        parts = iter(split(vector, self.packed))

        def take(count: int) -> list[Array]:
            return [next(parts) for _ in range(count)]

        count = len(self.kernels)
        kernels = [part.reshape(shape) for part, shape in zip(take(count), self.kernels, strict=True)]
        biases = take(len(self.biases))
        pairs = [part.reshape(2, -1) for part in take(2 * count)]
        return Layers(kernels, biases, pairs[:count], pairs[count:], list(parts))


def batch_norm_mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """Kernels start orthogonal (gain √2, that of the last layer 1), biases at 0, scales at 1."""
    shape = Shape((inputs, *hidden_layers, outputs), design.activation, renormalised=False)
    return network_of(shape, orthogonal_layers, moments_of_batch, design)


def batch_renorm_mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """Kernels and biases start as those of `mlp`, scales at 1."""
    shape = Shape((inputs, *hidden_layers, outputs), design.activation, renormalised=True)
    return network_of(shape, partial(dense_layers, design.initialisation), renormalised_moments, design)


def network_of(shape: Shape, initial: Callable[..., list[jax.Array]], moments: Any, design: Design) -> Network:
    """The network whose kernels and biases start as `initial` says, and whose batches have these `moments`."""

    def init(key: jax.Array) -> jax.Array:
        affine = [jnp.repeat(jnp.array([1.0, 0.0]), width) for width in shape.normalised]
        running = [jnp.repeat(jnp.array([0.0, 1.0]), width) for width in shape.normalised]
        updates = [jnp.zeros(1)] * shape.renormalised
        return project(jnp.concatenate([*initial(shape, key), *affine, *running, *updates]))

    def project(vector: jax.Array) -> jax.Array:
        return project_kernels(vector, shape.packed, dict(enumerate(shape.kernels)), design.projection)

    return Network(
        init=init,
        apply=partial(apply, shape),
        train=partial(train, shape, moments),
        project=project,
        size=sum(shape.packed),
        statistics=shape.statistics,
    )


def orthogonal_layers(shape: Shape, key: jax.Array) -> list[jax.Array]:
    keys = jax.random.split(key, len(shape.kernels))
    gains = [2**0.5] * (len(keys) - 1) + [1.0]
    kernels = [
        orthogonal(layer_key, kernel, gain).ravel()
        for gain, layer_key, kernel in zip(gains, keys, shape.kernels, strict=True)
    ]
    return [*kernels, jnp.zeros(sum(shape.biases))]


def dense_layers(initialisation: str, shape: Shape, key: jax.Array) -> list[jax.Array]:
    keys = jax.random.split(key, len(shape.kernels))
    layers = [INITIALISATIONS[initialisation](own, *kernel) for own, kernel in zip(keys, shape.kernels, strict=True)]
    ends = [inputs * outputs for inputs, outputs in shape.kernels]
    kernels = [layer[:end] for layer, end in zip(layers, ends, strict=True)]
    return kernels + [layer[end:] for layer, end in zip(layers, ends, strict=True)]


def apply(shape: Shape, vector: Array, *inputs: Array) -> Array:
    """The network as it acts: normalised by the running moments."""
    layers = shape.unpack(vector)
    return forward(shape, layers, inputs, lambda number, x: layers.running[number])


def train(
    shape: Shape, moments: Any, vector: jax.Array, *inputs: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The network as it learns: normalised by moments of the batch, towards whose own the running ones move."""
    layers, moved = shape.unpack(vector), []

    def seen(number: int, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean, variance = jnp.mean(x, axis=0), jnp.var(x, axis=0)
        running = layers.running[number]
        moved.append((MOMENTUM * running + (1 - MOMENTUM) * jnp.stack([mean, variance])).ravel())
        found: tuple[jax.Array, jax.Array] = moments(mean, variance, running, layers.updates)
        return found

    outputs = forward(shape, layers, inputs, seen)
    counted = [updates + 1 for updates in layers.updates]
    return outputs, jax.lax.stop_gradient(jnp.concatenate([*moved, *counted]))


def moments_of_batch(
    mean: jax.Array, variance: jax.Array, running: jax.Array, updates: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    return mean, variance


def renormalised_moments(
    mean: jax.Array, variance: jax.Array, running: jax.Array, updates: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """The batch's moments f32[W], corrected so that a row comes out as by the running ones, as far as the bounds allow.

    The gradient goes through the batch's moments alone. Before `WARM_UPDATES` nothing is corrected.
    """
    running_deviation = jnp.sqrt(running[1] + EPSILON)
    ratio = jnp.clip(jnp.sqrt(variance + EPSILON) / running_deviation, 1 / LARGEST_RATIO, LARGEST_RATIO)
    shift = jnp.clip((mean - running[0]) / running_deviation, -LARGEST_SHIFT, LARGEST_SHIFT)
    ratio, shift = jax.lax.stop_gradient((ratio, shift))
    warm = updates[0] >= WARM_UPDATES
    deviation = jnp.sqrt(jnp.maximum(variance, 1e-12))  # of rows that are all alike it would have an endless slope
    corrected = mean - shift * deviation / ratio
    return jnp.where(warm, corrected, mean), jnp.where(warm, variance / ratio**2, variance)


def forward(shape: Shape, layers: Layers, inputs: tuple[Array, ...], moments: Moments) -> Array:
    nonlinearity = ACTIVATIONS[shape.activation]

    def normalised(number: int, x: Array) -> Array:
        return normalise(x, *moments(number, x), *layers.affine[number])

    x = normalised(0, inputs[0].__array_namespace__().concat(inputs, axis=-1))
    for number, kernel in enumerate(layers.kernels[:-1]):
        if shape.renormalised:
            x = normalised(number + 1, nonlinearity(x @ kernel + layers.biases[number]))
        else:
            x = nonlinearity(normalised(number + 1, x @ kernel))
    return x @ layers.kernels[-1] + layers.biases[-1]


def normalise(x: Array, mean: Array, variance: Array, scale: Array, bias: Array) -> Array:
    """(x − mean) / √(variance + ε) · scale + bias, by the last axis."""
    xp: Any = x.__array_namespace__()
    return (x - mean) / xp.sqrt(variance + EPSILON) * scale + bias
