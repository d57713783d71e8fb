"""A run alone: its arithmetic of steps and updates, its actions, and that an evaluation leaves it as it was."""

from __future__ import annotations

import copy
import dataclasses
from contextlib import closing

import jax
import numpy as np
import pytest
from environments import tiny

from saclab.protocols import PROTOCOLS, make_config, training_settings
from saclab.settings import TrainingSettings
from saclab.training import seeds
from saclab.training.learners import named_leaves
from saclab.training.local_engine import LocalEngine

TINY = {
    "hidden_layers": (8,),
    "batch_size": 4,
    "random_steps": 12,
    "update_interval": 2,
    "replay_capacity": 50,
    "max_steps": 60,
    "evaluation_interval_steps": 7,
    "evaluation_episodes": 2,
}


def tiny_config(**changes):
    return make_config("Counting-v0", "sac", overrides={**TINY, **changes})


@pytest.fixture(scope="module")
def shared():
    with closing(LocalEngine.new(tiny_config())) as engine:
        yield engine


def leaves(tree) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize(
    ("interval", "per_interval", "due"),
    [
        (1, 1, {0: 0, 100: 0, 101: 1, 102: 2, 150: 50}),
        (5, 1, {100: 0, 104: 0, 105: 1, 109: 1, 110: 2, 1100: 200}),
        (1, 3, {100: 0, 101: 3, 110: 30, 120: 60}),
        (4, 2, {103: 0, 104: 2, 107: 2, 108: 4}),
    ],
)
def test_updates_due_after_the_random_steps(interval, per_interval, due):
    settings = TrainingSettings(
        random_steps=100, update_interval=interval, updates_per_interval=per_interval, max_updates=200,
        evaluation_interval_steps=1,
    )  # fmt: skip
    limited = dataclasses.replace(settings, max_updates=40)
    assert {steps: settings.updates_due(steps) for steps in due} == due
    assert {steps: limited.updates_due(steps) for steps in due} == {steps: min(40, n) for steps, n in due.items()}
    assert settings.update_to_data_ratio == per_interval / interval


def test_the_papers_protocol_makes_200_updates_per_episode_of_1000_steps():
    settings = training_settings("paper", "HalfCheetah-v4")
    assert settings.updates_due(settings.random_steps + 1000) == 200
    assert settings.max_updates / 200 == 6000  # episodes
    assert (settings.evaluation_interval_episodes, settings.evaluation_episodes) == (10, 20)
    assert settings.patience_episodes is None
    humanoid = training_settings("paper", "Humanoid-v4")
    assert (humanoid.max_updates, humanoid.max_episodes, humanoid.patience_episodes) == (1_500_000, 10_000, 750)


@pytest.mark.parametrize("name", ["Humanoid-v4", "Humanoid-v5", "gymnasium.envs.mujoco:Humanoid-v4"])
def test_the_papers_settings_for_humanoid_hold_however_its_id_is_written(name):
    config = make_config(name, "sac", "paper")
    assert (config.algorithm.initial_temperature, config.training.max_updates) == (0.1, 1_500_000)
    assert config.training.patience_episodes == 750


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_protocol_updates_before_a_batch_can_be_drawn(protocol):
    config = make_config("HalfCheetah-v4", protocol=protocol)
    assert config.training.updates_due(config.algorithm.batch_size) == 0


@pytest.mark.parametrize("count", [1, 3])
def test_parallel_environments_keep_the_ratio_of_updates_to_steps(count, shared):
    with closing(LocalEngine.new(tiny_config(parallel_environments=count))) as engine:
        assert engine.update is shared.update  # the same settings are compiled once for all runs
        counters = engine.run.counters
        for number in range(1, 22):
            engine.step()
            assert counters.steps == engine.replay.added == number * count
            assert counters.updates == max(0, number * count - 12) // 2 == int(engine.learner_state.actor.moments.count)
            assert len(engine.run.window) == engine.run.window_size == counters.updates


