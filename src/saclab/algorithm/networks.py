"""Networks as pairs of pure functions on one packed vector of parameters.

One vector per network keeps the learner's state at a dozen arrays: Polyak averaging, Adam, the ring of target
snapshots and a checkpoint are each one array, and a call into XLA has few arguments. `apply` takes NumPy arrays
as well as JAX arrays (the array API standard), so a policy acts on the CPU without a call into JAX.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from itertools import accumulate, pairwise
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = Any  # a NumPy or a JAX array of the kind given


class Network(NamedTuple):
    """`init(key) -> f32[P]` and `apply(f32[P], *inputs) -> f32[..., outputs]`.

    The inputs f32[..., I] may come as several arrays that belong side by side. Each then meets its own rows of the
    first layer, and a gradient with respect to one of them costs nothing for the others.
    """

    init: Callable[[jax.Array], jax.Array]
    apply: Callable[..., Array]
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
    *boundaries, size = accumulate(part for fan_in, fan_out in layers for part in (fan_in * fan_out, fan_out))
    nonlinearity = ACTIVATIONS[activation]

    def init(key: jax.Array) -> jax.Array:
        parts = []
        for layer_key, (fan_in, fan_out) in zip(jax.random.split(key, len(layers)), layers, strict=True):
            bound = 1 / np.sqrt(fan_in)
            parts.append(jax.random.uniform(layer_key, ((fan_in + 1) * fan_out,), minval=-bound, maxval=bound))
        return jnp.concatenate(parts)

    def apply(parameters: Array, *inputs: Array) -> Array:
        # The gradient of one split is one concatenation; that of as many slices would be a sum of padded vectors.
        parts = iter(parameters.__array_namespace__().split(parameters, boundaries))
        x: tuple[Array, ...] = inputs
        for fan_in, fan_out in layers[:-1]:
            x = (nonlinearity(product(x, next(parts).reshape(fan_in, fan_out)) + next(parts)),)
        return product(x, next(parts).reshape(layers[-1])) + next(parts)

    return Network(init, apply, size)


def product(inputs: tuple[Array, ...], weights: Array) -> Array:
    """[input_1, input_2, …] @ weights, without putting the inputs into one array."""
    ends = accumulate(part.shape[-1] for part in inputs)
    return reduce(add, (part @ weights[end - part.shape[-1] : end] for part, end in zip(inputs, ends, strict=True)))


NETWORKS: dict[str, Callable[[int, tuple[int, ...], int, str], Network]] = {"mlp": mlp}
