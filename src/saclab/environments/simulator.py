"""Capture and restore the exact state of an environment, the simulator's hidden state included.

A state is a dictionary of NumPy arrays and plain values. Environments that saclab cannot look into may offer the two
methods `saclab_capture() -> dict[str, np.ndarray]` and `saclab_restore(dict[str, np.ndarray])`.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.envs.classic_control import Continuous_MountainCarEnv, PendulumEnv
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

Environment: TypeAlias = gymnasium.Env[Any, Any]
State: TypeAlias = dict[str, Any]

STATELESS_WRAPPERS = (OrderEnforcing, PassiveEnvChecker)  # nothing in them changes within an episode


def capture_state(environment: Environment) -> State | None:
    """Everything that decides how the episode goes on; None if there is something that saclab does not know."""
    elapsed_steps = []
    inner = environment
    while isinstance(inner, gymnasium.Wrapper):
        if isinstance(inner, TimeLimit):
            elapsed_steps.append(int(inner._elapsed_steps or 0))
        elif not isinstance(inner, STATELESS_WRAPPERS):
            return None
        inner = inner.env
    physics = capture_physics(inner)
    if physics is None:
        return None
    return {
        "physics": physics,
        "elapsed_steps": elapsed_steps,
        "generator": inner.np_random.bit_generator.state,
    }


def restore_state(environment: Environment, state: State) -> None:
    """Continue an episode from `capture_state` in an environment of the same kind that has been reset once."""
    elapsed_steps = iter(state["elapsed_steps"])
    inner = environment
    while isinstance(inner, gymnasium.Wrapper):
        if isinstance(inner, TimeLimit):
            inner._elapsed_steps = next(elapsed_steps)
        inner = inner.env
    restore_physics(inner, state["physics"])
    inner.np_random.bit_generator.state = state["generator"]


def capture_physics(environment: Environment) -> dict[str, np.ndarray] | None:
    """The simulator's own state as arrays; None for a simulator that saclab does not know."""
    if hasattr(environment, "saclab_capture"):
        captured: dict[str, np.ndarray] = environment.saclab_capture()
        return captured
    if isinstance(environment, MujocoEnv):
        return capture_mujoco(environment)
    if isinstance(environment, PendulumEnv | Continuous_MountainCarEnv):
        return {"state": np.array(environment.state)}
    return None


def restore_physics(environment: Environment, physics: dict[str, np.ndarray]) -> None:
    if hasattr(environment, "saclab_restore"):
        environment.saclab_restore(physics)
    elif isinstance(environment, MujocoEnv):
        restore_mujoco(environment, physics)
    else:
        setattr(environment, "state", physics["state"].copy())  # noqa: B010 - classic control keeps it there


# Derived quantities that MuJoCo computes late in a step and Gymnasium's environments read before the next one.
LAGGING = ("xpos", "xipos", "subtree_com")


def capture_mujoco(environment: MujocoEnv) -> dict[str, np.ndarray]:
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
