"""Networks as pairs of pure functions on one packed vector of parameters.

One vector per network keeps the learner's state at a dozen arrays: Polyak averaging, Adam, the ring of target
snapshots and a checkpoint are each one array, and a call into XLA has few arguments. `apply` takes NumPy arrays
as well as JAX arrays (the array API standard), so a policy acts on the CPU without a call into JAX.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = Any  # a NumPy or a JAX array of the kind given


class Network(NamedTuple):
    """`init(key) -> f32[P]` and `apply(f32[P], f32[..., inputs]) -> f32[..., outputs]`."""

    init: Callable[[jax.Array], jax.Array]
    apply: Callable[[Array, Array], Array]
    parameters: int
    """P."""


def relu(x: Array) -> Array:
    return x.__array_namespace__().where(x > 0, x, 0)


def elu(x: Array) -> Array:
    xp = x.__array_namespace__()
    return xp.where(x > 0, x, xp.expm1(xp.minimum(x, 0)))


def silu(x: Array) -> Array:
    xp = x.__array_namespace__()
    return x * 0.5 * (1 + xp.tanh(0.5 * x))


def gelu(x: Array) -> Array:
    """The tanh approximation."""
    xp = x.__array_namespace__()
    return 0.5 * x * (1 + xp.tanh(0.7978845608 * (x + 0.044715 * x * x * x)))


def tanh(x: Array) -> Array:
    return x.__array_namespace__().tanh(x)


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "relu": relu, "tanh": tanh, "elu": elu, "silu": silu, "gelu": gelu,
}  # fmt: skip


def mlp(inputs: int, hidden_layers: tuple[int, ...], outputs: int, activation: str) -> Network:
    """A multi-layer perceptron; weights and biases start uniform in ±1/√inputs of the layer, as PyTorch's do."""
    layers = list(pairwise((inputs, *hidden_layers, outputs)))
    nonlinearity = ACTIVATIONS[activation]

    def init(key: jax.Array) -> jax.Array:
        parts = []
        for layer_key, (fan_in, fan_out) in zip(jax.random.split(key, len(layers)), layers, strict=True):
            bound = 1 / np.sqrt(fan_in)
            parts.append(jax.random.uniform(layer_key, ((fan_in + 1) * fan_out,), minval=-bound, maxval=bound))
        return jnp.concatenate(parts)

    def apply(parameters: Array, x: Array) -> Array:
        start = 0
        for index, (fan_in, fan_out) in enumerate(layers):
            weights_end, end = start + fan_in * fan_out, start + (fan_in + 1) * fan_out
            x = x @ parameters[start:weights_end].reshape(fan_in, fan_out) + parameters[weights_end:end]
            if index < len(layers) - 1:
                x = nonlinearity(x)
            start = end
        return x

    return Network(init, apply, sum((fan_in + 1) * fan_out for fan_in, fan_out in layers))


NETWORKS: dict[str, Callable[[int, tuple[int, ...], int, str], Network]] = {"mlp": mlp}
