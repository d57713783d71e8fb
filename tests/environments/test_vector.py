"""Training environments hand out each transition as it was: truncation, autoreset and scaling are solved there."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from saclab.environments.make import EnvironmentSpec
from saclab.environments.vector import TrainingEnvironments
from saclab.errors import NonFiniteError

from .tiny import TIME_LIMIT


def counting(count: int = 1, name: str = "Counting-v0", **arguments) -> TrainingEnvironments:
    return TrainingEnvironments(name, arguments, seeds=list(range(count)))


def walk(environments: TrainingEnvironments, steps: int):
    """Every transition's arrays, stacked over the steps, and the episodes that ended at each."""
    action = np.zeros((len(environments), environments.spec.action_size), np.float32)
    results = [environments.step(action) for _ in range(steps)]
    transitions, ended = zip(*results, strict=True)
    return type(transitions[0])(*(np.stack(column) for column in zip(*transitions, strict=True))), ended


@pytest.mark.parametrize(("terminate_at", "length"), [(None, TIME_LIMIT), (3, 3)])
def test_the_last_transition_of_an_episode_has_its_true_final_observation(terminate_at, length):
    transitions, _ = walk(counting(terminate_at=terminate_at), 2 * length + 1)
    episode, step = transitions.next_observation[:, 0, 0], transitions.next_observation[:, 0, 1]
    assert episode.tolist() == [1] * length + [2] * length + [3]
    assert step.tolist() == [*range(1, length + 1)] * 2 + [1]


@pytest.mark.parametrize(("terminate_at", "length"), [(None, TIME_LIMIT), (3, 3)])
def test_the_next_episode_starts_at_once_and_no_step_between_is_stored(terminate_at, length):
    transitions, _ = walk(counting(terminate_at=terminate_at), 2 * length + 1)
    before, after = transitions.observation[:, 0], transitions.next_observation[:, 0]
    assert before[:, 1].tolist() == [*range(length)] * 2 + [0]
    assert (before[:, 0] == after[:, 0]).all()  # no transition leads from one episode into the next
    assert (after[:, 1] - before[:, 1] == 1).all()
    inside = before[:, 1] > 0
    np.testing.assert_array_equal(before[inside], after[:-1][inside[1:]])  # the random number too: nothing is re-drawn


def test_a_time_limit_is_not_a_terminal_state_and_a_terminal_state_is():
    truncated, ended = walk(counting(), TIME_LIMIT)
    assert not truncated.terminated.any()
    assert [episode.terminated for at_step in ended for episode in at_step] == [False]
    terminated, ended = walk(counting(terminate_at=3), 4)
    assert terminated.terminated[:, 0].tolist() == [False, False, True, False]
    assert [episode.terminated for at_step in ended for episode in at_step] == [True]


def test_a_terminal_state_at_the_time_limit_is_terminal():
    transitions, ended = walk(counting(terminate_at=TIME_LIMIT), TIME_LIMIT)
    assert transitions.terminated[-1, 0]
    assert ended[-1][0].terminated


def test_an_ended_episode_has_its_return_and_length():
    """The next one starts from zero."""
    environments = counting(terminate_at=3)
    _, ended = walk(environments, 7)
    assert [[(e.environment, e.total_reward, e.length) for e in at_step] for at_step in ended] == [
        [], [], [(0, 6.0, 3)], [], [], [(0, 6.0, 3)], [],
    ]  # fmt: skip
    assert (environments.total_rewards.tolist(), environments.lengths.tolist()) == ([1.0], [1])


def test_environments_end_their_episodes_independently():
    environments = counting(2)
    environments.environments[1].environment.unwrapped.terminate_at = 2
    transitions, ended = walk(environments, 5)
    assert [[e.environment for e in at_step] for at_step in ended] == [[], [1], [], [1], [0]]
    assert transitions.observation[:, 0, 1].tolist() == [0, 1, 2, 3, 4]
    assert transitions.observation[:, 1, 1].tolist() == [0, 1, 0, 1, 0]
    assert transitions.terminated.tolist() == [[False, i % 2 == 1] for i in range(5)]


def test_environments_draw_from_their_own_seeds():
    environments = TrainingEnvironments("Counting-v0", {}, seeds=[7, 8, 7])
    noise = environments.observation[:, 2]
    assert noise[0] == noise[2] != noise[1]


