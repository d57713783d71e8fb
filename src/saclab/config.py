"""Every setting of a run, as frozen dataclasses: one docstring per field, checked when it is built.

This file imports no numerical library, so that `saclab --help` stays fast.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from saclab.errors import SettingError, UserError, unknown_name

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def require(condition: bool, setting: str, value: object, way_out: str) -> None:
    """Raise a SettingError that names the setting, its value and what would work, unless `condition` holds."""
    if not condition:
        raise SettingError(setting, value, way_out)


@dataclass(frozen=True)
class AlgorithmSettings:
    """One point in the space of SAC variants. Defaults: Table 1 of the paper, plain SAC."""

    discount: float = 0.99
    """γ: weight of the next state's value, in [0, 1)."""
    batch_size: int = 256
    """Transitions per update."""
    critic_learning_rate: float = 3e-4
    """Adam's learning rate for the Q-networks."""
    actor_learning_rate: float = 3e-4
    """Adam's learning rate for the policy."""

    network: Literal["mlp"] = "mlp"
    """Architecture of all networks."""
    hidden_layers: tuple[int, ...] = (256, 256)
    """Units of each hidden layer, of all networks."""
    activation: Literal["relu", "tanh", "elu", "silu", "gelu"] = "relu"
    """Non-linearity after each hidden layer."""
    critics: int = 2
    """Q-networks that are trained side by side."""

    polyak_rate: float = 0.005
    """τ: share of the critic that enters its target at each update (Eq. 2)."""
    snapshots: int = 1
    """K: target snapshots over which the next state's value is averaged (Eq. 9). 1 is plain SAC."""
    snapshot_interval: int = 1
    """Updates between two target snapshots. 1 is the literal Eq. 9."""
    entropy_window: int = 1
    """Minibatches over which α·log π of the target is averaged row by row, from zeros: what the paper's authors
    ran as "Averaged-SAC". The rows are unrelated to each other; this is not Eq. 9. 1 is plain SAC."""
    target_reduction: Literal["minimum", "mean"] = "minimum"
    """How the critics are reduced to one Q in the target (Eq. 4)."""
    actor_reduction: Literal["minimum", "mean"] = "minimum"
    """How the critics are reduced to one Q in the policy loss (Eq. 5)."""

    temperature: Literal["fixed", "learned"] = "fixed"
    """Whether α is fixed or learned by dual descent (Eq. 8)."""
    initial_temperature: float = 0.2
    """α, or its first value if it is learned."""
    temperature_learning_rate: float = 3e-4
    """Adam's learning rate for log α, if it is learned."""
    temperature_gradient: Literal["log_alpha", "alpha"] = "log_alpha"
    """The factor before (−log π − target entropy) in the temperature loss: log α (the paper's authors,
    Stable-Baselines3) or α itself (Eq. 8 to the letter, CleanRL). Adam moves log α in both cases."""
    target_entropy: float | None = None
    """Entropy that the learned temperature holds the policy to, in nats; None is −dim(A)."""
    log_std_minimum: float = -20.0
    """Lower clip of the policy's log standard deviation."""
    log_std_maximum: float = 2.0
    """Upper clip of the policy's log standard deviation."""

    def __post_init__(self) -> None:
        require(0 <= self.discount < 1, "discount", self.discount, "use a value in [0, 1), such as 0.99")
        require(0 < self.polyak_rate <= 1, "polyak_rate", self.polyak_rate, "use a value in (0, 1], such as 0.005")
        for name in ("batch_size", "critics", "snapshots", "snapshot_interval", "entropy_window"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "use a whole number of at least 1")
        for name in ("critic_learning_rate", "actor_learning_rate", "temperature_learning_rate"):
            require(0 <= getattr(self, name) < 1, name, getattr(self, name), "use a value in [0, 1), such as 3e-4")
        require(
            len(self.hidden_layers) > 0 and min(self.hidden_layers) >= 1,
            "hidden_layers", self.hidden_layers, "use one or more positive widths, such as 256 256",
        )  # fmt: skip
        lowest_allowed = "above 0" if self.temperature == "learned" else "of at least 0"
        require(
            self.initial_temperature > 0 or (self.temperature == "fixed" and self.initial_temperature == 0),
            "initial_temperature", self.initial_temperature, f"use a value {lowest_allowed}, such as 0.2",
        )  # fmt: skip
        require(
            self.log_std_minimum < self.log_std_maximum,
            "log_std_minimum", self.log_std_minimum, f"use a value below log_std_maximum {self.log_std_maximum}",
        )  # fmt: skip
        require(
            self.snapshots == 1 or self.entropy_window == 1,
            "entropy_window", self.entropy_window,
            f"use 1 together with snapshots {self.snapshots}: averaging values (Eq. 9) and averaging the entropy "
            "term are two different algorithms",
        )  # fmt: skip


