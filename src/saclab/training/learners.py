"""Learners as training deals with them: compiled once, taken apart into named arrays, and put together again.

Together with `batch/program.py` and the policies of `batch/worker.py` this is all that asks the algorithm room.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from saclab.algorithm.learner import Learner, make_learner
from saclab.algorithm.numbers import Numbers
from saclab.algorithm.types import LearnerState, Metrics
from saclab.config import AlgorithmSettings, Config, field_names
from saclab.errors import NonFiniteError
from saclab.replay import RowLayout
from saclab.training import seeds
from saclab.training.captured import require_like

METRICS = Metrics._fields
"""Names of what an update reports."""


def learner_of(settings: AlgorithmSettings, layout: RowLayout) -> Learner:
    return make_learner(settings, layout.observation_size, layout.action_size)


def initial_learner(config: Config, layout: RowLayout) -> LearnerState:
    """The state before a run's first update."""
    return compiled_init(init_settings(config.algorithm), layout)(seeds.learner_key(config.seed))


@lru_cache(maxsize=16)
def compiled_init(settings: AlgorithmSettings, layout: RowLayout) -> Callable[[np.ndarray], LearnerState]:
    """Key u32[2] -> the state before the first update, compiled once."""
    return jax.jit(learner_of(settings, layout).init)


@lru_cache(maxsize=16)
def compiled_update(
    settings: AlgorithmSettings, layout: RowLayout
) -> Callable[[LearnerState, np.ndarray], tuple[LearnerState, jax.Array]]:
    """(state, rows f32[B, width]) -> (state, metrics f32[M]), compiled once; the state given is used up."""
    learner = learner_of(settings, layout)

    def update(state: LearnerState, rows: jax.Array) -> tuple[LearnerState, jax.Array]:
        state, metrics = learner.update(state, layout.unpack(rows))
        return state, jnp.stack(metrics)

    return jax.jit(update, donate_argnums=0)


def init_settings(settings: AlgorithmSettings) -> AlgorithmSettings:
    """The same for all runs that start from their keys in the same way, so that this is compiled once for them."""
    plain = AlgorithmSettings()
    unused = set(Numbers._fields) & set(field_names(AlgorithmSettings))
    return dataclasses.replace(settings, **{name: getattr(plain, name) for name in unused})


def of_batch(state: LearnerState) -> LearnerState:
    """A run's state as a group's program takes it: with Adam's moments for the temperature, even if it is fixed."""
    moments = state.optimizers.temperature
    if isinstance(moments, optax.EmptyState):
        moments = optax.adam(0.0).init(np.float32(0))
    return state._replace(optimizers=state.optimizers._replace(temperature=moments))


def alone(state: LearnerState, settings: AlgorithmSettings) -> LearnerState:
    """The inverse of `of_batch`."""
    if settings.temperature == "learned":
        return state
    return state._replace(optimizers=state.optimizers._replace(temperature=optax.EmptyState()))


def named_leaves(tree: Any) -> dict[str, Any]:
    """The arrays of a pytree by their path, such as `.optimizers.actor[0].mu`."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def finite_arrays(learner: LearnerState, updates: int) -> dict[str, np.ndarray]:
    """The learner's arrays by name; raises NonFiniteError if it is not worth continuing from."""
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(learner).items()}
    for name, array in arrays.items():
        zero_temperature = name == ".log_alpha" and array == -np.inf
        if not (np.isfinite(array).all() or zero_temperature):
            raise NonFiniteError(f"after update {updates} {name} is not finite")
    return arrays


def learner_from(arrays: Mapping[str, np.ndarray], example: LearnerState) -> LearnerState:
    """The learner whose arrays these are by name; raises CheckpointError unless they are like the example's."""
    checked = [require_like(name, arrays.get(name), np.asarray(leaf)) for name, leaf in named_leaves(example).items()]
    restored: LearnerState = jax.tree.unflatten(jax.tree.structure(example), checked)
    return restored
