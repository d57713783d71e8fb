"""The training protocols, each a row of data, and the one place where a run's configuration is put together."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_type_hints

import msgspec

from saclab.config import Config
from saclab.errors import SettingError, require, unknown_name
from saclab.files import absolute
from saclab.other_names import unknown_setting
from saclab.settings import AlgorithmSettings, TrainingSettings, field_names, replace_settings
from saclab.variants import default_settings, needed_settings, task_name, variant_changes

DATA_SET_PATHS = ("/", "./", "../", "~")
"""How the name of a Minari data set begins that is the path of one; the others are ids."""


@dataclass(frozen=True)
class Protocol:
    description: str
    settings: TrainingSettings
    seeds: int = 5
    """Seeds of a comparison, unless another number is asked for."""
    by_environment: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What differs for environments whose id starts with a key."""
    algorithm: dict[str, Any] = field(default_factory=dict)
    """What the protocol changes of the algorithm's settings."""
    ceilings: dict[str, int] = field(default_factory=dict)
    """What a variant's own settings are held to, each layer of a network apart; what the user says is not."""


PROTOCOLS: dict[str, Protocol] = {
    "paper": Protocol(
        "The paper's experiment: an update every 5 steps, replay of 2e5, an evaluation of 20 episodes every 10; "
        "1.2e6 updates, on Humanoid at most 1.5e6 updates or 1e4 episodes or 750 episodes without a better evaluation.",
        TrainingSettings(
            random_steps=10_000,
            update_interval=5,
            replay_capacity=200_000,
            max_updates=1_200_000,
            evaluation_interval_episodes=10,
            evaluation_episodes=20,
        ),
        by_environment={
            "Humanoid-": {"max_updates": 1_500_000, "max_episodes": 10_000, "patience_episodes": 750},
        },
    ),
    "standard": Protocol(
        "What most SAC papers report: 1M environment steps, an update each step, replay of 1e6, "
        "an evaluation of 10 episodes every 10k steps.",
        TrainingSettings(
            random_steps=10_000,
            update_interval=1,
            replay_capacity=1_000_000,
            max_steps=1_000_000,
            evaluation_interval_steps=10_000,
            evaluation_episodes=10,
            log_interval=1000,
        ),
    ),
    "fast": Protocol(
        "A good policy in little time on a CPU: standard with batches of 64, learning rates of 2e-3, half the random "
        "steps and a fifth of the others; on Humanoid standard with an update every 5 steps. Tuned for sac-auto on "
        "HalfCheetah-v4, measured on Humanoid-v4 too; what it reaches in the end was not compared, and a variant with "
        "batches or learning rates of its own keeps them.",
        TrainingSettings(
            random_steps=5_000,
            update_interval=1,
            replay_capacity=1_000_000,
            max_steps=200_000,
            evaluation_interval_steps=5_000,
            evaluation_episodes=5,
            log_interval=1000,
        ),
        by_environment={
            "Humanoid-": {
                "random_steps": 10_000,
                "update_interval": 5,
                "max_steps": 1_000_000,
                "batch_size": 256,
                "actor_learning_rate": 3e-4,
                "critic_learning_rate": 3e-4,
                "temperature_learning_rate": 3e-4,
            },
        },
        algorithm={
            "batch_size": 64,
            "actor_learning_rate": 2e-3,
            "critic_learning_rate": 2e-3,
            "temperature_learning_rate": 2e-3,
        },
    ),
    "quick": Protocol(
        "Minutes instead of hours, to see every part at work: smaller batches and larger steps than the others, and "
        "too short to judge a variant by. A variant's own batches, layers, updates per step, random steps and "
        "period of the policy are held to what that allows.",
        TrainingSettings(
            random_steps=2_000,
            update_interval=2,
            replay_capacity=100_000,
            max_updates=20_000,
            evaluation_interval_steps=2_000,
            evaluation_episodes=5,
        ),
        seeds=1,
        algorithm={
            "batch_size": 64,
            "actor_learning_rate": 1e-3,
            "critic_learning_rate": 1e-3,
            "temperature_learning_rate": 1e-3,
        },
        ceilings={
            "batch_size": 64,
            "hidden_layers": 256,
            "critic_hidden_layers": 256,
            "actor_interval": 3,
            "updates_per_interval": 1,
            "random_steps": 2_000,
        },
    ),
}


def protocol_row(protocol: str) -> Protocol:
    """The protocol of a name; raises UserError for an unknown one."""
    if protocol not in PROTOCOLS:
        raise unknown_name("protocol", protocol, PROTOCOLS)
    return PROTOCOLS[protocol]


