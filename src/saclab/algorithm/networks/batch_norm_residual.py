"""A residual network with batch normalisation whose weights keep their lengths, after FlashSAC:

    BN -> Dense -> [x + (Dense -> BN -> non-linearity -> Dense -> BN -> non-linearity)(x)] per hidden layer -> RMSNorm
    -> Dense with bias

The inner width of a block is four times its outer one; only the last dense layer has a bias. While the network learns,
a batch is normalised by its own mean and variance; while it acts, by the running ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.batch_norm_mlp import moved_towards, normalise
from saclab.algorithm.networks.network import ACTIVATIONS, Array, Design, Network
from saclab.algorithm.networks.packing import Packing, joined

EXPANSION = 4
EPSILON = 1e-5
RMS_EPSILON = 1e-6


def batch_norm_residual(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """One block per hidden layer, all of one width. Kernels start orthogonal, scales at 1, biases at 0."""
    width, blocks = hidden_layers[0], len(hidden_layers)
    normalised = {"inputs": inputs}
    kernels = {"inputs kernel": (inputs, width)}
    for block in range(blocks):
        normalised |= {f"{block} wide": EXPANSION * width, f"{block} narrow": width}
        kernels |= {
            f"{block} wide kernel": (width, EXPANSION * width),
            f"{block} narrow kernel": (EXPANSION * width, width),
        }
    affine = {f"{name} affine": (2, size) for name, size in normalised.items()}
    running = {f"{name} running": (2, size) for name, size in normalised.items()}
    rest = {"rms scale": (width,), "outputs kernel": (width, outputs), "outputs bias": (outputs,)}
    packing = Packing({**kernels, **rest, **affine, **running})
    nonlinearity = ACTIVATIONS[design.activation]

    def init(key: jax.Array) -> jax.Array:
        parts = {name: jnp.zeros(shape) for name, shape in packing.shapes.items()}
        parts |= packing.orthogonal_kernels(key) | {"rms scale": jnp.ones(width)}
        parts |= {name: parts[name].at[0].set(1) for name in affine} | {
            name: parts[name].at[1].set(1) for name in running
        }
        return project(packing.pack(parts))

    def apply(vector: Array, *inputs: Array) -> Array:
        parts = packing.unpack(vector)
        return forward(parts, blocks, nonlinearity, joined(inputs), lambda name, x: parts[f"{name} running"])

    def train(vector: jax.Array, *inputs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        parts, moved = packing.unpack(vector), {}

        def seen(name: str, x: jax.Array) -> tuple[jax.Array, jax.Array]:
            mean, variance, rows = jnp.mean(x, axis=0), jnp.var(x, axis=0), len(x)
            unbiased = variance * (rows / max(1, rows - 1))
            moved[name] = moved_towards(parts[f"{name} running"], mean, unbiased)
            return mean, variance

        y = forward(parts, blocks, nonlinearity, joined(inputs), seen)
        return y, jax.lax.stop_gradient(jnp.concatenate([moved[name].ravel() for name in normalised]))

    def project(vector: jax.Array) -> jax.Array:
        if design.projection == "none":
            return vector
        parts = packing.projected(packing.unpack(vector), design.projection)
        for name in ("rms scale", *affine):
            parts[name] = unit_mean_square(parts[name])
        return packing.pack(parts)

    return Network(init, apply, train, project, sum(packing.sizes), 2 * sum(normalised.values()))


def forward(
    parts: dict[str, Array], blocks: int, nonlinearity: Callable[[Array], Array], x: Array, moments: Callable[..., Any]
) -> Array:
    """The network f32[B, outputs] on f32[B, I], each normalisation by the mean and variance that `moments` gives."""
    xp: Any = x.__array_namespace__()

    def normalised(name: str, x: Array) -> Array:
        return normalise(x, moments(name, x), parts[f"{name} affine"], EPSILON)

    x = normalised("inputs", x) @ parts["inputs kernel"]
    for block in range(blocks):
        wide = nonlinearity(normalised(f"{block} wide", x @ parts[f"{block} wide kernel"]))
        x = x + nonlinearity(normalised(f"{block} narrow", wide @ parts[f"{block} narrow kernel"]))
    x = x / xp.sqrt(xp.mean(x * x, axis=-1, keepdims=True) + RMS_EPSILON) * parts["rms scale"]
    return x @ parts["outputs kernel"] + parts["outputs bias"]


def unit_mean_square(affine: jax.Array) -> jax.Array:
    """Scales f32[W], or scales and biases f32[2, W] jointly, scaled to the length √W."""
    return affine * jnp.sqrt(affine.shape[-1] / (jnp.sum(affine * affine) + 1e-8))
