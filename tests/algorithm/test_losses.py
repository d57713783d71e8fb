"""Eq. 3 and 5 with numbers that fit on paper."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from saclab.algorithm.losses import actor_loss, critic_loss, critic_target


@pytest.fixture(autouse=True)
def strict_types():
    with jax.numpy_dtype_promotion("strict"):
        yield


def test_the_target_is_reward_plus_discounted_value_and_only_reward_after_a_terminal_state():
    reward, terminated = jnp.array([1.0, 1.0, -2.0]), jnp.array([0.0, 1.0, 0.0])
    target = critic_target(reward, terminated, next_value=jnp.array([10.0, 10.0, 4.0]), discount=0.5)
    assert target.tolist() == [6.0, 1.0, 0.0]


def test_the_critic_loss_is_half_the_mean_square_summed_over_the_critics():
    q, target = jnp.array([[1.0, 2.0], [4.0, 0.0]]), jnp.array([2.0, 4.0])
    # first critic: errors -1, -2 -> (1 + 4) / 2 / 2 = 1.25; second: 2, -4 -> (4 + 16) / 2 / 2 = 5
    assert critic_loss(q, target) == 6.25


def test_each_critic_is_drawn_to_the_target_by_its_own_error_over_the_batch_size():
    q, target = jnp.array([[1.0, 2.0], [4.0, 0.0]]), jnp.array([2.0, 4.0])
    assert jax.grad(critic_loss)(q, target).tolist() == [[-0.5, -1.0], [1.0, -2.0]]


def test_the_actor_loss_is_the_mean_of_weighted_log_density_minus_q():
    # 0.5 * -1 - 3 = -3.5; 0.5 * 2 - (-1) = 2; their mean is -0.75
    assert actor_loss(log_prob=jnp.array([-1.0, 2.0]), q=jnp.array([3.0, -1.0]), alpha=jnp.array(0.5)) == -0.75
