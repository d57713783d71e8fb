"""The value of the next state and the ring of target snapshots, by hand (Eq. 2, 4, 9)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.targets import (
    REDUCTIONS,
    TARGET_REDUCTIONS,
    averaged_entropy,
    averaged_prediction,
    live_slot,
    polyak_update,
)
from saclab.settings import AlgorithmSettings


@pytest.fixture(autouse=True)
def strict_types():
    with jax.numpy_dtype_promotion("strict"):
        yield


def averaged(q, reduction: str = "minimum"):
    """The averaged Q f32[B] of scalar predictions f32[K, C, B], and the spread."""
    predictions = jnp.asarray(q, jnp.float32)[..., None]
    prediction, spread = averaged_prediction(predictions, lambda x: x[..., 0], REDUCTIONS[reduction])
    return prediction[:, 0], spread


# Three snapshots of two critics on two next states. The smaller critic is not the same in every snapshot:
Q = [[[1.0, 8.0], [3.0, 6.0]], [[5.0, 2.0], [2.0, 9.0]], [[9.0, 4.0], [6.0, 7.0]]]
# minimum inside, then mean: (1 + 2 + 6) / 3 = 3 and (6 + 2 + 4) / 3 = 4
# mean first would be:       min(5, 11/3) = 11/3 and min(14/3, 22/3) = 14/3


def test_critics_are_reduced_inside_each_snapshot_first():
    np.testing.assert_allclose(averaged(Q)[0], [3, 4], rtol=1e-6)


def test_the_snapshot_spread_is_that_of_the_reduced_values():
    # of 1, 2, 6: √(14/3); of 6, 2, 4: √(8/3)
    np.testing.assert_allclose(averaged(Q)[1], (np.sqrt(14 / 3) + np.sqrt(8 / 3)) / 2, rtol=1e-6)


def test_the_mean_over_critics_takes_the_place_of_the_minimum():
    # means inside: 2, 3.5, 7.5 -> 13/3 and 7, 5.5, 5.5 -> 6
    np.testing.assert_allclose(averaged(Q, "mean")[0], [13 / 3, 6], rtol=1e-6)


def test_with_one_snapshot_it_is_the_smaller_q():
    q, spread = averaged([[[1.0, 8.0], [3.0, 6.0]]])
    assert q.tolist() == [1.0, 6.0]
    assert spread == 0


def test_the_minimum_is_the_prediction_of_the_critic_with_the_smaller_q():
    predictions = jnp.array([[[0.0, 1.0], [0.5, 0.5]], [[0.75, 0.25], [0.0, 1.0]]])  # [C, B, n], values 0 and 1
    q = predictions @ jnp.array([0.0, 1.0])
    assert REDUCTIONS["minimum"](predictions, q).tolist() == [[0.75, 0.25], [0.5, 0.5]]


def test_the_truncated_target_pools_all_quantiles_without_the_largest():
    settings = AlgorithmSettings(critic_head="quantile", critic_atoms=3, dropped_quantiles=1)
    quantiles = jnp.array([[[1.0, 3.0, 2.0]], [[30.0, 10.0, 20.0]]])
    pooled = TARGET_REDUCTIONS["truncated"](settings)(quantiles, jnp.mean(quantiles, axis=-1))
    assert pooled.tolist() == [[1.0, 2.0, 3.0, 10.0]]  # mean 4


@pytest.mark.parametrize("name", REDUCTIONS)
def test_the_gradient_of_a_reduction_is_each_critics_share(name):
    q = jnp.array([[1.0, 8.0], [3.0, 6.0]])
    slope = jax.grad(lambda x: jnp.sum(REDUCTIONS[name](x[..., None], x)))(q)
    assert slope.tolist() == ([[1, 0], [0, 1]] if name == "minimum" else [[0.5, 0.5], [0.5, 0.5]])


def test_the_entropy_table_is_averaged_row_by_row_from_zeros():
    table, seen = jnp.zeros((4, 2)), []
    for step, term in enumerate(([4.0, 8.0], [8.0, 0.0], [0.0, 4.0], [4.0, 4.0], [12.0, 0.0])):
        mean, table = averaged_entropy(table, jnp.array(term), jnp.int32(step))
        seen.append(mean.tolist())
    # divided by four from the first minibatch on; the fifth takes the place of the first
    assert seen == [[1.0, 2.0], [3.0, 2.0], [3.0, 3.0], [4.0, 4.0], [6.0, 2.0]]
    assert table.tolist() == [[12.0, 0.0], [8.0, 0.0], [0.0, 4.0], [4.0, 4.0]]


def ring_after_each_update(snapshots: int, interval: int, updates: int) -> list[list[float]]:
    """The ring as numbers, for a target that starts at 0 and goes half the way to 16 at each update."""
    ring, rings = jnp.zeros((snapshots, 1, 1)), []
    for step in range(updates):
        ring = polyak_update(ring, jnp.full((1, 1), 16.0), jnp.float32(0.5), jnp.int32(interval), jnp.int32(step))
        rings.append(ring[:, 0, 0].tolist())
    return rings


# The live target after 1, 2, 3, … updates: 8, 12, 14, 15, 15.5, 15.75


def test_the_ring_of_three_holds_the_last_three_targets():
    assert ring_after_each_update(snapshots=3, interval=1, updates=5) == [
        [0.0, 8.0, 0.0],
        [0.0, 8.0, 12.0],
        [14.0, 8.0, 12.0],
        [14.0, 15.0, 12.0],
        [14.0, 15.0, 15.5],
    ]


def test_two_updates_apart_every_second_target_stays_behind():
    assert ring_after_each_update(snapshots=3, interval=2, updates=6) == [
        [8.0, 0.0, 0.0],
        [8.0, 12.0, 0.0],
        [8.0, 14.0, 0.0],
        [8.0, 14.0, 15.0],
        [8.0, 14.0, 15.5],
        [15.75, 14.0, 15.5],
    ]


@pytest.mark.parametrize("interval", [1, 2, 7])
def test_a_ring_of_one_is_the_polyak_target_whatever_the_interval(interval):
    assert ring_after_each_update(snapshots=1, interval=interval, updates=4) == [[8.0], [12.0], [14.0], [15.0]]


@pytest.mark.parametrize(
    ("interval", "slots"), [(1, [0, 1, 2, 0, 1, 2, 0, 1]), (2, [0, 0, 1, 1, 2, 2, 0, 0]), (3, [0, 0, 0, 1, 1, 1, 2, 2])]
)
def test_the_live_slot_goes_round_the_ring_of_three(interval, slots):
    assert [int(live_slot(3, jnp.int32(interval), jnp.int32(step))) for step in range(8)] == slots


def test_the_polyak_rate_is_the_share_of_the_critic():
    critic, now = jnp.array([[8.0], [0.0]]), jnp.int32(0)
    moved = polyak_update(jnp.full((1, 2, 1), 4.0), critic, jnp.float32(0.25), jnp.int32(1), now)
    assert moved.tolist() == [[[5.0], [3.0]]]


def test_without_a_target_network_there_is_nothing_to_move():
    moved = polyak_update(jnp.zeros((0, 2, 1)), jnp.ones((2, 1)), jnp.float32(0.5), jnp.int32(1), jnp.int32(0))
    assert moved.shape == (0, 2, 1)
