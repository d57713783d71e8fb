"""The replay buffer against a plain list of the last transitions."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import chisquare

from saclab.environments.vector import Transitions
from saclab.machine import available_memory
from saclab.replay import ReplayBuffer, RowLayout, Windows

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


def stepped(episodes: list[list[tuple[float, bool]]], capacity: int) -> ReplayBuffer:
    """A buffer of several environments stepped in turn, each with rewards and whether a step was terminal.

    The states of environment e are e + 0.01, e + 0.02, …; a reward of None is a time limit: the next state is new.
    """
    layout = RowLayout(1, 1)
    buffer, states = ReplayBuffer(capacity, layout), [float(number) for number in range(len(episodes))]
    for steps in zip(*episodes, strict=True):
        rows = []
        for number, (reward, how) in enumerate(steps):
            before, after = states[number], states[number] + 0.01
            states[number] = after if how == "on" else states[number] + 0.1
            rows.append((before, 0.0, reward, after, how == "terminal"))
        columns = [np.array(column, np.float32) for column in zip(*rows, strict=True)]
        buffer.add(Transitions(*(column[:, None] for column in columns[:4]), columns[4] > 0))
    return buffer


def batch_of(buffer: ReplayBuffer, windows: Windows, drawn: list[int], discount: float):
    gathered, steps = windows.gather(buffer.rows, np.array(drawn), np.int64(buffer.added % buffer.capacity))
    return buffer.layout.unpack_windows(gathered, jax.numpy.asarray(steps), np.float32(discount))


def test_windows_by_hand():
    """Of three steps: whole ones, one cut by a terminal state, by a time limit, by the end of what is stored."""
    one = [(1.0, "on"), (2.0, "on"), (4.0, "on"), (8.0, "terminal"), (16.0, "on"), (32.0, "limit"), (64.0, "on")]
    other = [(100.0, "on"), (200.0, "limit"), (400.0, "on"), (800.0, "on"), (1600.0, "on"), (0.0, "on"), (0.0, "on")]
    buffer, windows = stepped([one, other], capacity=20), Windows(RowLayout(1, 1), 3, 2)
    # the first environment's steps lie in rows 0, 2, 4, …, the other's in 1, 3, 5, …
    batch = batch_of(buffer, windows, [0, 2, 4, 6, 8, 10, 12, 1, 3, 5, 11], 0.5)
    assert batch.steps.tolist() == [3, 3, 2, 1, 2, 1, 1, 2, 1, 3, 2]
    assert batch.reward_terms[:, 0].tolist() == [
        1 + 1 + 1, 2 + 2 + 2, 4 + 4, 8, 16 + 16, 32, 64, 100 + 100, 200, 400 + 400 + 400, 0,
    ]  # fmt: skip
    assert batch.terminated.tolist() == [0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0]
    first = batch.observation[:, 0]
    np.testing.assert_allclose(batch.next_observation[:3, 0] - first[:3], [0.03, 0.03, 0.02], atol=1e-5)


def test_windows_do_not_reach_over_the_newest_row_of_a_full_ring():
    """Seven places for two environments: what follows the newest row is the oldest one."""
    buffer = stepped([[(float(number), "on") for number in range(6)]] * 2, capacity=7)
    batch = batch_of(buffer, Windows(RowLayout(1, 1), 3, 2), list(range(7)), 1.0)
    # rows hold the transitions 7, 8, 9, 10, 11, 5, 6: of the steps 3, 4, 4, 5, 5, 2, 3
    assert batch.steps.tolist() == [3, 2, 2, 1, 1, 3, 3]
    assert batch.reward_terms[:, 0].tolist() == [12, 9, 9, 5, 5, 9, 12]


@pytest.mark.parametrize("to_array", [np.asarray, jax.numpy.asarray], ids=["numpy", "jax"])
def test_windows_of_random_episodes_equal_a_plain_walk(to_array):
    generator, discount, longest = np.random.default_rng(3), 0.9, 4
    hows = generator.choice(["on", "on", "on", "terminal", "limit"], (3, 40))
    rewards = generator.standard_normal((3, 40)).astype(np.float32)
    buffer = stepped([list(zip(own, how, strict=True)) for own, how in zip(rewards, hows, strict=True)], capacity=50)
    drawn = generator.integers(0, buffer.size, 200)
    windows, end = Windows(RowLayout(1, 1), longest, 3), buffer.added % buffer.capacity
    gathered, steps = windows.gather(to_array(buffer.rows), to_array(drawn), to_array(end))
    batch = buffer.layout.unpack_windows(jax.numpy.asarray(gathered), jax.numpy.asarray(steps), np.float32(discount))
    oldest = buffer.added - buffer.capacity
    for row, place in enumerate(drawn):
        number = oldest + (place - oldest) % buffer.capacity  # of the transition that lies there
        total, length = 0.0, 0
        step, environment = divmod(int(number), 3)
        while True:
            total += discount**length * rewards[environment, step + length]
            length += 1
            last = step + length - 1
            if hows[environment, last] != "on" or length == longest or last + 1 == 40:
                break
        assert int(batch.steps[row]) == length
        assert float(batch.reward_terms[row, 0]) == pytest.approx(total, abs=1e-5)
        assert bool(batch.terminated[row]) == (hows[environment, last] == "terminal")