def protocol_settings(protocol: str, environment: str) -> dict[str, Any]:
    """What a protocol sets on an environment, of either kind of settings; raises UserError for an unknown one."""
    row = protocol_row(protocol)
    changes = dataclasses.asdict(row.settings) | row.algorithm
    for prefix, here in row.by_environment.items():
        if task_name(environment).startswith(prefix):
            changes |= here
    return changes


def training_settings(protocol: str, environment: str) -> TrainingSettings:
    """The training settings of a protocol on an environment; raises UserError for an unknown protocol."""
    return TrainingSettings(**split_settings(protocol_settings(protocol, environment))[1])


def make_config(
    environment: str,
    variant: str = "sac-auto",
    protocol: str = "standard",
    seed: int = 0,
    environment_arguments: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """The configuration of a run: variant and protocol on an environment, with any setting changed by name.

    What is said later counts: the defaults of the environment, the protocol, the variant (up to the protocol's
    ceilings), the overrides.

    Args:
        environment: Gymnasium id.
        variant: a key of VARIANTS.
        protocol: a key of PROTOCOLS.
        seed: every random draw of the run derives from it.
        environment_arguments: keyword arguments of the environment.
        overrides: settings of AlgorithmSettings or TrainingSettings by name, with their values.

    Raises:
        UserError: for a name that does not exist or a value that cannot work.
    """
    for name, way_out in needed_settings(variant, environment).items():
        given = (overrides or {}).get(name)
        require(bool(given), name, given, f"{way_out} (variant {variant} on {environment})")
    return own_config(environment, variant, protocol, seed, environment_arguments, overrides)


def own_config(
    environment: str,
    variant: str,
    protocol: str,
    seed: int = 0,
    environment_arguments: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """What `make_config` gives, also where the variant needs a setting that is not given: to compare a run with."""
    changes = held_to(protocol_row(protocol).ceilings, variant_changes(variant, environment))
    said = protocol_settings(protocol, environment) | changes | dict(overrides or {})
    algorithm, training = map(typed, split_settings(said), (AlgorithmSettings, TrainingSettings))
    return Config(
        environment=environment,
        variant=variant,
        protocol=protocol,
        seed=of_type("seed", seed, int),
        algorithm=replace_settings(default_settings(environment), algorithm),
        training=with_stable_prefill(TrainingSettings(**training)),
        environment_arguments=dict(environment_arguments or {}),
    )


def typed(settings: Mapping[str, Any], kind: type[AlgorithmSettings | TrainingSettings]) -> dict[str, Any]:
    """Settings by name, each of its type; raises SettingError for a value of another."""
    hints = get_type_hints(kind)
    return {name: of_type(name, value, hints[name]) for name, value in settings.items()}


def of_type(name: str, value: Any, hint: Any) -> Any:
    """A value as its type has it: a list as a tuple, a whole number as a float, a number of NumPy's as Python's."""
    try:
        return msgspec.convert(value.item() if hasattr(value, "item") else value, hint)
    except msgspec.ValidationError as error:
        raise SettingError(name, value, str(error)) from error


def with_stable_prefill(training: TrainingSettings) -> TrainingSettings:
    """Settings whose prefill means the same in any working directory: paths are absolute, ids stay as they are."""
    kind, name = training.prefill_source or ("", "")
    if not kind or (kind == "minari" and not name.startswith(DATA_SET_PATHS)):
        return training
    require(
        kind == "minari" or not name.startswith("hf:"), "prefill", training.prefill,
        "it takes folders of this machine: download the model first, with hf download "
        f"{name[3:].replace('@', ' --revision ')} --local-dir model, then write {kind}:model "
        f"(a folder of that name is {kind}:./{name})",
    )  # fmt: skip
    return dataclasses.replace(training, prefill=f"{kind}:{absolute(os.path.expanduser(name))}")


def held_to(ceilings: Mapping[str, int], settings: Mapping[str, Any]) -> dict[str, Any]:
    """`settings` with none above its ceiling."""

    def held(name: str, value: Any) -> Any:
        if name not in ceilings or value is None:
            return value
        if isinstance(value, tuple):
            return tuple(min(width, ceilings[name]) for width in value)
        return min(value, ceilings[name])

    return {name: held(name, value) for name, value in settings.items()}


def split_settings(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The settings of the algorithm and those of the training; raises UserError for a name that is neither."""
    algorithm_names, training_names = field_names(AlgorithmSettings), field_names(TrainingSettings)
    for name in settings:
        if name not in algorithm_names + training_names:
            raise unknown_setting(name, algorithm_names + training_names)
    return (
        {name: value for name, value in settings.items() if name in algorithm_names},
        {name: value for name, value in settings.items() if name in training_names},
    )
