"""How many floating-point operations the matrix products of one update need, counted in what JAX traced."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.learner import make_learner
from saclab.algorithm.scalars import scalars
from saclab.algorithm.types import Context
from saclab.replay import RowLayout
from saclab.settings import AlgorithmSettings


class MatrixProduct(NamedTuple):
    """One product of an update, perhaps of a batch of matrices."""

    shapes: tuple[tuple[int, ...], tuple[int, ...]]
    operations: int
    """A product of m×k and k×n matrices counts 2·m·k·n."""
    multiply: Callable[[jax.Array, jax.Array], jax.Array]
    at_intervals: bool
    """Whether it is made in every `actor_interval`-th update only."""


def update_operations(settings: AlgorithmSettings, layout: RowLayout) -> float:
    """Floating-point operations of the products of one update, the mean over many."""
    share = {False: 1.0, True: 1 / settings.actor_interval}
    return sum(share[product.at_intervals] * product.operations for product in matrix_products(settings, layout))


def matrix_products(settings: AlgorithmSettings, layout: RowLayout) -> list[MatrixProduct]:
    """The products of one update."""
    learner = make_learner(settings, layout.observation_size, layout.action_size)
    numbers = scalars(settings, layout.action_size)
    state = learner.init(numbers, jax.random.PRNGKey(0))
    batch = layout.unpack(jnp.zeros((settings.batch_size, layout.width)))
    context = Context(np.int32(0), jnp.ones(layout.reward_terms), jnp.float32(1))
    return list(products_of(jax.make_jaxpr(learner.update)(numbers, state, batch, context).jaxpr))


def products_of(jaxpr: Any, at_intervals: bool = False) -> Iterator[MatrixProduct]:
    """The products of a jaxpr, those inside its calls included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left, right = (operand.aval.shape for operand in equation.invars)
            count = 2 * math.prod(equation.outvars[0].aval.shape) * math.prod(left[axis] for axis in contracted)
            multiply = partial(equation.primitive.bind, **equation.params)
            yield MatrixProduct((left, right), count, multiply, at_intervals)
        for branch in equation.params.get("branches", ()):  # those of a part of the update, and nothing at all
            yield from products_of(branch.jaxpr, at_intervals=True)
        for parameter in equation.params.values():
            inner = getattr(parameter, "jaxpr", None)
            if inner is not None:
                yield from products_of(inner, at_intervals)
