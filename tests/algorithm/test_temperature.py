"""Eq. 8: both forms of the loss by hand, and where α goes."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.numbers import numbers_of
from saclab.algorithm.temperature import TEMPERATURES
from saclab.config import AlgorithmSettings

RATE = 0.01


def learned(gradient: str = "log_alpha", target_entropy: float | None = None, actions: int = 2):
    settings = AlgorithmSettings(
        temperature="learned",
        temperature_gradient=gradient,
        temperature_learning_rate=RATE,
        target_entropy=target_entropy,
    )
    return TEMPERATURES["learned"](settings, numbers_of(settings, actions))


def step(temperature, log_alpha: float, log_prob):
    value = jnp.asarray(log_alpha, jnp.float32)
    return temperature.update(value, temperature.init(value), jnp.asarray(log_prob, jnp.float32))


def test_on_log_alpha_the_loss_is_log_alpha_times_the_entropy_above_the_target():
    # mean(-log π) = 2, the target is -2: log ½ · 4
    _, state, loss = step(learned("log_alpha"), math.log(0.5), [-1.0, -3.0])
    assert loss == pytest.approx(math.log(0.5) * 4, rel=1e-6)
    assert state[0].mu / 0.1 == pytest.approx(4, rel=1e-5)  # the gradient, as Adam's first moment has it


def test_on_alpha_the_loss_is_alpha_times_the_entropy_above_the_target():
    _, state, loss = step(learned("alpha"), math.log(0.5), [-1.0, -3.0])
    assert loss == pytest.approx(0.5 * 4, rel=1e-6)
    assert state[0].mu / 0.1 == pytest.approx(0.5 * 4, rel=1e-5)  # with respect to log α


@pytest.mark.parametrize("gradient", ["log_alpha", "alpha"])
@pytest.mark.parametrize(("entropy", "direction"), [(-1.0, -1), (-3.0, 1)])
def test_alpha_falls_above_the_target_entropy_and_rises_below_it(gradient, entropy, direction):
    log_alpha, _, _ = step(learned(gradient), 0.0, [-entropy])  # the target is -2
    assert log_alpha == pytest.approx(direction * RATE, rel=1e-4)  # Adam's first step is the learning rate


def test_alpha_stays_where_the_entropy_is_the_given_target():
    log_alpha, _, loss = step(learned(target_entropy=0.5), 0.3, [-0.25, -0.75])
    assert (float(log_alpha), float(loss)) == (np.float32(0.3), 0.0)


@pytest.mark.parametrize("actions", [1, 6, 17])
def test_the_target_entropy_is_minus_the_number_of_actions_unless_it_is_given(actions):
    _, _, loss = step(learned(actions=actions), 1.0, [0.0])
    assert loss == actions


def test_no_gradient_flows_from_the_temperature_loss_into_the_policy():
    temperature = learned()
    slope = jax.grad(lambda log_prob: step(temperature, 1.0, log_prob)[2])(jnp.array([1.0, 2.0]))
    assert slope.tolist() == [0.0, 0.0]


def test_a_fixed_temperature_stays_for_any_entropy():
    fixed = TEMPERATURES["fixed"](AlgorithmSettings(), numbers_of(AlgorithmSettings(), 2))
    log_alpha, _, loss = step(fixed, -1.5, [100.0])
    assert (float(log_alpha), float(loss)) == (-1.5, 0.0)
