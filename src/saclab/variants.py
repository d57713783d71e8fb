"""The variants of SAC, each a row of data: what differs from plain SAC.

A variant is a point in the space of `AlgorithmSettings`; any other setting can be changed beside it. A row may hold
settings of the training too (`TrainingSettings`), such as an update-to-data ratio: they count for more than the
protocol's.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass, field
from typing import Any

from saclab.errors import unknown_name
from saclab.settings import AlgorithmSettings, field_names, replace_settings


@dataclass(frozen=True)
class Variant:
    title: str
    """A name for figures and tables."""
    description: str
    settings: dict[str, Any] = field(default_factory=dict)
    """What differs from plain SAC, and from the protocol: names of AlgorithmSettings and TrainingSettings."""
    by_environment: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What differs further for environments whose id starts with a key."""
    needs: dict[str, str] = field(default_factory=dict)
    """Settings that have to be given where `by_environment` does not have them -> in words, what to give."""
    paper_name: str | None = None
    """The name of the system in the paper's figures and Table 2, if it stands there."""
    source: str = "the paper"
    """Where it was published, for the table of variants."""
    cost: float | None = None
    """Time of an environment step with its updates on HalfCheetah-v4, on one core, as a multiple of that of `sac` at
    one update per step (`benchmarks/family.py`)."""


LEARNED = {"temperature": "learned", "initial_temperature": 1.0}
AVERAGED = {"snapshots": 10}
ENSEMBLE = LEARNED | {
    "actor_reduction": "mean",
    "initialisation": "xavier",
    "updates_per_interval": 20,
    "update_interval": 1,
    "actor_interval": 20,
    "random_steps": 5_000,
}
"""What REDQ and DroQ share: many updates per environment step, the policy's at every twentieth."""
SCALED_RETURNS = {
    "temperature": "learned",
    "initial_temperature": 0.01,
    "temperature_gradient": "alpha",
    "critic_head": "categorical",
    "critic_atoms": 101,
    "critic_bound": 5.0,
    "log_std_minimum": -10.0,
}
"""What XQC, SimbaV2 and FlashSAC share: a distribution over returns that scaled rewards hold within bounds."""
ENSEMBLE_ENTROPY = {"Hopper-": -1.0, "HalfCheetah-": -3.0, "Walker2d-": -3.0, "Ant-": -4.0, "Humanoid-": -2.0}
"""Target entropies of MBPO, REDQ and DroQ."""
DROPOUT = {"Hopper-": 0.0001, "Walker2d-": 0.005, "Humanoid-": 0.1}
"""DroQ's rates of dropout, where they differ from 0.01."""
STANDING_FIRST = {
    "Humanoid-v4": {
        "reward_terms": ("reward_linvel", "reward_quadctrl", "reward_alive"),
        "reward_schedule": ("reward_linvel: 0.2@0.1 1@0.5",),
    },
    "Humanoid-v5": {
        "reward_terms": ("reward_forward", "reward_ctrl", "reward_survive", "reward_contact"),
        "reward_schedule": ("reward_forward: 0.2@0.1 1@0.5",),
    },
}
"""The curriculum: at first forward motion counts a fifth, in the end what the environment says.

The environment's own weights are 5 for each step on the feet, 1.25 for each m/s forward, 0.1 for the squared torques;
the terms that it tells have them in them, so 1 leaves a term as it is. At 1 m/s, going forward earns a quarter of what
standing does, and falling forward earns it too; with a fifth of the weight it is a twentieth. A tenth of the updates
is for standing; from half of them on the reward is the one that is evaluated. What matters is how the terms compare,
so that of standing keeps its weight, and Q its size.
"""
NEEDS_SCHEDULE = {
    "reward_schedule": "this row does not know the terms of this environment's reward: name those that the info of its "
    "steps tells, and their weights over training, as in --reward-schedule 'reward_forward: 0.2@0.1 1@0.5'"
}

COMPARED = ("sac", "sac-auto", "averaged", "averaged-auto")
"""The variants of a comparison, unless others are asked for."""

