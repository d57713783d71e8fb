"""Capture and restore the exact state of an environment, the simulator's hidden state included.

A state is a dictionary of NumPy arrays and plain values. Only the very classes named here are looked into: a subclass
of one may keep more than saclab knows of. Such an environment, or any other, may offer the two methods
`saclab_capture() -> dict[str, np.ndarray]` and `saclab_restore(dict[str, np.ndarray])`; `capture_mujoco` and
`restore_mujoco` are there to be called by them. Its generator `np_random` is captured in any case. A wrapper in which
nothing changes within an episode may say so: `saclab_stateless = True` in the class itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import gymnasium
import numpy as np
from gymnasium.envs.classic_control import Continuous_MountainCarEnv, PendulumEnv
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import (
    ClipAction,
    DtypeObservation,
    FilterObservation,
    FlattenObservation,
    OrderEnforcing,
    PassiveEnvChecker,
    RescaleAction,
    RescaleObservation,
    ReshapeObservation,
    TimeLimit,
)

from saclab.environments.dm_suite import capture_dm_suite, is_dm_suite, restore_dm_suite
from saclab.environments.fetch import capture_fetch, is_fetch, restore_fetch
from saclab.environments.mujoco_state import capture_simulation, restore_simulation

Environment: TypeAlias = gymnasium.Env[Any, Any]
State: TypeAlias = dict[str, Any]

# Nothing in them changes within an episode.
STATELESS_WRAPPERS = (
    ClipAction, DtypeObservation, FilterObservation, FlattenObservation, OrderEnforcing, PassiveEnvChecker,
    RescaleAction, RescaleObservation, ReshapeObservation,
)  # fmt: skip


def capture_state(environment: Environment) -> State | None:
    """Everything that decides how the episode goes on; None if there is something that saclab does not know."""
    elapsed_steps = []
    inner = environment
    while isinstance(inner, gymnasium.Wrapper):
        if type(inner) is TimeLimit:
            elapsed_steps.append(int(inner._elapsed_steps or 0))
        elif not keeps_nothing(inner):
            return None
        inner = inner.env
    simulator = simulator_of(inner)
    if simulator is None:
        return None
    return {
        "physics": simulator.capture(inner),
        "elapsed_steps": elapsed_steps,
        "generator": plain(inner.np_random.bit_generator.state) if simulator.draws_from_np_random else {},
    }


def keeps_nothing(wrapper: gymnasium.Wrapper[Any, Any, Any, Any]) -> bool:
    """Whether nothing in it changes within an episode: a wrapper may say so itself, by `saclab_stateless = True`."""
    return type(wrapper) in STATELESS_WRAPPERS or type(wrapper).__dict__.get("saclab_stateless", False) is True


def restore_state(environment: Environment, state: State) -> None:
    """Continue an episode from `capture_state` in an environment of the same kind that has been reset once.

    Raises:
        KeyError, TypeError, ValueError or OverflowError: if `state` is not one of this kind of environment.
    """
    limits = []
    inner = environment
    while isinstance(inner, gymnasium.Wrapper):
        if type(inner) is TimeLimit:
            limits.append(inner)
        inner = inner.env
    for limit, elapsed_steps in zip(limits, state["elapsed_steps"], strict=True):
        limit._elapsed_steps = elapsed_steps
    simulator = simulator_of(inner)
    if simulator is None:
        raise ValueError(f"the state of {type(inner).__name__} cannot be restored")
    if simulator is not ITS_OWN:
        require_same_arrays(state["physics"], simulator.capture(inner))
    simulator.restore(inner, state["physics"])
    if simulator.draws_from_np_random:
        inner.np_random.bit_generator.state = state["generator"]


# Derived quantities that MuJoCo computes late in a step and Gymnasium's environments read before the next one.
LAGGING = ("xpos", "xipos", "subtree_com")


def capture_mujoco(environment: MujocoEnv) -> dict[str, np.ndarray]:
    return capture_simulation(environment.model, environment.data, LAGGING)


def restore_mujoco(environment: MujocoEnv, physics: dict[str, np.ndarray]) -> None:
    restore_simulation(environment.model, environment.data, physics, LAGGING)


def is_gymnasium_mujoco(environment: Environment) -> bool:
    """Whether it is one of Gymnasium's own MuJoCo environments, which keep nothing but the simulator's state."""
    return isinstance(environment, MujocoEnv) and type(environment).__module__.startswith("gymnasium.envs.mujoco.")


def restore_classic(environment: Any, physics: dict[str, np.ndarray]) -> None:
    environment.state = physics["state"].copy()


class Simulator(NamedTuple):
    """How the state of one kind of environment is captured and restored."""

    knows: Callable[[Any], bool]
    """Whether an environment, without its wrappers, is of this kind."""
    capture: Callable[[Any], dict[str, np.ndarray]]
    restore: Callable[[Any, dict[str, np.ndarray]], None]
    draws_from_np_random: bool = True
    """Whether its generator is Gymnasium's, which is captured then."""


ITS_OWN = Simulator(
    lambda environment: hasattr(environment, "saclab_capture"),
    lambda environment: environment.saclab_capture(),
    lambda environment, physics: environment.saclab_restore(physics),
)
SIMULATORS = (
    ITS_OWN,
    Simulator(is_gymnasium_mujoco, capture_mujoco, restore_mujoco),
    Simulator(is_dm_suite, capture_dm_suite, restore_dm_suite, draws_from_np_random=False),
    Simulator(is_fetch, capture_fetch, restore_fetch),
    Simulator(
        lambda environment: type(environment) in (PendulumEnv, Continuous_MountainCarEnv),
        lambda environment: {"state": np.array(environment.state)},
        restore_classic,
    ),
)
"""The first that knows an environment is that of its kind."""


def simulator_of(environment: Environment) -> Simulator | None:
    """How the state of an environment without wrappers is captured; None if saclab does not know it."""
    return next((simulator for simulator in SIMULATORS if simulator.knows(environment)), None)


def require_same_arrays(physics: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Raise KeyError or ValueError unless the arrays are of the shapes and types of an environment of this kind."""
    for name, array in expected.items():
        if physics[name].shape != array.shape or physics[name].dtype != array.dtype:
            raise ValueError(f"{name} is not {array.dtype}{list(array.shape)}")


def plain(state: Any) -> Any:
    """A generator's state as JSON has it: some kinds keep arrays, and take lists as well."""
    if isinstance(state, dict):
        return {name: plain(value) for name, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray | np.generic) else state
