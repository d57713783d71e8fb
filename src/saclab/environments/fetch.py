"""The exact state of gymnasium-robotics' Fetch tasks: gymnasium_robotics:FetchReach-v4 and its like.

The package is not imported here. Beside what MuJoCo integrates, which counts in the mocap body that moves the arm, such
a task keeps its goal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

# Derived quantities that a step leaves behind the state, and from which the next one places the mocap body.
LAGGING = ("xpos", "xquat")


def is_fetch(environment: Any) -> bool:
    """Whether it is such a task, of those that use MuJoCo's own bindings (v2 and later).

    Those of a hand, a kitchen or a maze keep more.
    """
    kind = type(environment)
    return kind.__module__.startswith("gymnasium_robotics.envs.fetch.") and kind.__name__.startswith("MujocoFetch")


def capture_fetch(environment: Any) -> dict[str, np.ndarray]:
    """All that decides how the episode goes on, but for the generator."""
    import mujoco

    model, data, kind = environment.model, environment.data, mujoco.mjtState.mjSTATE_INTEGRATION
    integration = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, integration, kind)
    return {"integration": integration, "goal": environment.goal.copy()} | {
        name: getattr(data, name).copy() for name in LAGGING
    }


def restore_fetch(environment: Any, state: dict[str, np.ndarray]) -> None:
    """Go on from `capture_fetch` in an environment that has been reset once.

    The state is set twice because mj_forward overwrites the warm start that came with it.
    """
    import mujoco

    model, data, kind = environment.model, environment.data, mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state["integration"], kind)
    mujoco.mj_forward(model, data)
    mujoco.mj_setState(model, data, state["integration"], kind)
    for name in LAGGING:
        getattr(data, name)[:] = state[name]
    environment.goal = state["goal"].copy()
