"""Make a Gymnasium environment, or say clearly why saclab cannot train on it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from saclab.errors import SettingError, UserError, unknown_name
from saclab.variants import task_name


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

    @cached_property
    def _middle_and_half_range(self) -> tuple[np.ndarray, np.ndarray]:
        return (self.action_high + self.action_low) / 2, (self.action_high - self.action_low) / 2


def make_environment(
    environment: str, arguments: Mapping[str, Any] | None = None, render_mode: str | None = None
) -> gymnasium.Env[np.ndarray, np.ndarray]:
    """The environment, checked to be one that saclab can train on.

    Raises:
        UserError: for an unknown id, wrong arguments, a missing dependency, or spaces other than flat Boxes with
            finite action bounds.
    """
    arguments = dict(arguments or {})
    if render_mode is not None:
        arguments["render_mode"] = render_mode
    quiet_simulator()
    with warnings.catch_warnings(), making(environment, arguments):
        warnings.simplefilter("ignore")  # v4 environments are here on purpose: no deprecation notices
        made = gymnasium.make(environment, disable_env_checker=True, **arguments)
    try:
        require_version(environment, made)
        environment_spec(environment, made)
    except UserError:
        made.close()
        raise
    return made


def require_import_allowed(environment: str, imports: Sequence[str]) -> None:
    """Refuse an id read from disk that would import a package which the user has not named: importing runs code."""
    package, colon, _ = environment.rpartition(":")
    if colon and package not in imports:
        raise UserError(
            f"this run's environment is {environment!r}, which imports the package {package}: if you trust it, add "
            f"--imports {package}"
        )


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
    except (TypeError, OSError, ValueError) as error:
        raise SettingError(
            "environment_arguments", dict(arguments),
            f"{environment} does not accept them ({' '.join(str(error).split())})",
        ) from error  # fmt: skip
    except (gymnasium.error.Error, ImportError) as error:
        raise UserError(f"environment = {environment!r}: {error}") from error


def require_version(name: str, environment: gymnasium.Env[Any, Any]) -> None:
    """Refuse an id without a version: what it stands for changes with Gymnasium, and a run must say what it ran."""
    full = environment.spec.id if environment.spec is not None else name
    if task_name(name) != task_name(full):
        raise SettingError("environment", name, f"give its version too, such as {full}")


def environment_spec(name: str, environment: gymnasium.Env[Any, Any]) -> EnvironmentSpec:
    """Sizes and bounds; raises SettingError for spaces that saclab cannot train on."""
    observation, action = environment.observation_space, environment.action_space
    if isinstance(observation, Dict):
        advice = f"wrap it in gymnasium.wrappers.FlattenObservation; its keys are {', '.join(observation)}"
        raise SettingError("environment", name, f"its observations are a Dict, and a flat Box is needed: {advice}")
    if not isinstance(observation, Box) or len(observation.shape) != 1:
        raise SettingError(
            "environment", name,
            f"its observation space is {observation}, and a Box of one dimension is needed: "
            "wrap it in gymnasium.wrappers.FlattenObservation",
        )  # fmt: skip
    if isinstance(action, Discrete):
        raise SettingError(
            "environment", name,
            f"its actions are discrete ({action}), and SAC is for continuous ones: use an environment with a Box "
            "action space, such as MountainCarContinuous-v0 or Pendulum-v1",
        )  # fmt: skip
    if not isinstance(action, Box) or len(action.shape) != 1:
        raise SettingError("environment", name, f"its action space is {action}, and a Box of one dimension is needed")
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
        raise SettingError(
            "environment", name,
            f"its action bounds are infinite (low {action.low}, high {action.high}), and actions are scaled to the "
            "bounds: wrap it in gymnasium.wrappers.RescaleAction or register it with finite bounds",
        )  # fmt: skip
    return EnvironmentSpec(observation.shape[0], action.shape[0], action.low, action.high)


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