def test_what_was_handed_out_does_not_change_with_later_steps():
    environments = counting()
    first, _ = environments.step(np.zeros((1, 1), np.float32))
    kept = [np.copy(column) for column in first]
    walk(environments, 7)
    for column, copy in zip(first, kept, strict=True):
        np.testing.assert_array_equal(column, copy)


def test_transitions_hold_the_action_in_the_unit_range_and_32_bits():
    environments = counting(low=(-4.0,), high=(2.0,))
    action = np.array([[0.25]], np.float32)
    transitions, _ = environments.step(action)
    assert transitions.action.tolist() == [[0.25]]
    dtypes = {name: column.dtype.name for name, column in transitions._asdict().items()}
    assert dtypes.pop("terminated") == "bool"
    assert set(dtypes.values()) == {"float32"}


def test_actions_are_scaled_to_bounds_that_are_not_symmetrical():
    environments = counting(low=(-1.0, 0.0, 5.0), high=(3.0, 10.0, 6.0))
    for action in ([-1, -1, -1], [1, 1, 1], [0, 0, 0], [0.5, -0.5, 0.5]):
        environments.step(np.array([action], np.float32))
    received = np.array(environments.environments[0].environment.unwrapped.actions)
    assert received.dtype == np.float32
    assert received.tolist() == [[-1, 0, 5], [3, 10, 6], [1, 5, 5.5], [2, 2.5, 5.75]]


def test_scaled_actions_never_leave_the_bounds_by_rounding():
    generator = np.random.default_rng(0)
    low = generator.uniform(-3, 0, 50).astype(np.float32)
    high = (low + generator.uniform(0.1, 3, 50)).astype(np.float32)
    scaled = EnvironmentSpec(1, 50, low, high).scale_action(np.array([[-1.0], [1.0]], np.float32).repeat(50, axis=1))
    assert (scaled >= low).all()
    assert (scaled <= high).all()
    np.testing.assert_allclose(scaled, [low, high], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "i4"])
def test_whole_numbers_reach_all_of_their_type(kind):
    """The difference of two of them need not be one."""
    limits = np.iinfo(kind)
    spec = EnvironmentSpec(1, 1, np.array([limits.min], kind), np.array([limits.max], kind))
    scaled = spec.scale_action(np.array([[-1.0], [0.0], [1.0]], np.float32))
    assert scaled.dtype == np.dtype(kind)
    assert scaled[[0, 2], 0].tolist() == [limits.min, limits.max]
    assert abs(int(scaled[1, 0]) - (limits.min + limits.max) / 2) <= 0.5


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("broken", "message"), [("observation", r"observation entries \[1\]"), ("reward", "reward")])
def test_a_value_that_is_not_finite_is_refused_with_its_place(broken, message, value):
    environments = counting(2)
    environments.environments[1].environment.unwrapped.__dict__.update(broken_at=2, broken=broken, value=value)
    walk(environments, 1)
    with pytest.raises(NonFiniteError, match=rf"Counting-v0 number 1 .*{message}.* in step 2 "):
        walk(environments, 1)


@pytest.mark.parametrize("broken", ["observation", "reward"])
def test_a_value_beyond_32_bits_is_refused(broken):
    """Otherwise it would reach the replay buffer as infinity."""
    environments = counting(broken_at=1, broken=broken, value=1e300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NumPy's, about the overflow
        with pytest.raises(NonFiniteError):
            walk(environments, 1)


def test_a_captured_episode_goes_on_in_another_instance_with_its_sums():
    first, second = counting(2, "CapturableCounting-v0"), counting(2, "CapturableCounting-v0")
    walk(first, 3)
    assert second.restore(first.capture(), [7, 8]) == []
    assert (second.total_rewards.tolist(), second.lengths.tolist()) == ([6.0, 6.0], [3, 3])
    (ours, our_ends), (theirs, their_ends) = walk(first, 9), walk(second, 9)
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(mine, other)
    assert our_ends == their_ends
    assert our_ends[1][0].length == TIME_LIMIT  # the time limit's own count was restored


def test_an_environment_that_cannot_be_captured_is_named_and_starts_anew():
    first, second = counting(2), counting(2)
    walk(first, 3)
    assert first.capture() == [None, None]
    assert second.restore(first.capture(), [7, 8]) == [0, 1]
    assert second.lengths.tolist() == [0, 0]
