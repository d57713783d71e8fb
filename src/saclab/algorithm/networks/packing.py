"""Named parts of one packed vector, for networks of more than dense layers."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from saclab.algorithm.networks.network import Array, orthogonal, split, unit_columns


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

    def pack(self, parts: dict[str, jax.Array]) -> jax.Array:
        """f32[P] of the parts."""
        return jnp.concatenate([parts[name].ravel() for name in self.shapes])

    def orthogonal_kernels(self, key: jax.Array) -> dict[str, jax.Array]:
        """Every kernel f32[I, O] with orthonormal rows or columns."""
        names = [name for name in self.shapes if name.endswith("kernel")]
        keys = jax.random.split(key, len(names))
        return {
            name: orthogonal(own, (self.shapes[name][0], self.shapes[name][1]))
            for name, own in zip(names, keys, strict=True)
        }

    def unit_kernels(self, parts: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """`parts` with the weights into each unit scaled to length 1."""
        return {name: unit_columns(part) if name.endswith("kernel") else part for name, part in parts.items()}


def length(x: Array) -> Array:
    """The norm of each row f32[..., W]: f32[..., 1]."""
    return x.__array_namespace__().sqrt((x * x).sum(axis=-1, keepdims=True))


def joined(inputs: tuple[Array, ...]) -> Array:
    """The inputs side by side."""
    return inputs[0].__array_namespace__().concat(inputs, axis=-1)
