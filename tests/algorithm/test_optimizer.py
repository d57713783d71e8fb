"""Adam's steps and schedules by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.optimizer import SCHEDULES, Trainer, descend
from saclab.algorithm.scalars import scalars
from saclab.settings import AlgorithmSettings


def rates(trainer: Trainer, settings: AlgorithmSettings, planned_updates: int, steps: int) -> list[float]:
    """How far each step goes while the gradient is 1 always: the learning rate, as Adam's direction is 1 then."""
    numbers, trained, places = scalars(settings, 1, planned_updates), trainer.start(jnp.float32(0)), [0.0]
    for _ in range(steps):
        trained, _ = descend(trainer, numbers, lambda weights: (weights, None), trained)
        places.append(float(trained.weights))
    return (-np.diff(places)).tolist()


def test_a_constant_learning_rate_is_the_settings():
    settings = AlgorithmSettings(actor_learning_rate=0.01)
    assert rates(Trainer("actor", "constant"), settings, 4, 3) == pytest.approx([0.01] * 3, rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "shares"), [("linear", [1, 0.875, 0.75, 0.625, 0.5, 0.5]), ("cosine", [1, 0.9268, 0.75, 0.5732, 0.5, 0.5])]
)
def test_a_schedule_ends_at_its_share_and_stays_there(kind, shares):
    settings = AlgorithmSettings(critic_learning_rate=0.1, learning_rate_schedule=kind, final_learning_rate_share=0.5)
    assert rates(Trainer("critic", kind), settings, 4, 6) == pytest.approx([0.1 * s for s in shares], rel=1e-3)


@pytest.mark.parametrize(
    ("first", "last", "kind", "middle"),
    [(1e-4, 5e-5, "linear", 7.5e-5), (3e-4, 3e-5, "linear", 1.65e-4), (3e-4, 1.5e-4, "cosine", 2.25e-4)],
    ids=["SimbaV2", "XQC", "FlashSAC"],
)
def test_half_way_the_published_schedules_have_their_rates(first, last, kind, middle):
    assert first * float(SCHEDULES[kind](jnp.float32(0.5), last / first)) == pytest.approx(middle, rel=1e-5)


def test_a_learning_rate_of_zero_moves_nothing_not_even_what_is_infinite():
    numbers, trainer = scalars(AlgorithmSettings(), 1), Trainer("temperature", "constant")
    trained, _ = descend(trainer, numbers, lambda weights: (weights * 3, None), trainer.start(jnp.float32(-jnp.inf)))
    assert np.isneginf(trained.weights)
    assert numbers["temperature_learning_rate"] == 0
