"""A perceptron with dropout and layer normalisation (Ba et al. 2016) before each non-linearity, as in DroQ."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.random import threefry_2x32

from saclab.algorithm.networks.mlp import mlp
from saclab.algorithm.networks.network import ACTIVATIONS, Array, Design, Network, product, split

EPSILON = 1e-5
DRAWS = 2**16  # dropout is decided by a draw from so many numbers


def layer_norm_mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, design: Design) -> Network:
    """[Dense -> dropout -> layer normalisation -> non-linearity] per hidden layer -> Dense.

    Weights and biases start as those of `mlp`, scales at 1, shifts at 0.
    """
    plain = mlp(inputs, hidden_layers, outputs, design)
    layers = list(pairwise((inputs, *hidden_layers, outputs)))
    dense = tuple(part for fan_in, fan_out in layers for part in (fan_in * fan_out, fan_out))
    sizes = (*dense, *(2 * width for width in hidden_layers))
    nonlinearity = ACTIVATIONS[design.activation]

    def init(key: jax.Array) -> jax.Array:
        affine = [jnp.repeat(jnp.array([1.0, 0.0]), width) for width in hidden_layers]
        return jnp.concatenate([plain.init(key), *affine])

    def forward(vector: Array, inputs: tuple[Array, ...], keys: Any = None) -> Array:
        parts = split(vector, sizes)
        x = inputs
        for number, shape in enumerate(layers):
            y = product(x, parts[2 * number].reshape(shape)) + parts[2 * number + 1]
            if number == len(hidden_layers):
                return y
            if keys is not None:
                y = dropped_out(y, keys[number], design.dropout)
            scale, shift = parts[len(dense) + number].reshape(2, -1)
            x = (nonlinearity(normalise(y) * scale + shift),)

    def apply(vector: Array, *inputs: Array) -> Array:
        return forward(vector, inputs)

    def train(vector: jax.Array, *inputs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        keys = jax.random.split(key, len(hidden_layers)) if design.dropout else None
        return forward(vector, inputs, keys), jnp.zeros(0, vector.dtype)

    def project(vector: jax.Array) -> jax.Array:
        return jnp.concatenate([plain.project(vector[: plain.size]), vector[plain.size :]])

    return Network(init, apply, train, project, sum(sizes))


def dropped_out(x: jax.Array, key: jax.Array, rate: float) -> jax.Array:
    """A share `rate` of f32[B, W], to 16 bits, set to 0, the rest divided by what is left (Srivastava et al. 2014)."""
    out = round(rate * DRAWS)
    return jnp.where(draws(key, x.shape) >= out, x / (1 - out / DRAWS), 0)


def draws(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Uniform u16[shape], four of each block of JAX's hash; `jax.random.bits` takes one of each (docs/speed.md)."""
    size = math.prod(shape)
    words = threefry_2x32(key, jnp.arange(2 * math.ceil(size / 4), dtype=jnp.uint32))
    return jax.lax.bitcast_convert_type(words, jnp.uint16).reshape(-1)[:size].reshape(shape)


def normalise(x: Array) -> Array:
    """Each row f32[..., W] with mean 0 and variance 1."""
    xp: Any = x.__array_namespace__()
    centred = x - xp.mean(x, axis=-1, keepdims=True)
    return centred / xp.sqrt(xp.mean(centred * centred, axis=-1, keepdims=True) + EPSILON)
