"""What a checkpoint holds of a run: taken apart into arrays and plain values, put together again with a check.

A checkpoint may come from anywhere, so nothing in it is believed: `CheckpointError` tells what does not fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from saclab.training.checkpoint import Arrays
from saclab.training.manifest import CheckpointError
from saclab.training.saved_state import EnvironmentState


def require_like(name: str, array: np.ndarray | None, expected: np.ndarray) -> np.ndarray:
    """`array`, if it has the shape and type of `expected`."""
    if array is None or array.shape != expected.shape or array.dtype != expected.dtype:
        found = "nothing" if array is None else f"{array.dtype}{list(array.shape)}"
        raise CheckpointError(
            f"the checkpoint has {found} for {name}, and this run needs {expected.dtype}{list(expected.shape)}"
        )
    return array


def restore_generator(name: str, generator: np.random.Generator, state: object) -> None:
    """Put a generator into a state that `generator.bit_generator.state` has given."""
    try:
        generator.bit_generator.state = state  # type: ignore[assignment]
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise CheckpointError(f"the checkpoint's state of the generator {name!r} cannot be used: {error}") from error


def split_arrays(states: Sequence[dict[str, Any] | None]) -> tuple[Arrays, list[EnvironmentState | None]]:
    """Environment states, as `TrainingEnvironments.capture` gives them: one flat dictionary of arrays, and the rest."""
    arrays: Arrays = {}
    rest: list[EnvironmentState | None] = []
    for index, state in enumerate(states):
        if state is None:
            rest.append(None)
            continue
        arrays |= {f"{index}.physics.{name}": array for name, array in state["physics"].items()}
        arrays[f"{index}.observation"] = state["observation"]
        rest.append(EnvironmentState(**{name: state[name] for name in EnvironmentState.__struct_fields__}))
    return arrays, rest


def join_arrays(
    arrays: Arrays, rest: Sequence[EnvironmentState | None], observation: np.ndarray
) -> list[dict[str, Any] | None]:
    """The inverse of `split_arrays`; `observation` f32[N, O] is as the environments' observations must be."""
    if len(rest) != len(observation):
        raise CheckpointError(f"the checkpoint has {len(rest)} environments, and this run has {len(observation)}")
    states: list[dict[str, Any] | None] = []
    for index, state in enumerate(rest):
        if state is None:
            states.append(None)
            continue
        prefix = f"{index}.physics."
        states.append({
            **msgspec.structs.asdict(state),
            "physics": {name.removeprefix(prefix): arrays[name] for name in arrays if name.startswith(prefix)},
            "observation": require_like("an observation", arrays.get(f"{index}.observation"), observation[index]),
        })  # fmt: skip
    return states