@dataclass(frozen=True)
class TrainingSettings:
    """How a run goes: how much experience, how many updates, when it is tested, when it stops."""

    parallel_environments: int = 1
    """Training environments stepped in turn. The update-to-data ratio does not depend on it: steps are counted
    over all environments."""
    random_steps: int = 10_000
    """Environment steps with uniformly random actions before the first update."""
    update_interval: int = 1
    """N: environment steps between two rounds of updates."""
    updates_per_interval: int = 1
    """Updates in each round; updates_per_interval / update_interval is the update-to-data ratio."""
    acting_delay: int = 0
    """Rounds of updates by which the policy that acts is behind: 0 is the textbook's, 1 lets the environments be
    stepped while a round is computed, which saves time where there is more than one core."""
    replay_capacity: int = 1_000_000
    """Transitions that the replay buffer holds; the oldest is overwritten."""

    max_steps: int | None = None
    """Stop after so many environment steps."""
    max_updates: int | None = None
    """Stop after so many updates."""
    max_episodes: int | None = None
    """Stop after so many training episodes."""
    patience_episodes: int | None = None
    """Stop after so many training episodes without a better test return."""

    evaluation_interval_episodes: int | None = None
    """Test the policy after so many training episodes."""
    evaluation_interval_steps: int | None = None
    """Test the policy after so many environment steps."""
    evaluation_episodes: int = 10
    """Episodes of one test, with the deterministic policy (tanh of the mean), stepped side by side."""
    q_bias_episodes: int = 0
    """Episodes of the stochastic policy after each test, from which the critics' bias is estimated; 0 for none."""
    log_interval: int = 200
    """Updates that are averaged into one line of metrics.jsonl."""

    def __post_init__(self) -> None:
        positive = ("parallel_environments", "update_interval", "updates_per_interval", "replay_capacity",
                    "evaluation_episodes", "log_interval")  # fmt: skip
        for name in positive:
            require(getattr(self, name) >= 1, name, getattr(self, name), "use a whole number of at least 1")
        optional = ("max_steps", "max_updates", "max_episodes", "patience_episodes",
                    "evaluation_interval_episodes", "evaluation_interval_steps")  # fmt: skip
        for name in optional:
            value = getattr(self, name)
            require(value is None or value >= 1, name, value, "use a whole number of at least 1, or leave it out")
        require(self.acting_delay in (0, 1), "acting_delay", self.acting_delay, "use 0 or 1")
        for name in ("random_steps", "q_bias_episodes"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "use 0 or more")
        require(
            (self.max_steps, self.max_updates, self.max_episodes) != (None, None, None),
            "max_steps", None, "give at least one of max_steps, max_updates and max_episodes",
        )  # fmt: skip
        require(
            (self.evaluation_interval_episodes is None) != (self.evaluation_interval_steps is None),
            "evaluation_interval_episodes", self.evaluation_interval_episodes,
            f"give exactly one of it and evaluation_interval_steps (now {self.evaluation_interval_steps}), "
            "and None for the other",
        )  # fmt: skip

    @property
    def update_to_data_ratio(self) -> float:
        """Updates per environment step."""
        return self.updates_per_interval / self.update_interval

    def updates_due(self, steps: int) -> int:
        """Updates that should have been made once `steps` environment steps are done."""
        rounds = max(0, steps - self.random_steps) // self.update_interval
        due = rounds * self.updates_per_interval
        return due if self.max_updates is None else min(due, self.max_updates)


