"""The replay buffer against a plain list of the last transitions."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import chisquare

from saclab.environments.vector import Transitions
from saclab.machine import available_memory
from saclab.replay import ReplayBuffer, RowLayout

LAYOUT = RowLayout(observation_size=3, action_size=2)


def transitions(generator: np.random.Generator, count: int) -> Transitions:
    return Transitions(
        observation=generator.standard_normal((count, 3)).astype(np.float32),
        action=generator.uniform(-1, 1, (count, 2)).astype(np.float32),
        reward_terms=generator.standard_normal((count, 1)).astype(np.float32),
        next_observation=generator.standard_normal((count, 3)).astype(np.float32),
        terminated=generator.uniform(size=count) < 0.5,
    )


def test_a_row_has_room_for_every_number_of_a_transition():
    assert LAYOUT.width == 3 + 2 + 1 + 3 + 1


@pytest.mark.parametrize("to_array", [np.asarray, jax.numpy.asarray], ids=["numpy", "jax"])
def test_unpacking_gives_back_what_was_packed_in_32_bits(to_array):
    given = transitions(np.random.default_rng(0), 7)
    rows = LAYOUT.pack(given)
    assert (rows.shape, rows.dtype) == ((7, LAYOUT.width), np.float32)
    batch = LAYOUT.unpack(to_array(rows))
    for name, column in given._asdict().items():
        unpacked = getattr(batch, name)
        assert unpacked.dtype == np.float32
        assert unpacked.shape == column.shape
        np.testing.assert_array_equal(unpacked, column.astype(np.float32), err_msg=name)


def test_a_drawn_batch_is_in_32_bits():
    buffer = ReplayBuffer(10, LAYOUT)
    buffer.add(transitions(np.random.default_rng(0), 4))
    rows = buffer.sample(np.random.default_rng(0), 6)
    assert (rows.shape, rows.dtype) == ((6, LAYOUT.width), np.float32)


@pytest.mark.parametrize("at_once", [1, 3, 7])
def test_the_buffer_holds_exactly_the_last_transitions(at_once):
    generator, buffer, model = np.random.default_rng(0), ReplayBuffer(7, LAYOUT), []
    for _ in range(40 // at_once):
        some = transitions(generator, at_once)
        buffer.add(some)
        model = (model + LAYOUT.pack(some).tolist())[-7:]
        assert buffer.size == len(model)
        assert sorted(buffer.rows[: buffer.size].tolist()) == sorted(model)
    assert buffer.added == 40 // at_once * at_once


def test_transition_number_n_lies_in_row_n_modulo_the_capacity():
    buffer, everything = ReplayBuffer(5, LAYOUT), transitions(np.random.default_rng(0), 12)
    for start in range(0, 12, 2):
        buffer.add(Transitions(*(column[start : start + 2] for column in everything)))
    np.testing.assert_array_equal(buffer.rows, LAYOUT.pack(everything)[[10, 11, 7, 8, 9]])


def numbered(capacity: int, added: int) -> ReplayBuffer:
    """A buffer whose rewards are the transitions' numbers."""
    layout = RowLayout(1, 1)
    buffer = ReplayBuffer(capacity, layout)
    column = np.zeros((1, 1), np.float32)
    for number in range(added):
        buffer.add(Transitions(column, column, np.array([[number]], np.float32), column, np.array([False])))
    return buffer


@pytest.mark.parametrize(("added", "held"), [(12, range(12)), (20, range(20)), (33, range(13, 33))])
def test_every_transition_held_is_drawn_equally_often_and_no_other(added, held):
    buffer = numbered(20, added)
    drawn = buffer.layout.unpack(buffer.sample(np.random.default_rng(1), 40_000)).reward_terms[:, 0]
    numbers, counts = np.unique(drawn, return_counts=True)
    assert numbers.tolist() == list(held)
    assert chisquare(counts).pvalue > 0.01


def test_the_rows_of_a_batch_are_drawn_independently_of_each_other():
    """As often all different as chance has it: 4! / 4⁴ of the batches of four out of four."""
    buffer, generator = numbered(4, 4), np.random.default_rng(2)
    batches = [buffer.layout.unpack(buffer.sample(generator, 4)).reward_terms[:, 0] for _ in range(2000)]
    different = sum(len(np.unique(batch)) == 4 for batch in batches)
    assert chisquare([different, 2000 - different], [2000 * 24 / 256, 2000 * 232 / 256]).pvalue > 0.01


def test_the_same_generator_draws_the_same_batch():
    buffer = numbered(20, 33)
    first, second = (buffer.sample(np.random.default_rng(3), 8) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_drawn_batch_does_not_change_when_its_rows_are_overwritten():
    buffer = numbered(4, 4)
    rows = buffer.sample(np.random.default_rng(0), 8)
    kept = rows.copy()
    buffer.rows[:] = -1
    np.testing.assert_array_equal(rows, kept)


def test_this_machine_has_some_memory_left():
    available = available_memory()
    assert available is not None
    assert 2**20 < available < 2**50
