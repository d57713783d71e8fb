"""The running scale of rewards, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from saclab.training.checkpoint import CheckpointError
from saclab.training.reward_scale import RewardScale

STEPS = [(1.0, False), (2.0, False), (3.0, True), (4.0, False)]  # discounted by ½: G = 1, 2.5, 3, 5.5


def after(kind: str, steps) -> list[float]:
    scale, values = RewardScale(kind, 1, discount=0.5, bound=5.0), []
    for reward, ended in steps:
        scale.enter(np.array([reward]), np.array([ended]))
        values.append(float(scale.value))
    return values


def test_the_larger_of_deviation_and_bound_by_hand():
    # the largest return over the bound: 1 / 5; then the deviations of 1 and 2.5; of 1, 2.5 and 3; of all four
    assert after("deviation_or_bound", STEPS) == pytest.approx([0.2, 0.750, 0.850, 1.620], abs=2e-3)


def test_the_deviation_alone_by_hand():
    assert after("deviation", STEPS)[1:] == pytest.approx([0.750, 0.850, 1.620], abs=2e-3)


def test_nothing_is_divided_unless_it_is_asked_for():
    assert after("none", STEPS) == [1, 1, 1, 1]


def test_several_environments_count_as_as_many_returns():
    scale = RewardScale("deviation", 2, discount=0.0, bound=1.0)
    rewards = np.random.default_rng(0).normal(3, 2, (500, 2))
    for reward in rewards:
        scale.enter(reward, np.array([False, False]))
    assert scale.value == pytest.approx(rewards.std(), rel=1e-3)


def test_it_goes_on_as_if_it_had_never_stopped():
    first, second = (RewardScale("deviation_or_bound", 1, 0.9, 5.0) for _ in range(2))
    for reward in (1.0, -2.0, 3.0):
        first.enter(np.array([reward]), np.array([False]))
    second.restore(first.capture())
    for scale in (first, second):
        scale.enter(np.array([0.5]), np.array([False]))
    assert first.value == second.value
    with pytest.raises(CheckpointError, match="moments"):
        second.restore({"returns": np.zeros(1)})
