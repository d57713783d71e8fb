"""The exact state of a task of dm_control's suite, as shimmy gives it to Gymnasium: shimmy:dm_control/cheetah-run-v0.

Neither package is imported here. A task keeps its state in MuJoCo's data, in what it changes of the model at the start
of an episode, in the count of steps and in a generator of NumPy's old kind.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from saclab.environments.mujoco_state import integration_state

# Targets, gains and terrain: all that tasks of the suite change but colours.
MODEL_ARRAYS = (
    "body_pos", "body_quat", "dof_damping", "geom_pos", "geom_size", "hfield_data", "site_pos", "site_size", "wrap_prm",
)  # fmt: skip


def is_dm_suite(environment: Any) -> bool:
    """Whether it is such a task.

    Those of dm_control's composer keep more. Those of `lqr` draw their masses on springs anew in every instance, from a
    generator that nobody can seed.
    """
    if type(environment).__module__ != "shimmy.dm_control_compatibility":
        return False
    inner = environment._env
    if type(inner).__module__ != "dm_control.rl.control":
        return False
    module = type(inner.task).__module__
    return module.startswith("dm_control.suite.") and module != "dm_control.suite.lqr"


def capture_dm_suite(environment: Any) -> dict[str, np.ndarray]:
    """All that decides how the episode goes on, and the next ones."""
    inner = environment._env
    model, data = inner.physics.model.ptr, inner.physics.data.ptr
    _, keys, *rest = inner.task._random.get_state()
    return {
        "integration": integration_state(model, data),
        "episode": np.array([inner._step_count, inner._reset_next_step], np.int64),
        "generator_keys": np.array(keys),
        "generator_rest": np.array(rest, np.float64),
    } | {f"model_{name}": getattr(model, name).copy() for name in MODEL_ARRAYS}


def restore_dm_suite(environment: Any, state: dict[str, np.ndarray]) -> None:
    """Go on from `capture_dm_suite` in an environment that has been reset once.

    dm_control ends each step with `mj_step1`, which derives from the state what the next step begins with.
    """
    import mujoco

    inner = environment._env
    model, data = inner.physics.model.ptr, inner.physics.data.ptr
    for name in MODEL_ARRAYS:
        getattr(model, name)[:] = state[f"model_{name}"]
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state["integration"], mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_step1(model, data)
    inner._step_count, inner._reset_next_step = int(state["episode"][0]), bool(state["episode"][1])
    position, has_gauss, cached = state["generator_rest"].tolist()
    inner.task._random.set_state(("MT19937", state["generator_keys"], int(position), int(has_gauss), cached))