@dataclass(frozen=True)
class Config:
    """Everything that decides the result of a run."""

    environment: str
    """Gymnasium id, such as HalfCheetah-v4 or package.module:Name-v0."""
    variant: str
    protocol: str
    seed: int
    algorithm: AlgorithmSettings
    training: TrainingSettings
    environment_arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment."""

    def __post_init__(self) -> None:
        require(0 <= self.seed < 2**63, "seed", self.seed, "use a whole number from 0 to 2**63 - 1")
        batch, training = self.algorithm.batch_size, self.training
        require(
            batch <= training.random_steps,
            "batch_size", batch,
            f"the first update would draw from a buffer of {training.random_steps} transitions: "
            f"use --batch-size {training.random_steps} or less, or --random-steps {batch} or more",
        )  # fmt: skip
        require(
            batch <= training.replay_capacity,
            "batch_size", batch, f"use at most replay_capacity {training.replay_capacity}",
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able dictionary; `from_dict` is its inverse."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Config:
        """Rebuild a Config from `to_dict`; raises SettingError for a setting this version does not know."""
        algorithm = dict(values["algorithm"])
        algorithm["hidden_layers"] = tuple(algorithm["hidden_layers"])
        return Config(
            **{key: value for key, value in values.items() if key not in ("algorithm", "training")},
            algorithm=replace_settings(AlgorithmSettings(), algorithm),
            training=replace_settings(TrainingSettings(max_steps=1, evaluation_interval_steps=1), values["training"]),
        )

    def differences(self, other: Config) -> dict[str, tuple[Any, Any]]:
        """Settings whose values differ: name -> (value here, value there)."""
        mine, theirs = flatten(self.to_dict()), flatten(other.to_dict())
        return {
            name: (mine.get(name), theirs.get(name))
            for name in sorted(mine.keys() | theirs.keys())
            if mine.get(name) != theirs.get(name)
        }


Settings = TypeVar("Settings", AlgorithmSettings, TrainingSettings)


def flatten(values: dict[str, Any]) -> dict[str, Any]:
    """The settings of a configuration in one level; names do not clash between its parts."""
    flat = {key: value for key, value in values.items() if key not in ("algorithm", "training")}
    return {**flat, **values["algorithm"], **values["training"]}


def field_names(settings: type[DataclassInstance]) -> tuple[str, ...]:
    """Names of the settings in a dataclass."""
    return tuple(entry.name for entry in dataclasses.fields(settings))


def replace_settings(settings: Settings, overrides: Mapping[str, Any]) -> Settings:
    """`settings` with some values changed; raises for a name that is not one of its settings."""
    known = field_names(type(settings))
    for name in overrides:
        if name not in known:
            raise unknown_name("setting", name, known)
    return dataclasses.replace(settings, **overrides)


OWN_SETTINGS = (
    "seed", "variant", "protocol",
    "discount", "critic_learning_rate", "actor_learning_rate", "polyak_rate", "snapshot_interval", "temperature",
    "initial_temperature", "temperature_learning_rate", "target_entropy", "log_std_minimum", "log_std_maximum",
    "max_steps", "max_episodes", "patience_episodes", "evaluation_interval_episodes", "evaluation_interval_steps",
    "evaluation_episodes", "q_bias_episodes", "log_interval",
)  # fmt: skip
"""Settings in which the runs of a group may differ: plain numbers, and those that decide nothing of a step."""


def structure(config: Config) -> str:
    """What the runs of a group have in common: everything but the seed, plain numbers and when a run is evaluated."""
    return json.dumps(common_settings(config), sort_keys=True)


def common_settings(config: Config) -> dict[str, Any]:
    """The settings that decide a run's `structure`, by name."""
    return {name: value for name, value in flatten(config.to_dict()).items() if name not in OWN_SETTINGS}


def require_same_structure(configs: Sequence[Config]) -> None:
    """Refuse runs that cannot be one group: raises UserError with the first setting that differs."""
    expected = common_settings(configs[0])
    for place, config in enumerate(configs[1:], start=1):
        for name, value in common_settings(config).items():
            if value != expected[name]:
                raise UserError(
                    f"the runs of one group must agree in {name}, and it is {expected[name]!r} in the first and "
                    f"{value!r} in number {place + 1}: train them in groups of their own, or each alone (--batch 0)"
                )
