"""A network whose features and weights lie on unit spheres, after SimbaV2 (Lee et al. 2025).

    x <- l2(scaler(W l2([x, 3])))
    x <- l2(x + α (l2(W₂ (σ(scaler(W₁ x)) + 1e-8)) − x)) per hidden layer
    per head: W₂ scaler(W₁ x) + bias

l2 divides by the length, a scaler multiplies each feature by a number that is learnt, and σ is the non-linearity.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import ACTIVATIONS, Array, Design, Network
from saclab.algorithm.networks.packing import Packing, joined, length

EXPANSION = 4
SHIFT = 3.0
"""The number beside the inputs, by which their length survives the projection to the sphere."""
EPSILON = 1e-8


def hyperspherical(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """One block per hidden layer, all of one width. Kernels start orthogonal, with columns of length 1.

    Each of `design.heads` heads gives an equal share of the outputs.
    """
    width, blocks, share = hidden_layers[0], len(hidden_layers), outputs // design.heads
    shapes: dict[str, tuple[int, ...]] = {"inputs kernel": (inputs + 1, width), "inputs scaler": (width,)}
    for block in range(blocks):
        shapes |= {f"{block} wide kernel": (width, EXPANSION * width), f"{block} wide scaler": (EXPANSION * width,)}
        shapes |= {f"{block} narrow kernel": (EXPANSION * width, width), f"{block} alpha": (width,)}
    for head in range(design.heads):
        shapes |= {f"head {head} hidden kernel": (width, width), f"head {head} scaler": (width,)}
        shapes |= {f"head {head} kernel": (width, share), f"head {head} bias": (share,)}
    packing, nonlinearity = Packing(shapes), ACTIVATIONS[design.activation]

    def init(key: jax.Array) -> jax.Array:
        parts = {name: jnp.full(shape, stored(name, width)) for name, shape in shapes.items()}
        return packing.pack(packing.projected(parts | packing.orthogonal_kernels(key), "unit_columns"))

    def apply(vector: Array, *inputs: Array) -> Array:
        parts = packing.unpack(vector)
        x = embedded(joined(inputs), parts["inputs kernel"], parts["inputs scaler"])
        for block in range(blocks):
            wide = nonlinearity(x @ parts[f"{block} wide kernel"] * parts[f"{block} wide scaler"]) + EPSILON
            step = parts[f"{block} alpha"] * (math.sqrt(width) / (blocks + 1))
            x = interpolated(x, on_sphere(wide @ parts[f"{block} narrow kernel"]), step)
        return joined(tuple(of_head(parts, f"head {head}", x) for head in range(design.heads)))

    def train(vector: jax.Array, *inputs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return apply(vector, *inputs), jnp.zeros(0, vector.dtype)

    def project(vector: jax.Array) -> jax.Array:
        if design.projection == "none":
            return vector
        return packing.pack(packing.projected(packing.unpack(vector), design.projection))

    return Network(init, apply, train, project, sum(packing.sizes))


def stored(name: str, width: int) -> float:
    """What a part starts as.

    A scaler is what it multiplies by; √(2/h) of an embedding, √(2/4h) in a block, 1 in a head. α starts at 1/(L + 1),
    and is stored as 1/√h, so that Adam's steps are small beside it.
    """
    if name.startswith("head"):
        return 1.0 if name.endswith("scaler") else 0.0
    if name.endswith("alpha"):
        return 1 / math.sqrt(width)
    return math.sqrt(2 / (EXPANSION * width if "wide" in name else width))


def on_sphere(x: Array) -> Array:
    """Each row f32[..., W] with length 1."""
    return x / x.__array_namespace__().maximum(length(x), x.dtype.type(EPSILON))


def embedded(x: Array, kernel: Array, scaler: Array) -> Array:
    """Inputs f32[..., I] on the sphere f32[..., W]."""
    return on_sphere(on_sphere(shifted(x)) @ kernel * scaler)


def shifted(x: Array) -> Array:
    xp = x.__array_namespace__()
    return xp.concat([x, xp.full((*x.shape[:-1], 1), SHIFT, dtype=x.dtype)], axis=-1)


def interpolated(x: Array, towards: Array, share: Array) -> Array:
    """The linear interpolation of two points of the sphere f32[..., W], back on the sphere."""
    return on_sphere(x + share * (towards - x))


def of_head(parts: dict[str, Array], name: str, x: Array) -> Array:
    hidden = x @ parts[f"{name} hidden kernel"] * parts[f"{name} scaler"]
    return hidden @ parts[f"{name} kernel"] + parts[f"{name} bias"]
