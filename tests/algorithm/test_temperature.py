"""Eq. 8: both forms of the loss by hand, and where α goes."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import make_case

from saclab.algorithm.losses import temperature_loss
from saclab.settings import AlgorithmSettings


def loss_and_slope(log_alpha: float, entropy: float, target: float, factor: str) -> tuple[float, float]:
    numbers = (jnp.float32(value) for value in (log_alpha, entropy, target))
    loss, slope = jax.value_and_grad(temperature_loss)(*numbers, factor)
    return float(loss), float(slope)


def test_the_loss_on_log_alpha_is_log_alpha_times_the_entropy_excess():
    assert loss_and_slope(math.log(0.5), 2.0, -2.0, "log_alpha") == pytest.approx((math.log(0.5) * 4, 4), rel=1e-6)


def test_the_loss_on_alpha_is_alpha_times_the_entropy_excess():
    assert loss_and_slope(math.log(0.5), 2.0, -2.0, "alpha") == pytest.approx((0.5 * 4, 0.5 * 4), rel=1e-6)


@pytest.mark.parametrize("gradient", ["log_alpha", "alpha"])
@pytest.mark.parametrize(("above", "direction"), [(1.0, -1), (-1.0, 1)])
def test_alpha_falls_above_the_target_entropy_and_rises_below_it(gradient, above, direction):
    entropy = first_entropy()
    moved = log_alpha_after_one_update(temperature_gradient=gradient, target_entropy=entropy - above)
    assert moved == pytest.approx(direction * 0.01, rel=1e-3)  # Adam's first step is the learning rate


def test_the_target_entropy_is_minus_the_number_of_actions_by_default():
    state, report = after_one_update()  # α = 1: log α = 0, and so is the loss
    assert report["temperature_loss"] == 0
    assert state.temperature.moments.mu / 0.1 == pytest.approx(report["entropy"] + 2, rel=1e-5)  # two actions


def test_a_fixed_temperature_stays_for_any_entropy():
    assert log_alpha_after_one_update(temperature="fixed", initial_temperature=0.25) == np.log(np.float32(0.25))


def after_one_update(**changes):
    settings = {"temperature": "learned", "initial_temperature": 1.0, "temperature_learning_rate": 0.01}
    case = make_case(AlgorithmSettings(hidden_layers=(8,), batch_size=6, **settings | changes))
    state = case.update(case.initial_state(), case.batch(np.random.default_rng(0)), 0)
    return state, case.report(state)


def first_entropy() -> float:
    return after_one_update()[1]["entropy"]


def log_alpha_after_one_update(**changes) -> float:
    return float(after_one_update(**changes)[0].temperature.weights)
