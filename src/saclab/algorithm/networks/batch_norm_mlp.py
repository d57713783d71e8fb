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

from saclab.algorithm.networks.network import ACTIVATIONS, INITIALISATIONS, Array, Design, Network
from saclab.algorithm.networks.packing import Packing, Parts, joined

MOMENTUM = 0.99
EPSILON = 1e-3
LARGEST_RATIO, LARGEST_SHIFT = 3.0, 5.0
"""Bounds of the correction that batch renormalisation makes: r and d of its paper."""
WARM_UPDATES = 100_000
"""Updates of a network before batch renormalisation corrects anything: the running moments must have settled."""

Moments = Callable[[int, Array], Any]
"""(number of a normalisation, its input f32[B, W]) -> the mean and variance f32[W] by which it is normalised."""
MomentsOfBatch = Callable[[jax.Array, jax.Array, jax.Array, Any], tuple[jax.Array, jax.Array]]
"""(mean f32[W], variance f32[W], running moments f32[2, W], updates f32[1]) -> those by which a batch is normalised."""


class Shape(NamedTuple):
    """The sizes of a network, its non-linearity, and how its parts lie in the packed vector."""

    sizes: tuple[int, ...]
    """Inputs, hidden layers, outputs."""
    activation: str
    renormalised: bool
    """Whether it is a `batch_renorm_mlp`: all its layers have biases, and it counts how often it has learnt."""

    @property
    def layers(self) -> list[tuple[int, int]]:
        return list(pairwise(self.sizes))

    @property
    def packing(self) -> Packing:
        numbers, widths = range(len(self.layers)), self.sizes[:-1]
        shapes: dict[str, tuple[int, ...]] = {f"{number} kernel": layer for number, layer in enumerate(self.layers)}
        biased = numbers if self.renormalised else numbers[-1:]
        shapes |= {f"{number} bias": (self.sizes[number + 1],) for number in biased}
        shapes |= {f"{number} affine": (2, width) for number, width in enumerate(widths)}
        shapes |= {f"{number} running": (2, width) for number, width in enumerate(widths)}
        return Packing(shapes | ({"updates": (1,)} if self.renormalised else {}))


def batch_norm_mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """Kernels start orthogonal (gain √2, that of the last layer 1), biases at 0, scales at 1."""
    shape = Shape((inputs, *hidden_layers, outputs), design.activation, renormalised=False)
    return network_of(shape, orthogonal_layers, moments_of_batch, design)


def batch_renorm_mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """Kernels and biases start as those of `mlp`, scales at 1."""
    shape = Shape((inputs, *hidden_layers, outputs), design.activation, renormalised=True)
    return network_of(shape, partial(dense_layers, design.initialisation), renormalised_moments, design)


def network_of(
    shape: Shape, initial: Callable[[Shape, jax.Array], Parts], moments: MomentsOfBatch, design: Design
) -> Network:
    """The network whose kernels and biases start as `initial` says, and whose batches have these `moments`."""
    packing = shape.packing

    def init(key: jax.Array) -> jax.Array:
        parts = {name: jnp.zeros(size) for name, size in packing.shapes.items()} | initial(shape, key)
        for number in range(len(shape.layers)):
            parts[f"{number} affine"] = parts[f"{number} affine"].at[0].set(1)
            parts[f"{number} running"] = parts[f"{number} running"].at[1].set(1)
        return project(packing.pack(parts))

    def project(vector: jax.Array) -> jax.Array:
        if design.projection == "none":
            return vector
        return packing.pack(packing.projected(packing.unpack(vector), design.projection))

    return Network(
        init=init,
        apply=partial(apply, shape),
        train=partial(train, shape, moments),
        project=project,
        size=sum(packing.sizes),
        statistics=2 * sum(shape.sizes[:-1]) + shape.renormalised,
    )


def orthogonal_layers(shape: Shape, key: jax.Array) -> Parts:
    *_, last = shape.packing.kernels
    return shape.packing.orthogonal_kernels(key, gain=lambda name: 1.0 if name == last else 2**0.5)


