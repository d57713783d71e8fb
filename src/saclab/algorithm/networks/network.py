"""What a network is: pure functions on one packed vector of numbers.

One vector per network keeps the learner's state at a dozen arrays: Polyak averaging, Adam, the ring of target
snapshots and a checkpoint are each one array, and a call into XLA has few arguments. `apply` takes NumPy arrays
as well as JAX arrays (the array API standard), so a policy acts on the CPU without a call into JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from itertools import accumulate
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = Any  # a NumPy or a JAX array of the kind given


class Network(NamedTuple):
    """Functions on a vector f32[P]: parameters, and behind them S running statistics.

    The inputs f32[..., I] may come as several arrays that belong side by side. A network may let each meet its own rows
    of the first layer, so that a gradient with respect to one of them costs nothing for the others.
    """

    init: Callable[[jax.Array], jax.Array]
    """key u32[2] -> f32[P], before the first step."""
    apply: Callable[..., Array]
    """(f32[P], *inputs) -> f32[..., outputs], as the network acts: with its running statistics."""
    train: Callable[..., tuple[jax.Array, jax.Array]]
    """(f32[P], *inputs, key) -> f32[B, outputs] as it learns, with the statistics of this batch and dropout where it
    has them, and the running statistics f32[S] that follow."""
    project: Callable[[jax.Array], jax.Array]
    """f32[P] -> f32[P], after each step of the optimizer."""
    size: int
    """P, the statistics counted in."""
    statistics: int = 0
    """S."""

    def remember(self, vector: jax.Array, statistics: jax.Array) -> jax.Array:
        """`vector` f32[..., P] with these running statistics f32[..., S]."""
        if self.statistics == 0:
            return vector
        return vector.at[..., self.size - self.statistics :].set(statistics)


class Design(NamedTuple):
    """How a network is built, whatever its sizes."""

    activation: str = "relu"
    """A key of ACTIVATIONS."""
    projection: str = "none"
    """A key of PROJECTIONS: what is done to each kernel after a step."""
    initialisation: str = "network"
    """A key of INITIALISATIONS: how a dense layer starts, where the network leaves it open."""
    dropout: float = 0.0
    """Share of the hidden units that are left out while the network learns."""
    heads: int = 1
    """Equal shares of the outputs that have a last hidden layer of their own, in a network that has such heads."""


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


def uniform_layer(key: jax.Array, inputs: int, outputs: int) -> jax.Array:
    """Weights and biases uniform in ±1/√inputs, as PyTorch's are; one vector f32[(I + 1)·O]."""
    bound = 1 / math.sqrt(inputs)
    return jax.random.uniform(key, ((inputs + 1) * outputs,), minval=-bound, maxval=bound)


def xavier_layer(key: jax.Array, inputs: int, outputs: int) -> jax.Array:
    """Weights uniform in ±√(6/(inputs + outputs)) (Glorot and Bengio 2010), biases 0; one vector f32[(I + 1)·O]."""
    bound = math.sqrt(6 / (inputs + outputs))
    weights = jax.random.uniform(key, (inputs * outputs,), minval=-bound, maxval=bound)
    return jnp.concatenate([weights, jnp.zeros(outputs)])


INITIALISATIONS: dict[str, Callable[[jax.Array, int, int], jax.Array]] = {
    "network": uniform_layer,
    "xavier": xavier_layer,
}


def product(inputs: tuple[Array, ...], weights: Array) -> Array:
    """[input_1, input_2, …] @ weights, without putting the inputs into one array."""
    if len(inputs) == 1:
        return inputs[0] @ weights
    ends = accumulate(part.shape[-1] for part in inputs)
    return reduce(add, (part @ weights[end - part.shape[-1] : end] for part, end in zip(inputs, ends, strict=True)))


def split(vector: Array, sizes: tuple[int, ...]) -> list[Array]:
    """The parts of a packed vector.

    It is split as a matrix of one row for the sake of the gradient, which is one concatenation then. That of vectors
    XLA would fuse with the sums over the batch that are the gradients of biases, each a loop as long as the longest
    part, masked beyond its own: up to twice the time of a whole update, where that reaches beyond mapped memory.
    """
    ends = list(accumulate(sizes))
    if isinstance(vector, np.ndarray):  # no gradient is asked of it, and a policy that acts is in a hurry
        return [vector[end - size : end] for end, size in zip(ends, sizes, strict=True)]
    return [part[0] for part in vector.__array_namespace__().split(vector[None], ends[:-1], axis=1)]


def project_kernels(
    vector: jax.Array, sizes: tuple[int, ...], kernels: dict[int, tuple[int, int]], projection: str
) -> jax.Array:
    """A packed vector with each of its kernels projected.

    Args:
        vector: f32[P].
        sizes: of its parts.
        kernels: number of a part -> its shape, for those that are kernels.
        projection: a key of PROJECTIONS.
    """
    if projection == "none":
        return vector
    parts = split(vector, sizes)
    for number, shape in kernels.items():
        parts[number] = PROJECTIONS[projection](parts[number].reshape(shape)).ravel()
    return jnp.concatenate(parts)


def unit_columns(weights: jax.Array) -> jax.Array:
    """f32[I, O] with the weights into each unit scaled to length 1."""
    return weights / jnp.maximum(jnp.linalg.norm(weights, axis=0, keepdims=True), 1e-8)


PROJECTIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "none": lambda weights: weights,
    "unit_columns": unit_columns,
}
"""Name -> what is done to each kernel f32[I, O] after a step."""


def orthogonal(key: jax.Array, shape: tuple[int, int], gain: float = 1.0) -> jax.Array:
    """f32[I, O] with orthonormal rows or columns, times `gain` (Saxe et al. 2014)."""
    q, r = factorised(jax.random.normal(key, (max(shape), min(shape))))
    q = q * jnp.sign(jnp.diagonal(r))
    kernel: jax.Array = gain * (q if shape[0] > shape[1] else q.T)
    return kernel


one_after_another: Callable[..., Callable[..., Any]] = jax.custom_batching.sequential_vmap


@one_after_another
def factorised(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Q and R; of many networks in a loop, since jaxlib 0.10's batched QR can wait for itself on two threads."""
    q, r = jnp.linalg.qr(matrix)
    return q, r
