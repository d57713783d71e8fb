"""The tanh-Gaussian policy and the networks: by hand, against integration, and the same in NumPy and in JAX."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import trapezoid

from saclab.algorithm.networks.network import ACTIVATIONS
from saclab.algorithm.policy import make_policy, squash
from saclab.settings import AlgorithmSettings

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


@pytest.fixture(autouse=True)
def strict_types():
    with jax.numpy_dtype_promotion("strict"):
        yield


def squashed(mean, log_std, noise):
    action, log_prob = squash(*(np.asarray(value, np.float64) for value in (mean, log_std, noise)))
    return action, log_prob


def test_at_the_middle_the_density_is_the_gaussians():
    action, log_prob = squashed([0.0], [0.0], [0.0])
    assert action == 0
    assert log_prob == pytest.approx(-HALF_LOG_2PI)


def test_off_the_middle_the_density_is_divided_by_the_slope_of_tanh():
    # u = 0.5 + 2 · 0.25 = 1: the slope of tanh is 1 - 0.5800257; the Gaussian's log-density -½·¼² - log 2 - ½ log 2π
    action, log_prob = squashed([0.5], [math.log(2)], [0.25])
    assert action == pytest.approx(0.7615942)
    assert log_prob == pytest.approx(-0.03125 - math.log(2) - HALF_LOG_2PI - math.log(0.4199743), abs=1e-6)


def test_log_densities_of_independent_actions_add_up():
    _, together = squashed([[0.3, -1.0]], [[0.1, -0.5]], [[1.2, -0.7]])
    _, first = squashed([0.3], [0.1], [1.2])
    _, second = squashed([-1.0], [-0.5], [-0.7])
    assert together[0] == pytest.approx(first + second)


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (1.5, -1.0), (-0.7, 0.9)])
def test_the_density_over_actions_integrates_to_one(mean, log_std):
    noise = np.linspace(-9, 9, 200_001)[:, None]
    action, log_prob = squashed(np.full_like(noise, mean), np.full_like(noise, log_std), noise)
    inside = np.diff(action[:, 0], prepend=-2) > 0  # where tanh still tells neighbours apart
    assert trapezoid(np.exp(log_prob[inside]), action[inside, 0]) == pytest.approx(1, abs=1e-5)


def test_the_entropy_of_a_narrow_policy_is_that_of_its_gaussian():
    noise = np.random.default_rng(0).standard_normal((100_000, 1))
    _, log_prob = squashed(np.zeros_like(noise), np.full_like(noise, -5), noise)
    assert -log_prob.mean() == pytest.approx(0.5 + HALF_LOG_2PI - 5, abs=0.01)


@pytest.mark.parametrize("u", [-500.0, -60.0, -20.0, 20.0, 60.0, 500.0])
def test_the_log_density_stays_exact_where_tanh_is_one(u):
    mean, zero = jnp.array([u], jnp.float32), jnp.zeros(1, jnp.float32)
    action, log_prob = squash(mean, zero, zero)
    # log slope = log(4 e^(-2|u|) / (1 + e^(-2|u|))²), which is log 4 - 2|u| this far out
    assert log_prob == pytest.approx(-HALF_LOG_2PI - math.log(4) + 2 * abs(u), rel=1e-6)
    assert abs(float(action[0])) == 1
    assert jax.grad(lambda x: squash(x, zero, zero)[1])(mean) == pytest.approx(2 * np.sign(u), rel=1e-6)


def small_policy(**changes):
    return make_policy(AlgorithmSettings(hidden_layers=(5, 4), **changes), 3, 2)


def test_the_log_std_is_clipped_and_the_mean_is_not():
    policy = small_policy(log_std_minimum=-3.0, log_std_maximum=1.0)
    parameters = np.zeros(policy.network.size, np.float32)
    parameters[-4:] = [7.0, -7.0, 5.0, -5.0]  # the biases of the last layer: two means, two log-stds
    mean, log_std = policy.distribution(parameters, np.zeros((1, 3), np.float32))
    assert mean.tolist() == [[7.0, -7.0]]
    assert log_std.tolist() == [[1.0, -3.0]]


def test_the_mode_is_tanh_of_the_mean_and_the_action_without_noise():
    policy = small_policy()
    parameters = np.asarray(policy.network.init(jax.random.PRNGKey(0)))
    observation = np.random.default_rng(0).standard_normal((7, 3)).astype(np.float32)
    mean, _ = policy.distribution(parameters, observation)
    mode = policy.mode(parameters, observation)
    np.testing.assert_array_equal(mode, np.tanh(mean))
    np.testing.assert_array_equal(policy.act(parameters, observation, np.zeros((7, 2), np.float32)), mode)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_policy_does_the_same_in_numpy_and_in_jax(activation):
    policy = small_policy(activation=activation)
    generator = np.random.default_rng(1)
    parameters = generator.standard_normal(policy.network.size).astype(np.float32)
    observation, noise = (generator.standard_normal((7, n)).astype(np.float32) for n in (3, 2))
    in_numpy = (policy.mode(parameters, observation), policy.act(parameters, observation, noise),
                *policy.sample(parameters, observation, noise))  # fmt: skip
    arrays = jnp.asarray(parameters), jnp.asarray(observation), jnp.asarray(noise)
    in_jax = (policy.mode(*arrays[:2]), policy.act(*arrays), *policy.sample(*arrays))
    for ours, theirs in zip(in_numpy, in_jax, strict=True):
        assert isinstance(ours, np.ndarray)
        assert isinstance(theirs, jax.Array)
        assert ours.dtype == theirs.dtype == np.float32
        np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=1e-5)
    np.testing.assert_array_equal(in_numpy[1], in_numpy[2])  # `act` is `sample` without its log-density


def test_different_seeds_give_different_networks():
    first, second = (small_policy().network.init(jax.random.PRNGKey(seed)) for seed in (0, 1))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(
    "settings", [AlgorithmSettings(), dataclasses.replace(AlgorithmSettings(), hidden_layers=(7,))]
)
def test_a_policy_has_two_outputs_for_each_action(settings):
    policy = make_policy(settings, 5, 3)
    mean, log_std = policy.distribution(np.zeros(policy.network.size, np.float32), np.zeros((4, 5), np.float32))
    assert mean.shape == log_std.shape == (4, 3)
