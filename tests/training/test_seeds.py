"""Every stream of random numbers of a run is its own, and the same for the same seed in every version."""

from __future__ import annotations

import numpy as np

from saclab.training import seeds


def test_streams_of_all_names_seeds_and_indices_differ():
    draws = {
        tuple(seeds.stream(seed, name, index).generate_state(4).tolist())
        for seed in (0, 1, 2, 2**40)
        for name in seeds.STREAMS
        for index in (0, 1, 2)
    }
    assert len(draws) == 4 * len(seeds.STREAMS) * 3


def test_the_same_stream_draws_the_same_numbers():
    first, second = (seeds.generator(5, "replay").standard_normal(4).tolist() for _ in range(2))
    assert first == second


def test_more_environments_leave_the_first_ones_seeds_as_they_are():
    assert seeds.integers(3, "environments", 5)[:2] == seeds.integers(3, "environments", 2)
    assert len(set(seeds.integers(3, "environments", 5))) == 5


def test_the_learners_key_is_a_raw_jax_key():
    key = seeds.learner_key(0)
    assert (key.shape, key.dtype) == ((2,), np.uint32)


def test_the_streams_of_seed_7_are_what_they_have_always_been():
    """Changing a line here makes every run that was published unrepeatable."""
    assert {name: seeds.integers(7, name, 2) for name in seeds.STREAMS} == {
        "learner": [393969088, 3127402199],
        "environments": [75971499, 5529967],
        "exploration": [1685402102, 1386913335],
        "replay": [2234724314, 3259368143],
        "evaluation": [3018317685, 2422078069],
        "q_bias": [2673742827, 1134846047],
    }
