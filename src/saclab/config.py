"""What decides the result of a run: its settings, environment and seed.

This file imports no numerical library, so that `saclab --help` stays fast.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, get_type_hints

import msgspec

from saclab.errors import UserError, require
from saclab.other_names import unknown_setting
from saclab.settings import AlgorithmSettings, TrainingSettings, structure

Plain = TypeVar("Plain")


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
        require(
            is_json(self.environment_arguments),
            "environment_arguments", self.environment_arguments,
            "use what JSON has: finite numbers, text, true, false, null, lists and objects",
        )  # fmt: skip
        batch, training = self.algorithm.batch_size, self.training
        require(
            batch <= training.random_steps or training.fills_replay,  # which is looked at when it is there
            "batch_size", batch,
            f"the first update would draw from a buffer of {training.random_steps} transitions: use "
            + f"--batch-size {training.random_steps} or less, or " * (training.random_steps > 0)
            + f"--random-steps {batch} or more",
        )  # fmt: skip
        require(
            batch <= training.replay_capacity,
            "batch_size", batch, f"use at most replay_capacity {training.replay_capacity}",
        )  # fmt: skip
        held = self.algorithm.n_step * training.parallel_environments
        require(
            held <= training.replay_capacity,
            "replay_capacity", training.replay_capacity,
            f"use at least {held}: n_step {self.algorithm.n_step} transitions of each of "
            f"{training.parallel_environments} parallel_environments must be held together",
        )  # fmt: skip
        require(
            self.algorithm.learning_rate_schedule == "constant" or self.planned_updates is not None,
            "learning_rate_schedule", self.algorithm.learning_rate_schedule,
            "give max_updates or max_steps too: it must know how many updates there will be",
        )  # fmt: skip
        by_share = [term.text for term in self.algorithm.scheduled_terms if not term.by_return]
        require(
            not by_share or self.planned_updates is not None,
            "reward_schedule", " ".join(by_share),
            "give max_updates or max_steps too: it must know how many updates there will be; or give its points as "
            "evaluation returns, such as 1@return=500",
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able dictionary; `from_dict` is its inverse."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Config:
        """Rebuild a Config from `to_dict`; raises as `from_plain` does."""
        return from_plain(Config, values)

    @property
    def planned_updates(self) -> int | None:
        """Updates of a run that goes to its limit of updates or steps; None if it has neither."""
        training = self.training
        if training.max_steps is None:
            return training.max_updates
        return training.updates_due(training.max_steps)

    def differences(self, other: Config) -> dict[str, tuple[Any, Any]]:
        """Settings whose values differ: name -> (value here, value there)."""
        mine, theirs = flatten(self.to_dict()), flatten(other.to_dict())
        return {
            name: (mine.get(name), theirs.get(name))
            for name in sorted(mine.keys() | theirs.keys())
            if mine.get(name) != theirs.get(name)
        }


def from_plain(kind: type[Plain], values: object) -> Plain:
    """A dataclass of settings from plain values, where tuples are lists; what is missing has its default.

    Raises:
        UserError: for a name that is no setting, or a value that cannot work.
        msgspec.ValidationError: for a value of another type, with its place.
    """
    require_known_names(kind, values)
    return msgspec.convert(values, kind)


def require_known_names(kind: Any, values: object) -> None:
    """Raise UserError for a name that is no setting of a dataclass or of one inside it."""
    hints = get_type_hints(kind)
    for name, value in values.items() if isinstance(values, dict) else ():
        if name not in hints:
            raise unknown_setting(name, hints)
        if dataclasses.is_dataclass(hints[name]):
            require_known_names(hints[name], value)


def is_json(value: object) -> bool:
    """Whether a value can be written as JSON, and read back as it is but for tuples."""
    try:
        json.dumps(value, allow_nan=False, ensure_ascii=False).encode()
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def flatten(values: dict[str, Any]) -> dict[str, Any]:
    """The settings of a configuration in one level; names do not clash between its parts."""
    flat = {key: value for key, value in values.items() if key not in ("algorithm", "training")}
    return {**flat, **values["algorithm"], **values["training"]}


OWN_SETTINGS = (
    "seed", "variant", "protocol",
    "max_steps", "max_episodes", "patience_episodes", "evaluation_interval_episodes", "evaluation_interval_steps",
    "evaluation_episodes", "q_bias_episodes", "log_interval",
)  # fmt: skip
"""What decides nothing of a step: the runs of a group may differ in it, as in plain numbers."""


def group_key(config: Config) -> str:
    """What the runs of a group have in common: everything but the seed, plain numbers and when a run is evaluated."""
    return json.dumps(common_settings(config), sort_keys=True)


def common_settings(config: Config) -> dict[str, Any]:
    """The settings that decide a run's `group_key`, by name."""
    shared = flatten(dataclasses.replace(config, algorithm=structure(config.algorithm)).to_dict())
    return {name: value for name, value in shared.items() if name not in OWN_SETTINGS}


def require_same_structure(configs: Sequence[Config]) -> None:
    """Refuse runs that cannot be one run group: raises UserError with the first setting that differs."""
    expected = common_settings(configs[0])
    for place, config in enumerate(configs[1:], start=1):
        for name, value in common_settings(config).items():
            if value != expected[name]:
                raise UserError(
                    f"the runs of a run group must agree in {name}, and it is {expected[name]!r} in the first and "
                    f"{value!r} in number {place + 1}: train them in run groups of their own, or each alone (--batch 0)"
                )