VARIANTS: dict[str, Variant] = {
    "sac": Variant(
        "SAC",
        "Fixed temperature, the smaller of two Q-networks, Polyak targets (Eq. 2-5).",
        paper_name="sac",
        cost=1,
    ),
    "sac-auto": Variant(
        "SAC, learned α",
        "The temperature is learned so that the policy keeps a target entropy (Eq. 8).",
        LEARNED,
        paper_name="sac-alpha-tuning",
        cost=0.94,
    ),
    "averaged": Variant(
        "Averaged-SAC",
        "The next state's value is the mean over the last K target networks (Eq. 9).",
        AVERAGED,
        paper_name="averaged-sac",
        cost=1.85,
    ),
    "averaged-auto": Variant(
        "Averaged-SAC, learned α",
        "Averaged targets (Eq. 9) and a learned temperature (Eq. 8): the paper's first future experiment.",
        AVERAGED | LEARNED,
        cost=1.84,
    ),
    "averaged-entropy": Variant(
        "Averaged entropy term (not Eq. 9)",
        "What the paper's authors ran under the name Averaged-SAC: no value is averaged, only the entropy term "
        "α·log π, row by row over the last K unrelated minibatches. Kept to check their published numbers.",
        {"entropy_window": 10},
        cost=0.92,
    ),
    "curriculum": Variant(
        "Curriculum, learned α",
        "Humanoid's reward by a schedule: standing first, then forward; a learned temperature. The paper's second "
        "future experiment.",
        LEARNED,
        STANDING_FIRST,
        needs=NEEDS_SCHEDULE,
    ),
    "curriculum-fixed": Variant(
        "Curriculum",
        "The same schedule with a fixed temperature.",
        by_environment=STANDING_FIRST,
        needs=NEEDS_SCHEDULE,
    ),
    "redq": Variant(
        "REDQ",
        "Ten critics; the target takes the smaller of two drawn at random, the policy the mean of all; 20 updates per "
        "step.",
        ENSEMBLE | {"critics": 10, "target_critics": 2},
        {prefix: {"target_entropy": entropy} for prefix, entropy in ENSEMBLE_ENTROPY.items()},
        source="Chen et al. 2021",
        cost=39.3,
    ),
    "droq": Variant(
        "DroQ",
        "REDQ with two critics that have dropout and layer normalisation.",
        ENSEMBLE | {"critic_network": "layer_norm_mlp", "critic_dropout": 0.01, "critic_mode_for_actor": "training"},
        {
            prefix: {"target_entropy": entropy, "critic_dropout": DROPOUT.get(prefix, 0.01)}
            for prefix, entropy in ENSEMBLE_ENTROPY.items()
        },
        source="Hiraoka et al. 2022",
        cost=14.9,
    ),
    "tqc": Variant(
        "TQC",
        "Five critics of 25 quantiles; the target pools them and leaves out the largest, the policy takes the mean.",
        LEARNED
        | {
            "critic_head": "quantile",
            "critic_atoms": 25,
            "critics": 5,
            "critic_hidden_layers": (512, 512, 512),
            "target_reduction": "truncated",
            "actor_reduction": "mean",
            "updates_per_interval": 1,
            "update_interval": 1,
        },
        {"HalfCheetah-": {"dropped_quantiles": 0}, "Hopper-": {"dropped_quantiles": 5}},
        source="Kuznetsov et al. 2020",
        cost=15.2,
    ),
    "crossq": Variant(
        "CrossQ",
        "No target network: wide critics with batch renormalisation see both states in one pass.",
        LEARNED
        | {
            "network": "batch_renorm_mlp",
            "critic_hidden_layers": (2048, 2048),
            "snapshots": 0,
            "joint_forward": True,
            "adam_beta_1": 0.5,
            "actor_learning_rate": 1e-3,
            "critic_learning_rate": 1e-3,
            "temperature_learning_rate": 1e-3,
            "temperature_gradient": "alpha",
            "actor_interval": 3,
            "updates_per_interval": 1,
            "update_interval": 1,
            "random_steps": 5_000,
        },
        {"Swimmer-": {"discount": 0.9999}},
        source="Bhatt et al. 2024",
        cost=54.6,
    ),
    "xqc": Variant(
        "XQC",
        "Batch normalisation, unit weights and a distribution over scaled returns; two updates per step.",
        SCALED_RETURNS
        | {
            "network": "batch_norm_mlp",
            "hidden_layers": (256, 256, 256, 256),
            "critic_hidden_layers": (512, 512, 512, 512),
            "joint_forward": True,
            "weight_projection": "unit_columns",
            "discount": 0.995,
            "learning_rate_schedule": "linear",
            "final_learning_rate_share": 0.1,
            "actor_interval": 3,
            "updates_per_interval": 2,
            "update_interval": 1,
            "random_steps": 5_000,
            "reward_scaling": "deviation",
            "target_entropy_per_action": -0.5,
        },
        source="Palenicek et al. 2025",
        cost=22.3,
    ),
    "simbav2": Variant(
        "SimbaV2",
        "Features and weights on unit spheres, a distribution over scaled returns; two updates per step.",
        SCALED_RETURNS
        | {
            "network": "hyperspherical",
            "hidden_layers": (128,),
            "critic_hidden_layers": (512, 512),
            "weight_projection": "unit_columns",
            "log_std_bounding": "tanh",
            "update_order": ("actor", "temperature", "critic", "targets"),
            "discount": 0.995,
            "actor_learning_rate": 1e-4,
            "critic_learning_rate": 1e-4,
            "temperature_learning_rate": 1e-4,
            "learning_rate_schedule": "linear",
            "final_learning_rate_share": 0.5,
            "updates_per_interval": 2,
            "update_interval": 1,
            "random_steps": 5_000,
            "observation_normalisation": "running",
            "reward_scaling": "deviation_or_bound",
            "target_entropy_per_action": -0.5,
        },
        source="Lee et al. 2025",
        cost=95.1,
    ),
    "flashsac": Variant(
        "FlashSAC",
        "Residual networks with batch normalisation and weights of constant length; large batches, held noise.",
        SCALED_RETURNS
        | {
            "network": "batch_norm_residual",
            "hidden_layers": (128, 128),
            "critic_hidden_layers": (256, 256),
            "joint_forward": True,
            "actor_joint_forward": True,
            "weight_projection": "unit_columns",
            "log_std_bounding": "tanh",
            "update_order": ("actor", "temperature", "critic", "targets"),
            "actor_interval": 2,
            "batch_size": 512,
            "polyak_rate": 0.01,
            "learning_rate_schedule": "cosine",
            "final_learning_rate_share": 0.5,
            "updates_per_interval": 1,
            "update_interval": 1,
            "random_steps": 10_000,
            "longest_noise": 16,
            "reward_scaling": "deviation_or_bound",
            "target_entropy_per_action": -0.4781814,
        },
        source="Kim et al. 2026",
        cost=32.5,
    ),
}


