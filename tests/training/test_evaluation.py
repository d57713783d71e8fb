"""Evaluation episodes stepped side by side are the episodes that each would be alone."""

from __future__ import annotations

from itertools import count

import gymnasium
import numpy as np
import pytest
from environments import tiny

from saclab.environments.make import environment_spec, make_environment
from saclab.errors import NonFiniteError
from saclab.training import evaluation
from saclab.training.evaluation import Evaluator
from saclab.training.requests import Stopped

SEEDS = [11, 12, 13, 14]


def linear_policy(name: str):
    """A deterministic policy whose every row is computed alone, so that its bits do not depend on the batch."""
    spec = environment_spec(name, make_environment(name))
    weights = np.random.default_rng(0).standard_normal((spec.observation_size, spec.action_size)).astype(np.float32)
    return lambda observation: np.tanh((observation[:, :, None] * weights).sum(axis=1))


def one_episode(name: str, act, seed: int) -> tuple[float, int]:
    """Straight-line evaluation."""
    environment = make_environment(name)
    spec = environment_spec(name, environment)
    observation, _ = environment.reset(seed=seed)
    total, length, done = 0.0, 0, False
    while not done:
        action = spec.scale_action(act(observation[None].astype(np.float32)))[0]
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, length, done = total + float(reward), length + 1, terminated or truncated
    return total, length


@pytest.mark.parametrize("name", ["Hopper-v4", "Pendulum-v1"])
def test_episodes_side_by_side_equal_episodes_one_by_one(name):
    act = linear_policy(name)
    episodes = Evaluator(name, {}).run(act, SEEDS)
    expected = [one_episode(name, act, seed) for seed in SEEDS]
    assert list(zip(episodes.total_rewards.tolist(), episodes.lengths.tolist(), strict=True)) == expected
    assert len(set(episodes.total_rewards.tolist())) == len(SEEDS)


def test_an_evaluator_gives_the_same_again_whatever_it_ran_before():
    act, evaluator = linear_policy("Hopper-v4"), Evaluator("Hopper-v4", {})
    first = evaluator.run(act, SEEDS)
    evaluator.run(act, [99, 98])
    again = evaluator.run(act, SEEDS)
    backwards = evaluator.run(act, SEEDS[::-1])
    assert first.total_rewards.tolist() == again.total_rewards.tolist() == backwards.total_rewards.tolist()[::-1]


def test_the_policy_is_asked_once_per_step_for_episodes_that_go_on():
    act, asked = linear_policy("Hopper-v4"), []

    def counting(observation):
        asked.append(len(observation))
        return act(observation)

    lengths = Evaluator("Hopper-v4", {}).run(counting, SEEDS).lengths
    assert len(set(lengths.tolist())) > 1
    assert asked == [int((lengths > step).sum()) for step in range(lengths.max())]


def test_a_return_is_the_sum_of_all_rewards_up_to_the_time_limit():
    episodes = Evaluator("Counting-v0", {}).run(lambda observation: np.zeros((len(observation), 1), np.float32), [1, 2])
    assert episodes.lengths.tolist() == [tiny.TIME_LIMIT] * 2
    assert episodes.total_rewards.tolist() == [1.0 + 2 + 3 + 4 + 5] * 2


def test_evaluated_actions_are_scaled_to_the_bounds():
    evaluator = Evaluator("Counting-v0", {"low": (2.0,), "high": (6.0,)})
    evaluator.run(lambda observation: np.full((len(observation), 1), 0.5, np.float32), [1])
    assert [action.tolist() for action in evaluator.environments[0].environment.unwrapped.actions] == [
        [5.0]
    ] * tiny.TIME_LIMIT


def test_a_first_observation_that_is_not_finite_is_refused():
    """The next one is: no step would show it."""

    class First(tiny.Constant):
        def reset(self, **options):
            seen, info = super().reset(**options)
            return seen * np.nan, info

    gymnasium.register("First-v0", First, max_episode_steps=5)
    with pytest.raises(NonFiniteError, match=r"evaluation episodes \[0\]"):
        Evaluator("First-v0", {}).run(lambda observation: np.zeros((len(observation), 1), np.float32), [1])


def test_an_episode_without_an_end_is_told_of_once(monkeypatch, caplog):
    monkeypatch.setattr(evaluation, "LONG_EPISODE", 50)
    steps = count(1)

    def act(observation):
        if next(steps) == 120:
            raise Stopped
        return np.zeros((len(observation), 1), np.float32)

    with pytest.raises(Stopped):
        Evaluator("Endless-v0", {}).run(act, SEEDS)
    (told,) = caplog.messages
    assert "of Endless-v0 has made 50 steps and goes on" in told
    ended = Evaluator("Endless-v0", {"max_episode_steps": 7}).run(lambda seen: np.zeros((len(seen), 1)), SEEDS)
    assert ended.lengths.tolist() == [7] * len(SEEDS), "what it advises"
