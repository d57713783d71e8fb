"""What a checkpoint holds of a run: taken apart into arrays and plain values, checked when it is put together again.

A checkpoint may come from anywhere, so nothing in it is believed: `CheckpointError` tells what does not fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saclab.training.checkpoint import Arrays
from saclab.training.manifest import CheckpointError


def require_like(name: str, array: np.ndarray | None, expected: np.ndarray) -> np.ndarray:
    """`array`, if it has the shape and type of `expected`."""
    if array is None or array.shape != expected.shape or array.dtype != expected.dtype:
        found = "nothing" if array is None else f"{array.dtype}{list(array.shape)}"
        raise CheckpointError(
            f"the checkpoint has {found} for {name}, and this run needs {expected.dtype}{list(expected.shape)}"
        )
    return array


def part(values: object, name: str, kind: type | tuple[type, ...]) -> Any:
    """`values[name]`, if there is one and it is of that kind."""
    value = values.get(name) if isinstance(values, Mapping) else None
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise CheckpointError(f"the checkpoint's entry {name!r} is {type(value).__name__}, not what saclab writes")
    return value


def plain_numbers(values: object, examples: Mapping[str, object]) -> dict[str, Any]:
    """The entries of a dictionary of numbers, each of the kind of its example; None may also be a float."""
    found: dict[str, Any] = {}
    for name, example in examples.items():
        if example is None and isinstance(values, Mapping) and name in values and values[name] is None:
            found[name] = None
        else:
            found[name] = part(values, name, int if type(example) is int else (int, float))
    return found


def restore_generator(name: str, generator: np.random.Generator, state: object) -> None:
    """Put a generator into a state that `generator.bit_generator.state` has given."""
    try:
        generator.bit_generator.state = state  # type: ignore[assignment]
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise CheckpointError(f"the checkpoint's state of the generator {name!r} cannot be used: {error}") from error


def split_arrays(states: list[dict[str, Any] | None]) -> tuple[Arrays, list[dict[str, Any] | None]]:
    """Environment states as one flat dictionary of arrays, and the rest, which is JSON-able."""
    arrays: Arrays = {}
    rest: list[dict[str, Any] | None] = []
    for index, state in enumerate(states):
        if state is None:
            rest.append(None)
            continue
        arrays |= {f"{index}.physics.{name}": array for name, array in state["physics"].items()}
        arrays[f"{index}.observation"] = state["observation"]
        rest.append({key: value for key, value in state.items() if key not in ("physics", "observation")})
    return arrays, rest


def join_arrays(arrays: Arrays, rest: list[Any], observation: np.ndarray) -> list[dict[str, Any] | None]:
    """The inverse of `split_arrays`; `observation` f32[N, O] is as the environments' observations must be."""
    if len(rest) != len(observation):
        raise CheckpointError(f"the checkpoint has {len(rest)} environments, and this run has {len(observation)}")
    states: list[dict[str, Any] | None] = []
    for index, state in enumerate(rest):
        if state is None:
            states.append(None)
            continue
        elapsed = part(state, "elapsed_steps", list)
        if not all(type(steps) is int for steps in elapsed):
            raise CheckpointError(f"the checkpoint's elapsed_steps are {elapsed!r}, not whole numbers")
        prefix = f"{index}.physics."
        states.append({
            **plain_numbers(state, {"total_reward": 0.0, "length": 0}),
            "elapsed_steps": elapsed,
            "generator": part(state, "generator", dict),
            "physics": {name.removeprefix(prefix): arrays[name] for name in arrays if name.startswith(prefix)},
            "observation": require_like("an observation", arrays.get(f"{index}.observation"), observation[index]),
        })  # fmt: skip
    return states
