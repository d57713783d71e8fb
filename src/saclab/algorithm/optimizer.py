"""One step of gradient descent, the same for the policy, the critics and the temperature."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from saclab.algorithm.scalars import Scalars
from saclab.algorithm.types import Trained

Schedule = Callable[[jax.Array, Any], jax.Array]
SCHEDULES: dict[str, Schedule] = {
    "constant": lambda progress, last: jnp.ones_like(progress),
    "linear": lambda progress, last: 1 - (1 - last) * progress,
    "cosine": lambda progress, last: last + (1 - last) * 0.5 * (1 + jnp.cos(jnp.pi * progress)),
}
"""Name -> (share f32[] of the steps that are done, share of the learning rate at the end) -> share of it now."""


class Trainer(NamedTuple):
    """What a step of Adam needs beside the gradient."""

    name: str
    """What is trained: its learning rate is the setting `<name>_learning_rate`."""
    schedule: str
    """A key of SCHEDULES."""
    project: Callable[[jax.Array], jax.Array] = lambda weights: weights
    """What is done to the weights after the step."""

    def start(self, weights: jax.Array) -> Trained:
        """Begin with moments of zero."""
        return Trained(weights, optax.scale_by_adam().init(weights))


Objective = Callable[[jax.Array], tuple[jax.Array, Any]]


def descend(trainer: Trainer, numbers: Scalars, objective: Objective, trained: Trained) -> tuple[Trained, Any]:
    """One step of Adam on `objective(weights) -> (loss f32[], whatever else)`; the new state and whatever else.

    A schedule goes by the optimizer's own steps.
    """
    gradient, rest = jax.grad(objective, has_aux=True)(trained.weights)
    adam = optax.scale_by_adam(numbers["adam_beta_1"], numbers["adam_beta_2"])
    direction, moments = adam.update(gradient, trained.moments)
    progress = jnp.minimum(trained.moments.count / numbers["planned_updates"], 1)
    share = SCHEDULES[trainer.schedule](progress, numbers["final_learning_rate_share"])
    change = -(numbers[f"{trainer.name}_learning_rate"] * share) * direction
    return Trained(trainer.project(trained.weights + change), moments), rest