def test_actions_are_uniform_at_first_and_then_the_policys():
    """All of a transition is stored as it was."""
    engine = LocalEngine.new(tiny_config(max_updates=1))
    stream = seeds.generator(engine.run.config.seed, "exploration")
    expected = [stream.uniform(-1, 1, (1, 1)).astype(np.float32) for _ in range(12)]
    for _ in range(12):
        engine.step()
    for _ in range(8):
        noise = stream.standard_normal((1, 1), np.float32)
        actor = np.asarray(engine.learner_state.actor.weights)
        expected.append(engine.policy.act(actor, engine.environments.observation, noise))
        engine.step()
    stored = engine.replay.layout.unpack(engine.replay.rows[:20])
    np.testing.assert_array_equal(stored.action, np.concatenate(expected))
    limit = tiny.TIME_LIMIT
    assert stored.observation[:, 1].tolist() == [n % limit for n in range(20)]
    assert stored.next_observation[:, 1].tolist() == [n % limit + 1 for n in range(20)]
    assert stored.reward_terms[:, 0].tolist() == [n % limit + 1 for n in range(20)]
    assert stored.terminated.tolist() == [0] * 20
    engine.close()


def test_another_seed_draws_everything_anew(shared):
    other = LocalEngine.new(dataclasses.replace(tiny_config(), seed=1))
    ours, theirs = (named_leaves(some.learner_state) for some in (shared, other))
    for name in (".actor.weights", ".critic.weights", ".key"):
        assert not np.array_equal(ours[name], theirs[name]), name
    assert not np.array_equal(shared.environments.observation, other.environments.observation)
    for draws in (lambda run: run.exploration.generator, lambda run: run.sampling):
        first, second = (draws(some.run).bit_generator.state for some in (shared, other))
        assert first != second
    other.close()


def test_evaluations_leave_training_untouched():
    evaluated, plain = LocalEngine.new(tiny_config()), LocalEngine.new(tiny_config())
    returns = []
    for step in range(30):
        evaluated.step()
        plain.step()
        if step % 3 == 0:
            episodes = evaluated.evaluate([0])[0]
            evaluated.run.enter_evaluation(episodes, evaluated.actor(0))
            returns += episodes.total_rewards.tolist()
    assert len(returns) == 2 * evaluated.run.counters.evaluations == 20
    assert leaves(evaluated.learner_state) == leaves(plain.learner_state)
    assert evaluated.replay.rows.tobytes() == plain.replay.rows.tobytes()
    for draws in (lambda run: run.exploration.generator, lambda run: run.sampling):
        first, second = (draws(some.run).bit_generator.state for some in (evaluated, plain))
        assert first == second
    assert evaluated.environments.observation.tobytes() == plain.environments.observation.tobytes()
    evaluated.close()
    plain.close()


@pytest.mark.parametrize("delay", [0, 1])
def test_the_behaviour_parameters_are_as_many_rounds_behind_as_they_should(delay):
    engine = LocalEngine.new(tiny_config(acting_delay=delay, updates_per_interval=2))
    run, after_rounds = engine.run, [engine.actor(0).tobytes()]
    while run.counters.updates < 8:
        rounds = run.counters.updates // 2
        expected = after_rounds[max(0, rounds - delay)]
        assert engine.behaviour.tobytes() == expected
        if run.counters.steps >= run.config.training.random_steps:
            noise = copy.deepcopy(run.exploration).noise()
            observation = engine.environments.observation.copy()
            chosen = engine.policy.act(np.frombuffer(expected, np.float32), observation, noise)
            position = engine.replay.added
            engine.step()
            stored = engine.replay.layout.unpack(engine.replay.rows[position : position + 1]).action
            np.testing.assert_array_equal(stored, chosen)
        else:
            engine.step()
        if run.counters.updates // 2 > rounds:
            after_rounds.append(np.array(engine.learner_state.actor.weights).tobytes())
    assert len(set(after_rounds)) == 5
    engine.close()
