"""The value of the next state and the ring of target snapshots, by hand (Eq. 2, 4, 9)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.numbers import numbers_of
from saclab.algorithm.targets import follow, init_target, live_slot, next_value
from saclab.algorithm.types import TargetState
from saclab.config import AlgorithmSettings


@pytest.fixture(autouse=True)
def strict_types():
    with jax.numpy_dtype_promotion("strict"):
        yield


def settings(**changes) -> AlgorithmSettings:
    return AlgorithmSettings(**{"batch_size": 2, "polyak_rate": 0.5, **changes})


def value_of(chosen, q, entropy_term, entropy_terms=None, step=0):
    if entropy_terms is None:
        entropy_terms = jnp.zeros((chosen.entropy_window, chosen.batch_size))
    q = jnp.asarray(q, jnp.float32)
    target = TargetState(jnp.zeros((*q.shape[:2], 1)), entropy_terms)
    return next_value(chosen, target, q, jnp.asarray(entropy_term, jnp.float32), jnp.int32(step))


# Three snapshots of two critics on two next states. The smaller critic is not the same in every snapshot:
Q = [[[1.0, 8.0], [3.0, 6.0]], [[5.0, 2.0], [2.0, 9.0]], [[9.0, 4.0], [6.0, 7.0]]]
# minimum inside, then mean: (1 + 2 + 6) / 3 = 3 and (6 + 2 + 4) / 3 = 4
# mean first would be:       min(5, 11/3) = 11/3 and min(14/3, 22/3) = 14/3


def test_critics_are_reduced_inside_each_snapshot_and_then_snapshots_are_averaged():
    result = value_of(settings(snapshots=3), Q, [0.5, -1.0])
    np.testing.assert_allclose(result.value, [3 - 0.5, 4 + 1.0], rtol=1e-6)


def test_the_snapshot_spread_is_the_standard_deviation_of_the_reduced_values():
    result = value_of(settings(snapshots=3), Q, [0.5, -1.0])
    # of 1, 2, 6: √(14/3); of 6, 2, 4: √(8/3)
    np.testing.assert_allclose(result.snapshot_spread, (np.sqrt(14 / 3) + np.sqrt(8 / 3)) / 2, rtol=1e-6)


def test_the_mean_over_critics_takes_the_place_of_the_minimum():
    result = value_of(settings(snapshots=3, target_reduction="mean"), Q, [0.0, 0.0])
    # means inside: 2, 3.5, 7.5 -> 13/3 and 7, 5.5, 5.5 -> 6
    np.testing.assert_allclose(result.value, [13 / 3, 6], rtol=1e-6)


def test_with_one_snapshot_the_value_is_the_smaller_q_minus_the_weighted_log_density():
    result = value_of(settings(), [[[1.0, 8.0], [3.0, 6.0]]], [0.25, 2.0])
    assert result.value.tolist() == [0.75, 4.0]
    assert result.snapshot_spread == 0


def test_the_entropy_table_starts_at_zeros_and_is_averaged_row_by_row_over_the_whole_window():
    chosen = settings(entropy_window=4)
    table = init_target(chosen, jnp.ones((2, 3))).entropy_terms
    assert table.tolist() == [[0.0, 0.0]] * 4
    q, seen = [[[0.0, 0.0], [0.0, 0.0]]], []
    for step, term in enumerate(([4.0, 8.0], [8.0, 0.0], [0.0, 4.0], [4.0, 4.0], [12.0, 0.0])):
        result = value_of(chosen, q, term, table, step)
        table = result.entropy_terms
        seen.append((-result.value).tolist())
    # divided by four from the first minibatch on; the fifth takes the place of the first
    assert seen == [[1.0, 2.0], [3.0, 2.0], [3.0, 3.0], [4.0, 4.0], [6.0, 2.0]]
    assert table.tolist() == [[12.0, 0.0], [8.0, 0.0], [0.0, 4.0], [4.0, 4.0]]


def test_every_snapshot_starts_as_the_critic():
    critic = jnp.array([[1.0, 2.0], [3.0, 4.0]])
    assert init_target(settings(snapshots=3), critic).snapshots.tolist() == [critic.tolist()] * 3


def ring_after_each_update(snapshots: int, interval: int, updates: int) -> list[list[float]]:
    """The ring as numbers, for a target that starts at 0 and goes half the way to 16 at each update."""
    chosen = settings(snapshots=snapshots, snapshot_interval=interval)
    ring, rings = jnp.zeros((snapshots, 1, 1)), []
    for step in range(updates):
        ring = follow(numbers_of(chosen, 1), ring, jnp.full((1, 1), 16.0), jnp.int32(step))
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


def test_two_updates_apart_the_live_target_moves_on_every_second_update_and_leaves_the_one_before_behind():
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
    chosen = settings(snapshots=3, snapshot_interval=interval)
    assert [int(live_slot(numbers_of(chosen, 1), chosen.snapshots, jnp.int32(step))) for step in range(8)] == slots


def test_the_polyak_rate_is_the_share_of_the_critic():
    chosen = dataclasses.replace(settings(), polyak_rate=0.25)
    moved = follow(numbers_of(chosen, 1), jnp.full((1, 2, 1), 4.0), jnp.array([[8.0], [0.0]]), jnp.int32(0))
    assert moved.tolist() == [[[5.0], [3.0]]]
