"""Make a Gymnasium environment, or say clearly why saclab cannot train on it."""

from __future__ import annotations

import logging
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from saclab.environments.foreign import Calls, meant_for_saclab, signals_kept
from saclab.environments.wrappers import wrapped
from saclab.errors import SettingError, UserError, in_words, traceback_of, unknown_name
from saclab.variants import task_name

ENDS = np.array([-1.0, 0.0, 1.0], np.float32)
LARGEST_INTEGER = 2**53  # up to it, 64-bit floats are exact


@dataclass(frozen=True)
class EnvironmentSpec:
    """What a learner and a policy must know of an environment."""

    observation_size: int
    action_size: int
    action_low: np.ndarray
    """[A], of the action space's own type: its bounds; inside saclab actions lie in [-1, 1]."""
    action_high: np.ndarray
    """[A]."""

    def scale_action(self, action: np.ndarray) -> np.ndarray:
        """Actions [..., A] in [-1, 1] to the environment's bounds, clipped against rounding."""
        middle, half_range = self._middle_and_half_range
        scaled: np.ndarray = np.minimum(np.maximum(middle + half_range * action, self.action_low), self.action_high)
        if self.action_low.dtype.kind != "f":
            scaled = np.rint(scaled)
        return scaled.astype(self.action_low.dtype, copy=False)

    def normalise_action(self, action: np.ndarray) -> np.ndarray:
        """The inverse of `scale_action`: actions [..., A] between the environment's bounds as f32 in [-1, 1].

        What lies outside the bounds is outside [-1, 1]; where there is one action only, it is 0.
        """
        middle, half_range = (np.asarray(part, np.float64) for part in self._middle_and_half_range)
        scale = np.where(half_range > 0, half_range, 1.0)
        normalised: np.ndarray = (np.asarray(action, np.float64) - middle) / scale
        return np.where(half_range > 0, normalised, 0.0).astype(np.float32)

    @cached_property
    def _middle_and_half_range(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.action_low, self.action_high
        if low.dtype.kind != "f":  # the difference of two int8 need not be one
            low, high = low.astype(np.float64), high.astype(np.float64)
        return (high + low) / 2, (high - low) / 2


def make_environment(
    environment: str,
    arguments: Mapping[str, Any] | None = None,
    render_mode: str | None = None,
    wrappers: Sequence[str] = (),
) -> gymnasium.Env[np.ndarray, np.ndarray]:
    """The environment, as `make_with_spec` makes it."""
    return make_with_spec(Calls(environment), environment, arguments, render_mode, wrappers)[0]


def make_with_spec(
    calls: Calls,
    environment: str,
    arguments: Mapping[str, Any] | None,
    render_mode: str | None,
    wrappers: Sequence[str] = (),
) -> tuple[gymnasium.Env[np.ndarray, np.ndarray], EnvironmentSpec]:
    """The environment inside its wrappers, checked to be one that saclab can train on; `calls` are those into its code.

    Raises:
        UserError: for an unknown id or wrapper, wrong arguments, a missing dependency, an error of its own, or spaces
            other than flat Boxes with finite action bounds.
    """
    arguments = dict(arguments or {})
    if render_mode is not None:
        arguments["render_mode"] = render_mode
    quiet_simulator()
    with warnings.catch_warnings(), signals_kept(), making(environment, arguments):
        warnings.simplefilter("ignore")  # v4 environments are here on purpose: no deprecation notices
        made = calls.run("__init__", gymnasium.make, environment, disable_env_checker=True, **arguments)
        try:
            require_version(environment, made)
            made = calls.run("__init__", wrapped, made, wrappers)
            return made, environment_spec(environment, made)
        except BaseException:
            with suppress(Exception):
                calls.run("close", made.close)
            raise


@contextmanager
def making(environment: str, arguments: Mapping[str, Any]) -> Iterator[None]:
    """Turn what goes wrong while an environment is made into a UserError that says what would work."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UserError(
            f"environment = {environment!r}: {error}; install the package, or import its environments with an id "
            "of the form package.module:Name-v0"
        ) from error
    except (gymnasium.error.NameNotFound, gymnasium.error.NamespaceNotFound, gymnasium.error.VersionNotFound,
            gymnasium.error.DeprecatedEnv, gymnasium.error.UnregisteredEnv) as error:  # fmt: skip
        raise unknown_environment(environment) from error
    except (gymnasium.error.Error, ImportError) as error:
        raise UserError(f"environment = {environment!r}: {in_words(error)}") from error
    except (UserError, GeneratorExit):
        raise
    except BaseException as error:
        if meant_for_saclab(error):
            raise
        raise not_made(environment, arguments, error) from error


def not_made(environment: str, arguments: Mapping[str, Any], error: BaseException) -> UserError:
    """What is said of an error that came up while an environment was made."""
    refused: UserError
    if arguments and isinstance(error, TypeError | OSError):
        way_out = f"{environment} does not accept them ({in_words(error)})"
        refused = SettingError("environment_arguments", dict(arguments), way_out)
    else:
        advice = "; this dm_control needs MuJoCo 3: pip install 'mujoco<4'" if ahead_of_dm_control(error) else ""
        refused = UserError(f"environment = {environment!r}: it raised an error in __init__: {in_words(error)}{advice}")
    first = error
    while first.__cause__ is not None:
        first = first.__cause__
    last = list(traceback.walk_tb(first.__traceback__))[-1][0]
    if last.f_globals.get("__name__") != gymnasium.make.__module__:  # which calls it: the arguments are not its own
        refused.traceback = traceback_of(first)
    return refused


def ahead_of_dm_control(error: BaseException) -> bool:
    """Whether it comes of a dm_control that reads a field which MuJoCo 4 has no longer (1.0.50 is one)."""
    modules = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    named = any(str(module).startswith("dm_control.") for module in modules)
    return named and isinstance(error, AttributeError) and int(version("mujoco").partition(".")[0]) >= 4


def require_version(name: str, environment: gymnasium.Env[Any, Any]) -> None:
    """Refuse an id without a version: what it stands for changes with Gymnasium, and a run must say what it ran."""
    full = environment.spec.id if environment.spec is not None else name
    if task_name(name) != task_name(full):
        raise SettingError("environment", name, f"give its version too, such as {full}")


def environment_spec(name: str, environment: gymnasium.Env[Any, Any]) -> EnvironmentSpec:
    """Sizes and bounds; raises SettingError for spaces that saclab cannot train on."""
    observation, action = environment.observation_space, environment.action_space
    if isinstance(observation, Dict):
        advice = f"use --wrappers FlattenObservation; its keys are {', '.join(observation)}"
        raise SettingError("environment", name, f"its observations are a Dict, and a flat Box is needed: {advice}")
    if not isinstance(observation, Box) or len(observation.shape) != 1:
        raise SettingError(
            "environment", name,
            f"its observation space is {observation}, and a Box of one dimension is needed: "
            "use --wrappers FlattenObservation",
        )  # fmt: skip
    if isinstance(action, Discrete):
        raise SettingError(
            "environment", name,
            f"its actions are discrete ({action}), and SAC is for continuous ones: use an environment with a Box "
            "action space, such as MountainCarContinuous-v0 or Pendulum-v1",
        )  # fmt: skip
    if not isinstance(action, Box) or len(action.shape) != 1:
        advice = ": use --wrappers FlattenAction" if isinstance(action, Box) else ""
        raise SettingError(
            "environment", name, f"its action space is {action}, and a Box of one dimension is needed{advice}"
        )
    if 0 in observation.shape + action.shape:
        raise SettingError(
            "environment", name, f"there is nothing to see or to do in it: its spaces are {observation} and {action}"
        )
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
        raise SettingError(
            "environment", name,
            f"its action bounds are infinite (low {action.low}, high {action.high}), and actions are scaled to the "
            "bounds: give it finite ones by a wrapper of your own (--wrappers package.module:Name), or register it "
            "with finite ones",
        )  # fmt: skip
    spec = EnvironmentSpec(observation.shape[0], action.shape[0], action.low.copy(), action.high.copy())
    require_usable_bounds(name, spec)
    return spec


def require_usable_bounds(name: str, spec: EnvironmentSpec) -> None:
    """Refuse bounds between which actions cannot be scaled exactly."""
    low, high = spec.action_low, spec.action_high
    with np.errstate(over="ignore"):
        usable = low.dtype.kind in "fiu" and (low <= high).all() and np.isfinite(spec.scale_action(ENDS[:, None])).all()
    if low.dtype.kind in "iu":
        usable = usable and max(-int(low.min()), int(high.max())) <= LARGEST_INTEGER
    if not usable:
        raise SettingError(
            "environment", name,
            f"actions cannot be scaled to its action bounds (low {low}, high {high}, of type {low.dtype}): give it "
            "closer ones by a wrapper of your own (--wrappers package.module:Name), or register it with such",
        )  # fmt: skip


def unknown_environment(environment: str) -> UserError:
    """The error for an id that Gymnasium does not know, with the nearest that it does."""
    return unknown_name("environment", environment, list(gymnasium.registry))


def quiet_simulator() -> None:
    """Send MuJoCo's warnings to Python's log, at debug level, in place of the terminal and a MUJOCO_LOG.TXT.

    A handler that the user has set stays. Environments without MuJoCo need none of this.
    """
    try:
        import mujoco
    except ImportError:
        return
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(logging.getLogger("saclab.mujoco").debug)
