"""What an environment gives, held against what it has declared: it is anybody's code.

Every step of a training goes through here, so the way of an environment that keeps its word is a short one.
"""

from __future__ import annotations

import traceback
from typing import Any, NoReturn

import gymnasium
import numpy as np

from saclab.errors import RunBroken, UserError

Step = tuple[np.ndarray, float, bool, bool, dict[str, Any]]
"""Observation [O] of any real type, reward, terminated, truncated, info."""
FLAGS = (bool, np.bool_, int)


def checked_reset(environment: gymnasium.Env[Any, Any], size: int, seed: int | None) -> np.ndarray:
    """Start an episode: the first observation [size].

    Raises:
        UserError: if that is not what `reset` gives.
        RunBroken: if the environment raises an error.
    """
    try:
        given = environment.reset(seed=seed)
    except Exception as error:
        raise raised(error) from error
    if not isinstance(given, tuple) or len(given) != 2:
        refuse(environment, "reset", f"it returned {type(given).__name__}", "a pair (observation, info)")
    return checked_observation(environment, "reset", given[0], size)


def checked_step(environment: gymnasium.Env[Any, Any], action: np.ndarray, size: int) -> Step:
    """Take a step, whose observation is [size].

    Raises:
        UserError: if what it gave is not what a Gymnasium environment gives.
        RunBroken: if the environment raises an error.
    """
    try:
        given = environment.step(action)
    except Exception as error:
        raise raised(error) from error
    if type(given) is not tuple or len(given) != 5:
        what = f"{len(given)} values" if isinstance(given, tuple) else type(given).__name__
        refuse(environment, "step", f"it returned {what}", "(observation, reward, terminated, truncated, info)")
    seen, reward, terminated, truncated, info = given
    if type(seen) is not np.ndarray or seen.shape != (size,) or seen.dtype.char not in "df":
        seen = checked_observation(environment, "step", seen, size)
    if type(reward) is not float:
        reward = checked_reward(environment, reward)
    if type(terminated) not in FLAGS or type(truncated) not in FLAGS:
        flags = f"its terminated is {terminated!r} and its truncated is {truncated!r}"
        refuse(environment, "step", flags, "True or False for each")
    return seen, reward, bool(terminated), bool(truncated), info


def checked_observation(environment: gymnasium.Env[Any, Any], call: str, given: Any, size: int) -> np.ndarray:
    seen: np.ndarray = given if isinstance(given, np.ndarray) else np.asarray(given)
    if seen.shape != (size,):
        declared = f"shape ({size},), as its observation space says,"
        refuse(environment, call, f"its observation has shape {seen.shape}", declared)
    if seen.dtype.kind not in "fiub":
        refuse(environment, call, f"its observation has type {seen.dtype}", "an array of real numbers")
    return seen


def checked_reward(environment: gymnasium.Env[Any, Any], reward: Any) -> float:
    if isinstance(reward, np.ndarray) and reward.ndim:
        refuse(environment, "step", f"its reward has shape {reward.shape}", "a single number")
    try:
        return float(reward)
    except (TypeError, ValueError):
        refuse(environment, "step", f"its reward is {reward!r}", "a single number")


def refuse(environment: gymnasium.Env[Any, Any], call: str, what: str, expected: str) -> NoReturn:
    name = environment.spec.id if environment.spec is not None else type(environment.unwrapped).__name__
    raise UserError(f"environment {name} breaks its own word in {call}: {what}, and {expected} is due: mend it there")


def raised(error: Exception) -> RunBroken:
    """What a run is told of an error in its environment's own code."""
    words = "".join(traceback.format_exception(error))
    return RunBroken(f"the environment raised {type(error).__name__}: {error}", traceback=words)
