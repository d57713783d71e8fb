"""Named parts of one packed vector, for networks of more than dense layers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import PROJECTIONS, Array, orthogonal, split

Parts = dict[str, jax.Array]


class Packing(NamedTuple):
    """Which numbers of a vector f32[P] are what: name -> shape, in their order. Kernels are those of two axes."""

    shapes: dict[str, tuple[int, ...]]

    @property
    def sizes(self) -> tuple[int, ...]:
        return tuple(math.prod(shape) for shape in self.shapes.values())

    def unpack(self, vector: Array) -> dict[str, Array]:
        """The parts of f32[P], each in its shape."""
        parts = zip(self.shapes.items(), split(vector, self.sizes), strict=True)
        return {name: part.reshape(shape) for (name, shape), part in parts}

    def pack(self, parts: Parts) -> jax.Array:
        """f32[P] of the parts."""
        return jnp.concatenate([parts[name].ravel() for name in self.shapes])

    @property
    def kernels(self) -> list[str]:
        return [name for name in self.shapes if name.endswith("kernel")]

    def orthogonal_kernels(self, key: jax.Array, gain: Callable[[str], float] = lambda name: 1.0) -> Parts:
        """Every kernel f32[I, O] with orthonormal rows or columns, times its gain."""
        keys = jax.random.split(key, len(self.kernels))
        return {
            name: orthogonal(own, (self.shapes[name][0], self.shapes[name][1]), gain(name))
            for name, own in zip(self.kernels, keys, strict=True)
        }

    def projected(self, parts: Parts, projection: str) -> Parts:
        """`parts` with each kernel projected as a key of PROJECTIONS says."""
        return parts | {name: PROJECTIONS[projection](parts[name]) for name in self.kernels}


def length(x: Array) -> Array:
    """The norm of each row f32[..., W]: f32[..., 1]."""
    return x.__array_namespace__().sqrt((x * x).sum(axis=-1, keepdims=True))


def joined(inputs: tuple[Array, ...]) -> Array:
    """The inputs side by side."""
    return inputs[0].__array_namespace__().concat(inputs, axis=-1)
