"""The noise of the policy's actions: fresh, or held for a number of steps; and exact when it goes on."""

from __future__ import annotations

import numpy as np
import pytest

from saclab.training import seeds
from saclab.training.checkpoint import CheckpointError
from saclab.training.exploration import Exploration


def test_without_holding_the_noise_is_the_generators():
    exploration, generator = Exploration(3, 2, 4, 1), seeds.generator(3, "exploration")
    np.testing.assert_array_equal(exploration.uniform_action(), generator.uniform(-1, 1, (2, 4)).astype(np.float32))
    np.testing.assert_array_equal(exploration.noise(), generator.standard_normal((2, 4), np.float32))


def lengths_of_runs(values: np.ndarray) -> np.ndarray:
    """How many times in a row each value stands."""
    ends = np.flatnonzero(np.append(values[1:] != values[:-1], True))
    return np.diff(np.append(-1, ends))


def test_a_draw_is_held_n_steps_with_a_probability_like_one_over_n_squared():
    exploration = Exploration(0, 3, 1, 16)
    noise = np.stack([exploration.noise()[:, 0] for _ in range(20_000)])
    lengths = np.concatenate([lengths_of_runs(noise[:, environment]) for environment in range(3)])
    assert lengths.max() <= 16
    assert np.mean(lengths == 1) == pytest.approx(0.631, abs=0.01)
    assert lengths.mean() == pytest.approx(2.134, abs=0.05)
    assert noise.std() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("longest", [1, 16])
def test_it_goes_on_as_if_it_had_never_stopped(longest):
    first = Exploration(5, 2, 3, longest)
    for _ in range(10):
        first.noise()
    state, arrays = first.capture()
    arrays = {name: array.copy() for name, array in arrays.items()}
    expected = [first.noise() for _ in range(20)]
    second = Exploration(5, 2, 3, longest)
    second.restore(state, arrays)
    np.testing.assert_array_equal([second.noise() for _ in range(20)], expected)


def test_a_checkpoint_without_the_held_noise_is_refused():
    exploration = Exploration(5, 2, 3, 16)
    with pytest.raises(CheckpointError, match="held noise"):
        exploration.restore(exploration.capture()[0], {})
