"""The exact state of a MuJoCo simulation, as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def integration_state(model: Any, data: Any) -> np.ndarray:
    """f64[n]: all that MuJoCo itself integrates and starts from."""
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


def capture_simulation(model: Any, data: Any, lagging: Sequence[str]) -> dict[str, np.ndarray]:
    """The whole state, with derived quantities of these names that lag behind it."""
    return {"integration": integration_state(model, data)} | {name: getattr(data, name).copy() for name in lagging}


def restore_simulation(model: Any, data: Any, state: Mapping[str, np.ndarray], lagging: Sequence[str]) -> None:
    """Positions and velocities are not enough: Hopper, Ant and Humanoid go on differently without the rest.

    The state is set twice because mj_forward overwrites the warm start that came with it.
    """
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state["integration"], kind)
    mujoco.mj_forward(model, data)
    mujoco.mj_setState(model, data, state["integration"], kind)
    for name in lagging:
        getattr(data, name)[:] = state[name]
