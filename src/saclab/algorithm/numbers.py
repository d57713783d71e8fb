"""The settings of the algorithm that are plain numbers: runs that differ in nothing else can be one batch."""

from __future__ import annotations

from typing import Any, NamedTuple

from saclab.config import AlgorithmSettings

Number = Any  # a Python number, or a traced array f32[], i32[] or bool[] where runs are mapped over


class Numbers(NamedTuple):
    """Of one run; the fields are the settings of the same names."""

    discount: Number
    critic_learning_rate: Number
    actor_learning_rate: Number
    polyak_rate: Number
    snapshot_interval: Number
    temperature_learned: Number
    """Whether it is: the setting `temperature`."""
    temperature_learning_rate: Number
    target_entropy: Number
    """Never None."""
    log_std_minimum: Number
    log_std_maximum: Number


def numbers_of(settings: AlgorithmSettings, action_size: int) -> Numbers:
    """As Python numbers; the default target entropy is −dim(A)."""
    return Numbers(
        discount=settings.discount,
        critic_learning_rate=settings.critic_learning_rate,
        actor_learning_rate=settings.actor_learning_rate,
        polyak_rate=settings.polyak_rate,
        snapshot_interval=settings.snapshot_interval,
        temperature_learned=settings.temperature == "learned",
        temperature_learning_rate=settings.temperature_learning_rate,
        target_entropy=-float(action_size) if settings.target_entropy is None else settings.target_entropy,
        log_std_minimum=settings.log_std_minimum,
        log_std_maximum=settings.log_std_maximum,
    )
