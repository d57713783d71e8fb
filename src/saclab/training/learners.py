"""Learners as training deals with them: compiled once, taken apart into named arrays, and put together again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.learner import Learner, make_learner
from saclab.algorithm.scalars import pack, scalars, unpack
from saclab.algorithm.types import Batch, Context, LearnerState
from saclab.config import Config
from saclab.errors import NonFiniteError
from saclab.replay import RowLayout
from saclab.settings import AlgorithmSettings, structure
from saclab.training import seeds
from saclab.training.captured import require_like
from saclab.training.manifest import CheckpointError
from saclab.training.process import compiled


def learner_of(settings: AlgorithmSettings, layout: RowLayout) -> Learner:
    return make_learner(settings, layout.observation_size, layout.action_size)


def numbers_of(config: Config, layout: RowLayout) -> np.ndarray:
    """The plain numbers of a run i32[N], packed: an argument of what is compiled."""
    return pack(scalars(config.algorithm, layout.action_size, config.planned_updates))


def initial_learner(config: Config, layout: RowLayout) -> LearnerState:
    """The state before a run's first update."""
    init = compiled_init(structure(config.algorithm), layout)
    return init(numbers_of(config, layout), seeds.learner_key(config.seed))


@lru_cache(maxsize=16)
def compiled_init(shape: AlgorithmSettings, layout: RowLayout) -> Callable[[np.ndarray, np.ndarray], LearnerState]:
    """(plain numbers i32[N], key u32[2]) -> the state before the first update; compiled once for a `structure`."""
    learner = learner_of(shape, layout)
    return compiled(lambda numbers, key: learner.init(unpack(numbers), key))


@lru_cache(maxsize=16)
def compiled_update(
    shape: AlgorithmSettings, layout: RowLayout
) -> Callable[[jax.Array, LearnerState, np.ndarray, Context], tuple[LearnerState, jax.Array]]:
    """(plain numbers i32[N], state, rows f32[B, width], context) -> (state, report f32[M]); the state is used up.

    Compiled once for all settings of a `structure`.
    """
    learner = learner_of(shape, layout)
    longest = shape.n_step

    def batch_of(rows: jax.Array, discount: jax.Array) -> Batch:
        """Rows f32[B, width], or windows f32[B, n · width + 1] with their lengths."""
        if longest == 1:
            return layout.unpack(rows)
        windows = rows[:, :-1].reshape(len(rows), longest, layout.width)
        return layout.unpack_windows(windows, rows[:, -1].astype(jnp.int32), discount)

    def update(
        numbers: jax.Array, state: LearnerState, rows: jax.Array, context: Context
    ) -> tuple[LearnerState, jax.Array]:
        plain_numbers = unpack(numbers)
        state = learner.update(plain_numbers, state, batch_of(rows, plain_numbers["discount"]), context)
        return state, state.report

    return compiled(update, donate_argnums=1)


def on_device(tree: Any) -> Any:
    """Host arrays as JAX's, so that a call need not bring them each time."""
    return jax.tree.map(jnp.asarray, tree)


def named_leaves(tree: Any) -> dict[str, Any]:
    """The arrays of a pytree by their path, such as `.actor.moments.mu`."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def finite_arrays(learner: LearnerState, updates: int) -> dict[str, np.ndarray]:
    """The learner's arrays by name; raises NonFiniteError if it is not worth continuing from."""
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(learner).items()}
    for name, array in arrays.items():
        if not is_finite(name, array):
            raise NonFiniteError(f"after update {updates} {name} is not finite")
    return arrays


def is_finite(name: str, array: np.ndarray) -> bool:
    """Whether a learner can go on with an array; the logarithm of a temperature of 0 is none that is."""
    return bool(np.isfinite(array).all() or (name == ".temperature.weights" and array == -np.inf))


def learner_from(arrays: Mapping[str, np.ndarray], example: LearnerState) -> LearnerState:
    """The learner whose arrays these are by name.

    Raises:
        CheckpointError: unless all, Adam's moments counted in, are like the example's, and finite.
    """
    checked = {
        name: require_like(name, arrays.get(name), np.asarray(leaf)) for name, leaf in named_leaves(example).items()
    }
    for name, array in checked.items():
        if not is_finite(name, array):
            raise CheckpointError(f"the checkpoint's {name} is not finite, and saclab saves none that is not")
    restored: LearnerState = jax.tree.unflatten(jax.tree.structure(example), checked.values())
    return restored
