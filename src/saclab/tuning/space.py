"""What is searched: for each setting a range or a choice, as data. Defaults for every variant; a file changes them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import msgspec

from saclab.errors import SettingError, UserError, require
from saclab.other_names import unknown_setting
from saclab.settings import AlgorithmSettings, TrainingSettings, field_names

if TYPE_CHECKING:
    from optuna.trial import Trial


@dataclass(frozen=True)
class Range:
    """All values between two."""

    low: float
    high: float
    log: bool = False
    """Whether as many are tried between 0.001 and 0.01 as between 0.01 and 0.1."""

    def __post_init__(self) -> None:
        require(self.low < self.high, "low", self.low, f"use a value below high, {self.high}")
        require(not self.log or self.low > 0, "low", self.low, "use a value above 0 together with log")

    @property
    def ends(self) -> tuple[Any, ...]:
        return self.low, self.high

    def holds(self, value: Any) -> bool:
        return value is not None and self.low <= value <= self.high


@dataclass(frozen=True)
class Choice:
    """Some values, in no order."""

    choices: tuple[Any, ...]

    def __post_init__(self) -> None:
        require(len(self.choices) >= 2, "choices", self.choices, "give at least two values")

    @property
    def ends(self) -> tuple[Any, ...]:
        return self.choices

    def holds(self, value: Any) -> bool:
        return value in self.choices


Space = dict[str, Range | Choice]
"""Setting -> what is searched of it."""
NOT_SEARCHED = (
    "wrappers", "max_steps", "max_updates", "max_episodes", "patience_episodes", "evaluation_interval_episodes",
    "evaluation_interval_steps", "evaluation_episodes", "q_bias_episodes", "log_interval", "reward_terms",
    "reward_weights", "reward_schedule", "update_order",
)  # fmt: skip
"""Settings that decide how long a trial is and how it is judged, or that no range can say."""
LEARNING_RATE = Range(1e-4, 5e-3, log=True)

Applies = Callable[[AlgorithmSettings], bool]
DEFAULTS: dict[str, tuple[Range | Choice, Applies]] = {
    "discount": (Choice((0.95, 0.98, 0.99, 0.995, 0.999)), lambda own: True),
    "batch_size": (Choice((64, 128, 256, 512)), lambda own: True),
    "critic_learning_rate": (LEARNING_RATE, lambda own: True),
    "actor_learning_rate": (LEARNING_RATE, lambda own: True),
    "temperature_learning_rate": (LEARNING_RATE, lambda own: own.temperature == "learned"),
    "target_entropy_per_action": (
        Range(-2.0, 0.0),
        lambda own: own.temperature == "learned" and not own.target_entropy,
    ),
    "initial_temperature": (Range(0.01, 1.0, log=True), lambda own: own.temperature == "fixed"),
    "polyak_rate": (Range(1e-3, 5e-2, log=True), lambda own: own.snapshots > 0),
    "hidden_layers": (
        Choice(((64, 64), (128, 128), (256, 256), (400, 300))),
        lambda own: own.network == own.network_of_critic == "mlp" and own.critic_hidden_layers is None,
    ),
    "snapshots": (Choice((2, 5, 10, 20)), lambda own: own.snapshots > 1),
    "snapshot_interval": (Range(1, 300, log=True), lambda own: own.snapshots > 1),
    "target_critics": (Choice((1, 2, 3)), lambda own: own.target_critics is not None),
    "critic_dropout": (Range(1e-3, 0.2, log=True), lambda own: own.critic_dropout > 0),
    "dropped_quantiles": (Range(0, 5), lambda own: own.target_reduction == "truncated"),
    "adam_beta_1": (Choice((0.5, 0.9)), lambda own: own.joint_forward),
    "final_learning_rate_share": (Range(0.0, 1.0), lambda own: own.learning_rate_schedule != "constant"),
}
"""Setting -> what is searched of it, of the variants that it applies to."""


def default_space(own: AlgorithmSettings) -> Space:
    """What is searched unless the user says otherwise, of a variant with these settings."""
    return {name: dimension for name, (dimension, applies) in DEFAULTS.items() if applies(own)}


def read_space(path: Path) -> dict[str, Any]:
    """A TOML file's table; raises UserError if there is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"space {path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"space {path} is not TOML: {error}") from error


