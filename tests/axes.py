"""Settings of the axes, alone and together, for the test matrices that must hold on all of them."""

from __future__ import annotations

from typing import Any

AXES: dict[str, dict[str, Any]] = {
    "held noise and scaled rewards": {"longest_noise": 16, "reward_scaling": "deviation_or_bound"},
    "normalised observations": {"observation_normalisation": "running"},
    "three steps": {"n_step": 3},
    "reward terms, one on a slope": {
        "reward_terms": ("reward_run",), "reward_weights": (0.5,), "reward_schedule": ("reward_ctrl: 0@0.1 2@0.9",),
    },
    "batch normalisation, joint, without a target": {
        "network": "batch_norm_mlp", "joint_forward": True, "actor_joint_forward": True, "snapshots": 0,
        "weight_projection": "unit_columns",
    },
    "a distribution, the actor first and now and then": {
        "critic_head": "categorical", "critic_atoms": 11, "actor_interval": 3,
        "update_order": ("actor", "temperature", "critic", "targets"),
        "learning_rate_schedule": "linear", "final_learning_rate_share": 0.1,
    },
}  # fmt: skip
"""By name: changes of `averaged-auto`, whose environment is HalfCheetah-v4 (it tells its reward's terms)."""
TOGETHER: dict[str, Any] = {name: value for changes in AXES.values() for name, value in changes.items()}
