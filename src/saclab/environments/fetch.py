"""The exact state of gymnasium-robotics' Fetch tasks: gymnasium_robotics:FetchReach-v4 and its like.

The package is not imported here. Beside what MuJoCo integrates, which counts in the mocap body that moves the arm, such
a task keeps its goal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from saclab.environments.mujoco_state import capture_simulation, restore_simulation

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
    simulation = capture_simulation(environment.model, environment.data, LAGGING)
    return simulation | {"goal": environment.goal.copy()}


def restore_fetch(environment: Any, state: dict[str, np.ndarray]) -> None:
    """Go on from `capture_fetch` in an environment that has been reset once."""
    restore_simulation(environment.model, environment.data, state, LAGGING)
    environment.goal = state["goal"].copy()
