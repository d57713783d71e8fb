"""Capture and restore the exact state of an environment, the simulator's hidden state included.

A state is a dictionary of NumPy arrays and plain values. Only the very classes named here are looked into: a subclass
of one may keep more than saclab knows of. Such an environment, or any other, may offer the two methods
`saclab_capture() -> dict[str, np.ndarray]` and `saclab_restore(dict[str, np.ndarray])`; `capture_mujoco` and
`restore_mujoco` are there to be called by them. Its generator `np_random` is captured in any case. A wrapper in which
nothing changes within an episode may say so: `saclab_stateless = True` in the class itself.
"""

from __future__ import annotations

from typing import Any, TypeAlias, TypeGuard

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
    physics = capture_physics(inner)
    if physics is None:
        return None
    return {
        "physics": physics,
        "elapsed_steps": elapsed_steps,
        "generator": {} if is_dm_suite(inner) else inner.np_random.bit_generator.state,
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
    restore_physics(inner, state["physics"])
    if not is_dm_suite(inner):
        inner.np_random.bit_generator.state = state["generator"]


def capture_physics(environment: Environment) -> dict[str, np.ndarray] | None:
    """The simulator's own state as arrays; None for a simulator that saclab does not know."""
    if hasattr(environment, "saclab_capture"):
        captured: dict[str, np.ndarray] = environment.saclab_capture()
        return captured
    if is_gymnasium_mujoco(environment):
        return capture_mujoco(environment)
    if is_dm_suite(environment):
        return capture_dm_suite(environment)
    if type(environment) in CLASSIC_CONTROL:
        return {"state": np.array(getattr(environment, "state"))}  # noqa: B009 - mypy does not know the class
    return None


CLASSIC_CONTROL = (PendulumEnv, Continuous_MountainCarEnv)


def is_gymnasium_mujoco(environment: Environment) -> TypeGuard[MujocoEnv]:
    """Whether it is one of Gymnasium's own MuJoCo environments, which keep nothing but the simulator's state."""
    return isinstance(environment, MujocoEnv) and type(environment).__module__.startswith("gymnasium.envs.mujoco.")


def restore_physics(environment: Environment, physics: dict[str, np.ndarray]) -> None:
    if hasattr(environment, "saclab_restore"):
        environment.saclab_restore(physics)
        return
    for name, array in (capture_physics(environment) or {}).items():
        if physics[name].shape != array.shape or physics[name].dtype != array.dtype:
            raise ValueError(f"{name} is not {array.dtype}{list(array.shape)}")
    if is_gymnasium_mujoco(environment):
        restore_mujoco(environment, physics)
    elif is_dm_suite(environment):
        restore_dm_suite(environment, physics)
    else:
        setattr(environment, "state", physics["state"].copy())  # noqa: B010 - classic control keeps it there


# Derived quantities that MuJoCo computes late in a step and Gymnasium's environments read before the next one.
LAGGING = ("xpos", "xipos", "subtree_com")


def capture_mujoco(environment: MujocoEnv) -> dict[str, np.ndarray]:
    """The whole state of the simulator, the derived quantities that lag behind it included."""
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    integration = np.empty(mujoco.mj_stateSize(environment.model, kind))
    mujoco.mj_getState(environment.model, environment.data, integration, kind)
    return {"integration": integration} | {name: getattr(environment.data, name).copy() for name in LAGGING}


def restore_mujoco(environment: MujocoEnv, physics: dict[str, np.ndarray]) -> None:
    """Positions and velocities are not enough: Hopper, Ant and Humanoid go on differently without the rest.

    The state is set twice because mj_forward overwrites the warm start that came with it.
    """
    import mujoco

    model, data, kind = environment.model, environment.data, mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, physics["integration"], kind)
    mujoco.mj_forward(model, data)
    mujoco.mj_setState(model, data, physics["integration"], kind)
    for name in LAGGING:
        getattr(data, name)[:] = physics[name]
