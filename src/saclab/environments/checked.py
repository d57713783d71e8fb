"""What an environment gives, held against what it has declared: it is anybody's code."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from saclab.errors import RunBroken, UserError


class Step(NamedTuple):
    """What a step gave."""

    observation: np.ndarray
    """[O] of any real type."""
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


def checked_reset(environment: gymnasium.Env[Any, Any], size: int, seed: int | None) -> np.ndarray:
    """Start an episode: the first observation [size]; raises UserError for anything else.

    Raises:
        RunBroken: if the environment raises an error.
    """
    with raising():
        given = environment.reset(seed=seed)
    if not isinstance(given, tuple) or len(given) != 2:
        raise misfit(environment, "reset", f"it returned {type(given).__name__}", "a pair (observation, info)")
    return checked_observation(environment, "reset", given[0], size)


def checked_step(environment: gymnasium.Env[Any, Any], action: np.ndarray, size: int) -> Step:
    """Take a step; raises UserError if what it gave is not what a Gymnasium environment gives.

    Raises:
        RunBroken: if the environment raises an error.
    """
    with raising():
        given = environment.step(action)
    if not isinstance(given, tuple) or len(given) != 5:
        what = f"{len(given)} values" if isinstance(given, tuple) else type(given).__name__
        raise misfit(environment, "step", f"it returned {what}", "(observation, reward, terminated, truncated, info)")
    seen, reward, terminated, truncated, info = given
    if isinstance(reward, np.ndarray) and reward.ndim:
        raise misfit(environment, "step", f"its reward has shape {reward.shape}", "a single number")
    try:
        reward = float(reward)
    except (TypeError, ValueError):
        raise misfit(environment, "step", f"its reward is {reward!r}", "a single number") from None
    for flag, value in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(value, bool | np.bool_ | int):
            raise misfit(environment, "step", f"its {flag} is {value!r}", "True or False")
    return Step(checked_observation(environment, "step", seen, size), reward, bool(terminated), bool(truncated), info)


@contextmanager
def raising() -> Iterator[None]:
    """Turn what the environment's code raises into a RunBroken that has the traceback."""
    try:
        yield
    except Exception as error:
        words = "".join(traceback.format_exception(error))
        raise RunBroken(f"the environment raised {type(error).__name__}: {error}", traceback=words) from error


def checked_observation(environment: gymnasium.Env[Any, Any], call: str, given: Any, size: int) -> np.ndarray:
    seen: np.ndarray = given if isinstance(given, np.ndarray) else np.asarray(given)
    if seen.shape != (size,):
        declared = f"shape ({size},), as its observation space says,"
        raise misfit(environment, call, f"its observation has shape {seen.shape}", declared)
    if seen.dtype.kind not in "fiub":
        raise misfit(environment, call, f"its observation has type {seen.dtype}", "an array of real numbers")
    return seen


def misfit(environment: gymnasium.Env[Any, Any], call: str, what: str, expected: str) -> UserError:
    name = environment.spec.id if environment.spec is not None else type(environment.unwrapped).__name__
    return UserError(f"environment {name} breaks its own word in {call}: {what}, and {expected} is due: mend it there")