def changed_space(space: Space, changes: Mapping[str, Any]) -> Space:
    """A space with some dimensions added or replaced, and those that are False left out.

    Args:
        space: what is searched otherwise.
        changes: setting -> {"low": …, "high": …, "log": …}, {"choices": […]}, a list of choices, or False. `defaults`
            = False leaves out all that `changes` does not name.

    Raises:
        UserError: for a name that is no setting, or one that cannot be searched, or values of another type.
    """
    changes = dict(changes)
    defaults = changes.pop("defaults", True)
    require(isinstance(defaults, bool), "space", f"defaults = {defaults!r}", "write true or false")
    found: Space = dict(space) if defaults else {}
    for name, entry in changes.items():
        require_searchable(name)
        if entry is False:
            found.pop(name, None)
        else:
            found[name] = dimension_of(name, entry)
    require(bool(found), "space", changes, "leave at least one setting to search")
    return found


def require_searchable(name: str) -> None:
    """Raise UserError for what is no setting, or cannot be searched."""
    known = (*field_names(AlgorithmSettings), *field_names(TrainingSettings))
    if name not in known:
        raise unknown_setting(name, known)
    require(
        name not in NOT_SEARCHED, "space", name,
        "all trials must agree in it: give it as an option, which holds for every trial",
    )  # fmt: skip


def dimension_of(name: str, entry: Any) -> Range | Choice:
    """What is searched of a setting, its values of the setting's type."""
    if isinstance(entry, Range | Choice):
        entry = {"choices": entry.choices} if isinstance(entry, Choice) else vars(entry)
    entry = {"choices": entry} if isinstance(entry, list | tuple) else entry
    keys = set(entry) if isinstance(entry, Mapping) else set()
    require(
        keys == {"choices"} or ({"low", "high"} <= keys <= {"low", "high", "log"}), "space", f"{name}: {entry!r}",
        "write low and high (and log = true), or choices = [...], or false to leave it as it is",
    )  # fmt: skip
    try:
        if keys == {"choices"}:
            return Choice(tuple(dict.fromkeys(msgspec.convert(value, type_of(name)) for value in entry["choices"])))
        low, high = (msgspec.convert(entry[end], type_of(name)) for end in ("low", "high"))
        numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
        require(numbers, "space", f"{name}: {entry!r}", "only numbers have a range: give choices")
        return Range(low, high, msgspec.convert(entry.get("log", False), bool))
    except (msgspec.ValidationError, TypeError) as error:
        raise SettingError("space", f"{name}: {entry!r}", str(error)) from error
    except SettingError as error:
        raise SettingError(f"space, {name}: {error.setting}", error.value, error.way_out) from error


def type_of(name: str) -> Any:
    return (get_type_hints(AlgorithmSettings) | get_type_hints(TrainingSettings))[name]


def is_whole(name: str) -> bool:
    """Whether a setting's numbers are whole."""
    kinds = {type_of(name), *get_args(type_of(name))}
    return int in kinds and float not in kinds


def suggested_value(trial: Trial, name: str, dimension: Range | Choice) -> Any:
    """A setting's value in a trial: the one that it has already, or one drawn."""
    match dimension:
        case Range(low, high, log) if is_whole(name):
            return trial.suggest_int(name, int(low), int(high), log=log)
        case Range(low, high, log):
            return trial.suggest_float(name, low, high, log=log)
        case Choice(choices):
            keys = {plain(value): value for value in choices}
            return keys[trial.suggest_categorical(name, list(keys))]


def plain(value: Any) -> Any:
    """A value as Optuna stores it: lists as JSON."""
    return json.dumps(value) if isinstance(value, tuple | list) else value


def values_of(space: Space, params: Mapping[str, Any]) -> dict[str, Any]:
    """A trial's settings from what Optuna has stored of them; the inverse of `plain` for each."""
    return {
        name: next((choice for choice in space[name].ends if plain(choice) == value), value)
        if isinstance(space[name], Choice)
        else value
        for name, value in params.items()
        if name in space
    }


def value_text(value: Any) -> str:
    """A setting's value, short."""
    if isinstance(value, tuple | list):
        return " ".join(map(str, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)
