"""Networks whose features or weights keep their lengths: numbers worked out by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.batch_norm_residual import unit_mean_square
from saclab.algorithm.networks.hyperspherical import interpolated, on_sphere, shifted
from saclab.algorithm.networks.network import Design
from saclab.algorithm.policy import BOUNDINGS, Policy
from saclab.variants import variant_settings


def test_scale_and_bias_of_a_normalisation_get_a_mean_square_of_one():
    np.testing.assert_allclose(unit_mean_square(jnp.ones((2, 2))), np.full((2, 2), 0.70711), atol=1e-5)


def test_points_on_the_sphere():
    np.testing.assert_allclose(on_sphere(shifted(np.array([1.0, 2.0]))), [0.26726, 0.53452, 0.80178], atol=1e-5)
    between = interpolated(np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array(1 / 3))
    np.testing.assert_allclose(between, [0.89443, 0.44721], atol=1e-5)


def test_a_log_deviation_bounded_by_tanh():
    network = NETWORKS["mlp"](1, (2,), 2, Design())
    policy = Policy(network, -10.0, 2.0, BOUNDINGS["tanh"])
    assert policy.distribution(np.zeros(network.size), np.ones((1, 1)))[1] == pytest.approx(-4)


def test_flashsacs_target_entropy():
    per_action = variant_settings("flashsac", "Humanoid-v4").target_entropy_per_action
    assert (6 * per_action, 17 * per_action) == pytest.approx((-2.869, -8.129), abs=1e-3)


@pytest.mark.parametrize("name", ["batch_norm_residual", "hyperspherical"])
def test_numpy_and_jax_agree_and_a_projection_is_idempotent(name):
    network = NETWORKS[name](3, (4, 4), 2, Design(projection="unit_columns", heads=2))
    vector, x = network.init(jax.random.PRNGKey(0)), np.ones((5, 3), np.float32)
    assert vector.shape == (network.size,)
    np.testing.assert_allclose(network.project(vector), vector, atol=1e-6)
    np.testing.assert_allclose(network.apply(np.asarray(vector), x), network.apply(vector, jnp.asarray(x)), atol=1e-5)
    assert np.asarray(network.apply(np.asarray(vector), x)).dtype == np.float32
    outputs, statistics = jax.jit(network.train)(vector, jnp.asarray(x), key=jax.random.PRNGKey(1))
    assert outputs.shape == (5, 2)
    assert statistics.shape == (network.statistics,)
