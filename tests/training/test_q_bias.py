"""The critics' bias against soft returns worked out by hand, and that measuring it leaves training as it is."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv

from saclab.algorithm.learner import make_learner
from saclab.algorithm.scalars import scalars
from saclab.batch.loop import train_batch
from saclab.config import Config
from saclab.environments.checked import CheckedEnvironment
from saclab.errors import NonFiniteError
from saclab.protocols import make_config
from saclab.settings import AlgorithmSettings
from saclab.training.events import Evaluated, Warned
from saclab.training.logs import Q_BIAS_COLUMNS
from saclab.training.loop import train
from saclab.training.q_bias import Critics, Episode, QBias, known_returns, measure_q_bias
from saclab.training.run_folder import read_run


def episode(rewards: list[float], log_probs: list[float], terminated: bool) -> Episode:
    steps = len(rewards)
    return Episode(np.zeros((steps, 1)), np.zeros((steps, 1)), np.array(rewards), np.array(log_probs), terminated)


def test_soft_returns_by_hand() -> None:
    # G_2 = 4;  G_1 = 2 + 0.5 (4 - 0.1 * 3) = 3.85;  G_0 = 1 + 0.5 (3.85 - 0.1 * 2) = 2.825
    returns = known_returns(episode([1, 2, 4], [9, 2, 3], terminated=True), alpha=0.1, discount=0.5)
    np.testing.assert_allclose(returns, [2.825, 3.85, 4.0])


def test_soft_returns_of_several_steps_hold_the_targets_entropy() -> None:
    """With n = 2 that of every second action: of the others no target knows."""
    # G_2 = 4;  G_1 = 2 + 0.5 * 4 = 4, two steps to the end;  G_0 = 1 + 0.5 * 2 + 0.25 (4 - 0.1 * 3) = 2.925
    returns = known_returns(episode([1, 2, 4], [9, 2, 3], terminated=True), alpha=0.1, discount=0.5, n_step=2)
    np.testing.assert_allclose(returns, [2.925, 4.0, 4.0])


def test_the_entropy_of_the_first_action_is_not_part_of_its_own_q() -> None:
    changed = known_returns(episode([1, 2], [100, 2], terminated=True), alpha=0.1, discount=0.5)
    np.testing.assert_array_equal(changed, known_returns(episode([1, 2], [9, 2], True), alpha=0.1, discount=0.5))


def test_steps_near_a_time_limit_are_left_out() -> None:
    # 0.5^7 < 0.01: the last seven steps of an episode that was cut off have unknown returns
    assert len(known_returns(episode([1.0] * 20, [0.0] * 20, terminated=False), 0.1, 0.5)) == 13
    assert len(known_returns(episode([1.0] * 5, [0.0] * 5, terminated=False), 0.1, 0.5)) == 0
    assert len(known_returns(episode([1.0] * 5, [0.0] * 5, terminated=True), 0.1, 0.5)) == 5


def pendulum_bias(
    discount: float,
    shift: float,
    reduction: str = "minimum",
    critics_moved: int = 2,
    name: str = "Pendulum-v1",
    reward_scale: float = 1.0,
) -> QBias:
    """The bias of random critics, of some of which the output's bias is moved by `shift`."""
    settings = AlgorithmSettings(hidden_layers=(8,), discount=discount)
    environment = CheckedEnvironment(name)
    spec = environment.spec
    learner = make_learner(settings, spec.observation_size, spec.action_size)
    state = learner.init(scalars(settings, spec.action_size), jax.random.PRNGKey(0))
    critic = np.array(state.critic.weights)
    critic[:critics_moved, -1] += shift  # the last parameter is the output's bias
    critics = Critics(
        learner.policy,
        np.array(state.actor.weights),
        learner.q_values,
        critic,
        0.2,
        discount,
        1,
        reduction,
        reward_scale,
    )
    return measure_q_bias(critics, environment, [1, 2], np.random.default_rng(0))


def test_the_truth_is_divided_as_the_rewards_that_the_critics_learn_from() -> None:
    """Without a discount a return is a reward: a tenth of it under a scale of 10, and Q stays as it is."""
    plain, scaled = pendulum_bias(0.0, 0.0), pendulum_bias(0.0, 0.0, reward_scale=10.0)
    assert scaled.mean_return == pytest.approx(plain.mean_return / 10)
    assert scaled.mean_q == plain.mean_q


def test_moving_q_moves_the_bias_by_as_much_over_the_mean_return() -> None:
    low, high = pendulum_bias(0.9, 0.0), pendulum_bias(0.9, 3.0)
    assert high.mean_q - low.mean_q == pytest.approx(3.0, rel=1e-4)
    assert high.mean_bias - low.mean_bias == pytest.approx(3.0 / abs(low.mean_return), rel=1e-4)
    assert high.bias_spread == pytest.approx(low.bias_spread, rel=1e-3)