def task_name(environment: str) -> str:
    """A Gymnasium id without package and namespace: Humanoid-v4 of package.module:name/Humanoid-v4."""
    return environment.rpartition(":")[2].rpartition("/")[2]


def fixed_temperature(environment: str) -> float:
    """The paper's fixed α (Table 1): 0.1 on Humanoid; 0.2 on HalfCheetah and, here, everywhere else."""
    return 0.1 if task_name(environment).startswith("Humanoid-") else 0.2


def default_settings(environment: str) -> AlgorithmSettings:
    """Plain SAC on an environment: what any protocol and variant may change."""
    return AlgorithmSettings(initial_temperature=fixed_temperature(environment))


def variant_changes(variant: str, environment: str) -> dict[str, Any]:
    """A variant's row on an environment; raises UserError for an unknown one."""
    if variant not in VARIANTS:
        raise unknown_name("variant", variant, VARIANTS)
    row = VARIANTS[variant]
    here = [changes for prefix, changes in row.by_environment.items() if task_name(environment).startswith(prefix)]
    return functools.reduce(operator.or_, here, row.settings)


def needed_settings(variant: str, environment: str) -> dict[str, str]:
    """The settings that a variant's row has to be given on an environment, and in words, what to give."""
    known = variant_changes(variant, environment)
    return {name: way_out for name, way_out in VARIANTS[variant].needs.items() if name not in known}


def variant_settings(variant: str, environment: str) -> AlgorithmSettings:
    """The algorithm of a variant on an environment, whatever the protocol; raises UserError for an unknown variant."""
    own = field_names(AlgorithmSettings)
    changes = {name: value for name, value in variant_changes(variant, environment).items() if name in own}
    return replace_settings(default_settings(environment), changes)
