"""What a Q-network predicts, with numbers that fit on paper."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.heads import HEADS, CriticHead
from saclab.settings import AlgorithmSettings


@pytest.fixture(autouse=True)
def strict_types():
    with jax.numpy_dtype_promotion("strict"):
        yield


def head(name: str, **changes) -> CriticHead:
    return HEADS[name](AlgorithmSettings(critic_head=name, **changes))


def test_the_scalar_target_is_reward_plus_discounted_soft_value():
    """Without any value, or entropy, after a terminal state."""
    reward, discount = jnp.array([1.0, 1.0, -2.0]), jnp.array([0.5, 0.0, 0.5])
    target = head("scalar").backup(jnp.array([[11.0], [11.0], [5.0]]), reward, discount, jnp.array([1.0, 1.0, 1.0]))
    assert target.tolist() == [[6.0], [1.0], [0.0]]


def test_the_scalar_loss_is_half_the_mean_square_summed_over_the_critics():
    q, target = jnp.array([[1.0, 2.0], [4.0, 0.0]])[..., None], jnp.array([[2.0], [4.0]])
    # first critic: errors -1, -2 -> (1 + 4) / 2 / 2 = 1.25; second: 2, -4 -> (4 + 16) / 2 / 2 = 5
    assert head("scalar").loss(q, target) == 6.25
    assert jax.grad(head("scalar").loss)(q, target)[..., 0].tolist() == [[-0.5, -1.0], [1.0, -2.0]]


FIVE = {"critic_atoms": 5, "critic_bound": 2.0}  # the values -2, -1, 0, 1, 2


def test_the_categorical_target_moves_the_values_and_splits_them():
    probability = jnp.array([[0.0, 0.2, 0.5, 0.3, 0.0]] * 2)
    reward, discount, entropy_term = jnp.array([0.5, 1.3]), jnp.array([0.5, 0.0]), jnp.array([0.2, 0.2])
    target = head("categorical", **FIVE).backup(probability, reward, discount, entropy_term)
    # -1, 0, 1 go to -0.1, 0.4, 0.9; after a terminal state all go to 1.3
    np.testing.assert_allclose(target, [[0, 0.02, 0.51, 0.47, 0], [0, 0, 0, 0.7, 0.3]], atol=1e-6)
    np.testing.assert_allclose(head("categorical", **FIVE).mean(target), [0.45, 1.3], atol=1e-6)


def test_the_categorical_target_keeps_its_probability_at_the_bounds():
    probability, zero = jnp.array([[0.0, 0.0, 0.0, 0.0, 1.0]] * 2), jnp.zeros(2)
    target = head("categorical", **FIVE).backup(probability, jnp.array([7.0, -7.0]), jnp.ones(2), zero)
    assert target.tolist() == [[0, 0, 0, 0, 1], [1, 0, 0, 0, 0]]


def test_the_categorical_loss_is_the_cross_entropy_summed_over_the_critics():
    outputs = jnp.log(jnp.array([[[0.5, 0.25, 0.25]], [[0.25, 0.25, 0.5]]]))
    loss = head("categorical", critic_atoms=3).loss(outputs, jnp.array([[0.5, 0.0, 0.5]]))
    assert loss == pytest.approx(2 * (0.5 * np.log(2) + 0.5 * np.log(4)), rel=1e-6)


@pytest.mark.parametrize("name", HEADS)
def test_a_prediction_is_the_same_in_numpy_and_in_jax(name):
    chosen = head(name)
    outputs = np.random.default_rng(0).standard_normal((4, chosen.outputs)).astype(np.float32)
    q = chosen.mean(chosen.prediction(outputs))
    assert isinstance(q, np.ndarray)
    np.testing.assert_allclose(q, chosen.mean(chosen.prediction(jnp.asarray(outputs))), rtol=1e-5, atol=1e-6)


def test_the_categorical_prediction_sums_to_one_for_any_outputs():
    outputs = np.array([[1000.0, 0.0, -1000.0], [0.0, 0.0, 0.0]], np.float32)
    prediction = head("categorical", critic_atoms=3).prediction(outputs)
    np.testing.assert_allclose(prediction, [[1, 0, 0], [1 / 3] * 3], atol=1e-6)


def test_the_quantile_loss_weighs_each_error_by_the_level_of_its_quantile():
    """The quantiles 0 and 2, at the levels ¼ and ¾, towards 1 and 4."""
    outputs, target = jnp.array([[[0.0, 2.0]]]), jnp.array([[1.0, 4.0]])
    # errors of 0: 1 and 4 -> ¼ · ½ and ¼ · 3.5; of 2: −1 and 2 -> ¼ · ½ and ¾ · 1.5
    assert head("quantile", critic_atoms=2).loss(outputs, target) == 0.5625
    # slopes: −¼ · (1 + 1) and ¼ · 1 − ¾ · 1, each over four pairs
    slope = jax.grad(head("quantile", critic_atoms=2).loss)(outputs, target)
    assert slope.tolist() == [[[-0.125, -0.125]]]
    assert head("quantile", critic_atoms=2).loss(jnp.repeat(outputs, 3, axis=0), target) == 3 * 0.5625


def test_the_quantile_target_moves_every_quantile():
    quantiles, reward, discount = jnp.array([[1.0, 3.0]] * 2), jnp.array([1.0, 1.0]), jnp.array([0.5, 0.0])
    target = head("quantile", critic_atoms=2).backup(quantiles, reward, discount, jnp.array([1.0, 1.0]))
    assert target.tolist() == [[1.0, 2.0], [1.0, 1.0]]
    assert head("quantile", critic_atoms=2).mean(target).tolist() == [1.5, 1.0]