class Rewriting(PendulumEnv):
    """Writes every observation into the same array."""

    def _get_obs(self) -> np.ndarray:
        self.seen = getattr(self, "seen", np.zeros(3, np.float32))
        self.seen[:] = super()._get_obs()
        return self.seen


class NotFinite(PendulumEnv):
    """Its first observation is not."""

    def reset(self, **options: Any) -> Any:
        seen, info = super().reset(**options)
        return seen * np.inf, info


gymnasium.register("NotFinite-v0", NotFinite, max_episode_steps=200)
gymnasium.register("Rewriting-v0", Rewriting, max_episode_steps=200)


def test_an_environment_may_write_over_its_own_observations() -> None:
    assert pendulum_bias(0.9, 0.0, name="Rewriting-v0") == pendulum_bias(0.9, 0.0)


def test_a_number_that_is_not_finite_is_refused() -> None:
    """Otherwise the bias would be no number, and say nothing."""
    with pytest.raises(NonFiniteError, match="for the Q bias of NotFinite-v0"):
        pendulum_bias(0.9, 0.0, name="NotFinite-v0")


def test_the_critics_are_reduced_as_the_policy_reduces_them() -> None:
    """Far above the other, one of two critics does not count in a minimum, and half in a mean."""
    by_minimum, by_mean = (
        [pendulum_bias(0.9, shift, reduction, critics_moved=1).mean_q for shift in (100.0, 110.0)]
        for reduction in ("minimum", "mean")
    )
    assert by_minimum[1] == by_minimum[0]
    assert by_mean[1] - by_mean[0] == pytest.approx(5.0, rel=1e-3)


@pytest.mark.parametrize("together", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["alone", "in a group"])
def test_the_logged_bias_takes_the_reduction_of_the_settings(tmp_path: Path, together: bool) -> None:
    """Two runs that differ in it and have made no update: they have the same critics, which do not agree."""
    mean_q = []
    for reduction in ("minimum", "mean"):
        config, folder = judged_config(actor_reduction=reduction), tmp_path / reduction
        for _ in train_batch([config], [folder], workers=1) if together else train(config, folder):
            pass
        mean_q.append(read_run(folder).q_bias["mean_q"][0])
    assert mean_q[0] < mean_q[1]


def judged_config(**changes: object) -> Config:
    """Its only evaluation comes before its first update."""
    return make_config("Pendulum-v1", "sac", "quick", overrides={
        "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_steps": 100, "discount": 0.9,
        "evaluation_interval_steps": 200, "evaluation_episodes": 1, "q_bias_episodes": 1, **changes,
    })  # fmt: skip


def test_no_known_return_gives_nan_and_no_pairs() -> None:
    bias = pendulum_bias(0.99, 0.0)  # 459 steps would have to follow, and Pendulum's episodes have 200
    assert bias.pairs == 0
    assert math.isnan(bias.mean_bias)


def test_a_measurement_that_finds_nothing_is_warned_of_once(tmp_path: Path) -> None:
    config = make_config("Pendulum-v1", "sac", "quick", overrides={
        "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_steps": 600,
        "evaluation_interval_steps": 200, "evaluation_episodes": 1, "q_bias_episodes": 1,
    })  # fmt: skip
    events = list(train(config, tmp_path))
    (warned,) = [event.message for event in events if isinstance(event, Warned)]
    assert "the last 459 steps have no known return at discount 0.99" in warned
    assert sum(isinstance(event, Evaluated) for event in events) >= 3


def test_columns_are_the_fields() -> None:
    assert Q_BIAS_COLUMNS[4:-1] == QBias._fields


def test_measuring_is_logged_and_leaves_training_as_it_is(tmp_path: Path) -> None:
    settings = {
        "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 200, "discount": 0.9,
        "evaluation_interval_steps": 200, "evaluation_episodes": 1,
    }  # fmt: skip
    plain = make_config("Pendulum-v1", "sac", "quick", overrides=settings)
    measured = dataclasses.replace(plain, training=dataclasses.replace(plain.training, q_bias_episodes=1))
    for config, folder in ((plain, tmp_path / "plain"), (measured, tmp_path / "measured")):
        for _ in train(config, folder):
            pass
    without, with_bias = read_run(tmp_path / "plain"), read_run(tmp_path / "measured")
    np.testing.assert_array_equal(without.evaluations["returns"], with_bias.evaluations["returns"])
    np.testing.assert_array_equal(without.episodes["return"], with_bias.episodes["return"])
    assert len(without.q_bias["pairs"]) == 0
    np.testing.assert_array_equal(with_bias.q_bias["evaluation"], with_bias.evaluations["evaluation"])
    assert (with_bias.q_bias["pairs"] == 200 - 44).all()  # 0.9^44 < 0.01
