"""A policy in a user's hands: Stable-Baselines3's signature, the environment's own units, no code in its files."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import saclab
from saclab.environments.make import EnvironmentSpec
from saclab.errors import UserError
from saclab.protocols import make_config
from saclab.trained_policy import TrainedPolicy, load_policy, policy_folder, save_policy
from saclab.training.evaluation import Evaluator

SIZES = {"hidden_layers": (16, 16), "batch_size": 32, "random_steps": 100}
SPEC = EnvironmentSpec(3, 2, np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32))


@pytest.fixture
def policy(tmp_path: Path) -> TrainedPolicy:
    """A random policy for SPEC that has been saved and loaded."""
    config = make_config("Some-v0", overrides=SIZES)
    parameters = TrainedPolicy(config.algorithm, SPEC, np.zeros(0)).policy.network.size
    actor = np.random.default_rng(0).normal(scale=0.3, size=parameters).astype(np.float32)
    save_policy(tmp_path / "best", config, SPEC, actor, {})
    return load_policy(tmp_path)


def test_actions_have_the_shape_and_bounds_of_the_environment(policy: TrainedPolicy) -> None:
    observations = np.random.default_rng(1).normal(size=(50, 3)) * 10
    for deterministic in (True, False):
        actions, state = policy.predict(observations, deterministic=deterministic)
        assert actions.shape == (50, 2)
        assert state is None
        assert (actions >= SPEC.action_low).all()
        assert (actions <= SPEC.action_high).all()
    assert actions[:, 1].max() > 2, "the second action's bounds are its own"
    assert policy.predict(observations[0])[0].shape == (2,)


def test_a_batch_gives_the_actions_of_its_rows(policy: TrainedPolicy) -> None:
    observations = np.random.default_rng(1).normal(size=(5, 3))
    rows = np.stack([policy.predict(row)[0] for row in observations])
    np.testing.assert_allclose(policy.predict(observations)[0], rows, rtol=1e-5, atol=1e-5)


def test_the_deterministic_action_is_the_scaled_tanh_of_the_mean(policy: TrainedPolicy) -> None:
    observation = np.array([[0.1, -0.2, 0.3]], np.float32)
    mean, _ = policy.policy.distribution(policy.parameters, observation)
    expected = np.array([0.0, 5.0]) + np.array([2.0, 5.0]) * np.tanh(mean[0])
    np.testing.assert_allclose(policy.predict(observation[0])[0], expected, rtol=1e-5)


def test_a_wrong_observation_is_named(policy: TrainedPolicy) -> None:
    with pytest.raises(UserError, match=r"shape \(4,\)"):
        policy.predict(np.zeros(4))


def evaluate_policy(model: TrainedPolicy, environment: gymnasium.Env, episodes: int) -> list[float]:
    """The loop of Stable-Baselines3's evaluate_policy, which calls predict with these arguments."""
    returns = []
    for episode in range(episodes):
        observation, _ = environment.reset(seed=episode)
        state, start, total, done = None, np.ones(1, bool), 0.0, False
        while not done:
            action, state = model.predict(observation, state=state, episode_start=start, deterministic=True)
            observation, reward, terminated, truncated, _ = environment.step(action)
            total, done, start = total + float(reward), terminated or truncated, np.zeros(1, bool)
        returns.append(total)
    return returns


def test_a_trained_run_gives_a_policy_that_plays_as_its_evaluation_said(tmp_path: Path) -> None:
    run = saclab.train(
        "Pendulum-v1", "sac", protocol="quick", runs=tmp_path, **SIZES, max_updates=50,
        evaluation_interval_steps=1000, evaluation_episodes=2,
    )  # fmt: skip
    assert run.result is not None
    policy = saclab.load_policy(run.path)
    played = evaluate_policy(policy, gymnasium.make("Pendulum-v1"), 2)
    evaluator = Evaluator("Pendulum-v1", {})
    np.testing.assert_allclose(evaluator.run(policy.normalised_action, [0, 1]).total_rewards, played, rtol=1e-2)


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no folder .*elsewhere"):
        load_policy(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="holds no policy yet"):
        load_policy(tmp_path)


def test_a_folder_that_holds_a_policy_is_used_whatever_lies_in_its_best(tmp_path: Path) -> None:
    (tmp_path / "best").mkdir()
    assert policy_folder(tmp_path) == tmp_path / "best"
    (tmp_path / "policy.json").write_text("{}")
    (tmp_path / "best" / "video.mp4").touch()
    assert policy_folder(tmp_path) == tmp_path
