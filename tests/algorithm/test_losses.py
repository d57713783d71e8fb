"""Eq. 5 with numbers that fit on paper."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from saclab.algorithm.losses import actor_loss


@pytest.fixture(autouse=True)
def strict_types():
    with jax.numpy_dtype_promotion("strict"):
        yield


def test_the_actor_loss_is_the_mean_of_weighted_log_density_minus_q():
    # 0.5 * -1 - 3 = -3.5; 0.5 * 2 - (-1) = 2; their mean is -0.75
    assert actor_loss(log_prob=jnp.array([-1.0, 2.0]), q=jnp.array([3.0, -1.0]), alpha=jnp.array(0.5)) == -0.75