def dense_layers(initialisation: str, shape: Shape, key: jax.Array) -> Parts:
    parts: Parts = {}
    for number, own in enumerate(jax.random.split(key, len(shape.layers))):
        inputs, outputs = shape.layers[number]
        layer = INITIALISATIONS[initialisation](own, inputs, outputs)
        parts |= {f"{number} kernel": layer[:-outputs].reshape(inputs, outputs), f"{number} bias": layer[-outputs:]}
    return parts


def apply(shape: Shape, vector: Array, *inputs: Array) -> Array:
    """The network as it acts: normalised by the running moments."""
    parts = shape.packing.unpack(vector)
    return forward(shape, parts, inputs, lambda number, x: parts[f"{number} running"])


def train(
    shape: Shape, moments: MomentsOfBatch, vector: jax.Array, *inputs: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The network as it learns: normalised by moments of the batch, towards whose own the running ones move."""
    parts, moved = shape.packing.unpack(vector), []

    def seen(number: int, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean, variance, running = jnp.mean(x, axis=0), jnp.var(x, axis=0), parts[f"{number} running"]
        moved.append(moved_towards(running, mean, variance).ravel())
        return moments(mean, variance, running, parts.get("updates"))

    outputs = forward(shape, parts, inputs, seen)
    counted = [parts["updates"] + 1] if shape.renormalised else []
    return outputs, jax.lax.stop_gradient(jnp.concatenate([*moved, *counted]))


def moved_towards(running: jax.Array, mean: jax.Array, variance: jax.Array) -> jax.Array:
    """Running moments f32[2, W] after a batch with these f32[W]."""
    return MOMENTUM * running + (1 - MOMENTUM) * jnp.stack([mean, variance])


def moments_of_batch(
    mean: jax.Array, variance: jax.Array, running: jax.Array, updates: jax.Array | None
) -> tuple[jax.Array, jax.Array]:
    return mean, variance


def renormalised_moments(
    mean: jax.Array, variance: jax.Array, running: jax.Array, updates: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The batch's moments f32[W], corrected so that a row comes out as by the running ones, as far as the bounds allow.

    The gradient goes through the batch's moments alone. Before `WARM_UPDATES` nothing is corrected.
    """
    running_deviation = jnp.sqrt(running[1] + EPSILON)
    ratio = jnp.clip(jnp.sqrt(variance + EPSILON) / running_deviation, 1 / LARGEST_RATIO, LARGEST_RATIO)
    shift = jnp.clip((mean - running[0]) / running_deviation, -LARGEST_SHIFT, LARGEST_SHIFT)
    ratio, shift = jax.lax.stop_gradient((ratio, shift))
    warm = updates >= WARM_UPDATES
    deviation = jnp.sqrt(jnp.maximum(variance, 1e-12))  # of rows that are all alike it would have an endless slope
    corrected = mean - shift * deviation / ratio
    return jnp.where(warm, corrected, mean), jnp.where(warm, variance / ratio**2, variance)


def forward(shape: Shape, parts: dict[str, Array], inputs: tuple[Array, ...], moments: Moments) -> Array:
    nonlinearity, last = ACTIVATIONS[shape.activation], len(shape.layers) - 1

    def normalised(number: int, x: Array) -> Array:
        return normalise(x, moments(number, x), parts[f"{number} affine"], EPSILON)

    x = normalised(0, joined(inputs))
    for number in range(last):
        x = x @ parts[f"{number} kernel"]
        if shape.renormalised:
            x = normalised(number + 1, nonlinearity(x + parts[f"{number} bias"]))
        else:
            x = nonlinearity(normalised(number + 1, x))
    return x @ parts[f"{last} kernel"] + parts[f"{last} bias"]


def normalise(x: Array, moments: Any, affine: Any, epsilon: float) -> Array:
    """(x − mean) / √(variance + ε) · scale + bias, by the last axis; two pairs of f32[W]."""
    (mean, variance), (scale, bias), xp = moments, affine, x.__array_namespace__()
    normalised: Array = (x - mean) / xp.sqrt(variance + epsilon) * scale + bias
    return normalised
