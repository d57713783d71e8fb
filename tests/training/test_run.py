"""A run in memory: its arithmetic of steps and updates, its actions, and that a test leaves it as it was."""

from __future__ import annotations

import copy
import dataclasses

import jax
import numpy as np
import pytest
from environments import tiny

from saclab.config import TrainingSettings
from saclab.environments.vector import EndedEpisode
from saclab.errors import NonFiniteError
from saclab.protocols import PROTOCOLS, make_config, training_settings
from saclab.training import seeds
from saclab.training.course import Counters, named_leaves
from saclab.training.run import Run

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
def shared_run():
    run = Run(tiny_config())
    yield run
    run.close()


@pytest.fixture
def run(shared_run):
    """A run whose counters a test may set."""
    config = shared_run.config
    shared_run.counters, shared_run.window = Counters(), []
    yield shared_run
    shared_run.config = config


def with_settings(run: Run, **changes) -> None:
    run.config = dataclasses.replace(run.config, training=dataclasses.replace(run.config.training, **changes))


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
def test_parallel_environments_keep_the_ratio_of_updates_to_steps(count, shared_run):
    run = Run(tiny_config(parallel_environments=count))
    assert run.update is shared_run.update  # the same settings are compiled once for all runs
    for number in range(1, 22):
        run.step()
        assert run.counters.steps == run.replay.added == number * count
        assert run.counters.updates == max(0, number * count - 12) // 2 == int(run.learner_state.actor.moments.count)
        assert len(run.window) == run.counters.updates
    run.close()


def test_actions_are_uniform_during_the_random_steps_and_then_the_policys_and_all_is_stored_as_it_was():
    run = Run(tiny_config(max_updates=1))
    stream = seeds.generator(run.config.seed, "exploration")
    expected = [stream.uniform(-1, 1, (1, 1)).astype(np.float32) for _ in range(12)]
    for _ in range(12):
        run.step()
    for _ in range(8):
        noise = stream.standard_normal((1, 1), np.float32)
        expected.append(
            run.policy.act(np.asarray(run.learner_state.actor.weights), run.environments.observation, noise)
        )
        run.step()
    stored = run.replay.layout.unpack(run.replay.rows[:20])
    np.testing.assert_array_equal(stored.action, np.concatenate(expected))
    limit = tiny.TIME_LIMIT
    assert stored.observation[:, 1].tolist() == [n % limit for n in range(20)]
    assert stored.next_observation[:, 1].tolist() == [n % limit + 1 for n in range(20)]
    assert stored.reward_terms[:, 0].tolist() == [n % limit + 1 for n in range(20)]
    assert stored.terminated.tolist() == [0] * 20
    run.close()


def test_another_seed_draws_everything_anew(shared_run):
    other = Run(dataclasses.replace(tiny_config(), seed=1))
    ours, theirs = (named_leaves(some.learner_state) for some in (shared_run, other))
    for name in (".actor.weights", ".critic.weights", ".key"):
        assert not np.array_equal(ours[name], theirs[name]), name
    assert not np.array_equal(shared_run.environments.observation, other.environments.observation)
    for name in ("exploration", "sampling"):
        first, second = (getattr(some, name).bit_generator.state for some in (shared_run, other))
        assert first != second, name
    other.close()


def test_evaluations_leave_training_untouched():
    tested, untested = Run(tiny_config()), Run(tiny_config())
    for step in range(30):
        tested.step()
        untested.step()
        if step % 3 == 0:
            tested.evaluate()
    assert tested.counters.evaluations == 10
    assert leaves(tested.learner_state) == leaves(untested.learner_state)
    assert tested.replay.rows.tobytes() == untested.replay.rows.tobytes()
    for name in ("exploration", "sampling"):
        assert getattr(tested, name).bit_generator.state == getattr(untested, name).bit_generator.state
    assert tested.environments.observation.tobytes() == untested.environments.observation.tobytes()
    tested.close()
    untested.close()


def test_each_evaluation_has_episodes_of_its_own_and_the_best_policy_is_kept(run):
    firsts = []

    def evaluate(rewards):
        class Fixed:
            def run(self, act, test_seeds):
                firsts.append(test_seeds)
                lengths = np.ones(len(rewards), np.int64)
                return type(episodes)(np.array(rewards), lengths)

        run.evaluator = Fixed()
        return run.evaluate()

    real = run.evaluator
    episodes, best = run.evaluate()
    assert best
    assert evaluate([100.0, 50.0])[1]
    kept = run.best_actor
    assert not evaluate([70.0, 79.0])[1]
    assert not evaluate([75.0, 75.0])[1]  # equal is not better
    assert run.best_actor is kept
    assert (run.counters.best_return, run.counters.last_return) == (75.0, 75.0)
    assert len({tuple(some) for some in firsts}) == 3
    run.evaluator = real


def test_episodes_count_from_the_end_of_the_random_steps(run):
    episode = EndedEpisode(0, 10.0, 5, False)
    run.counters.steps = 12
    assert run.count_episode(episode) == 0
    assert run.counters.running_average is None
    run.counters.steps = 13
    assert run.count_episode(episode) == 1
    assert run.counters.running_average == pytest.approx(10)
    assert run.count_episode(episode._replace(total_reward=20.0)) == 2
    assert run.counters.running_average == pytest.approx(0.8 * 10 + 0.2 * 20)


def test_a_test_is_due_once_for_each_multiple_of_its_steps(run):
    due = []
    for steps in (5, 6, 7, 8, 13, 15, 16, 30, 35):
        run.counters.steps = steps
        due.append(run.evaluation_due())
    assert due == [False, False, True, False, False, True, False, True, True]


def test_a_test_is_due_once_for_each_multiple_of_its_episodes(run):
    with_settings(run, evaluation_interval_steps=None, evaluation_interval_episodes=10)
    due = []
    for episodes in (0, 9, 10, 10, 11, 20, 29, 30):
        run.counters.episodes = episodes
        due.append(run.evaluation_due())
    assert due == [False, False, True, False, False, True, False, True]


@pytest.mark.parametrize(
    ("counters", "reason"),
    [
        ({"steps": 59}, None),
        ({"steps": 60}, "max_steps = 60"),
        ({"updates": 20}, "max_updates = 20"),
        ({"episodes": 9}, "max_episodes = 9"),
        ({"episodes": 8, "best_at_episode": 4}, "patience_episodes = 4"),
        ({"episodes": 8, "best_at_episode": 5}, None),
    ],
)
def test_a_run_ends_at_the_first_of_its_limits(run, counters, reason):
    with_settings(run, max_updates=20, max_episodes=9, patience_episodes=4)
    run.counters = Counters(**counters)
    found = run.finish_reason()
    assert found is None if reason is None else reason in found


def test_the_share_done_is_that_of_the_nearest_limit(run):
    with_settings(run, max_updates=20, max_episodes=10)
    run.counters = Counters(steps=15, updates=6, episodes=1)
    assert run.fraction_done() == pytest.approx(0.3)


def test_an_update_that_is_not_finite_is_named_with_its_metrics(run):
    good = np.zeros(len(run.metrics), np.float32)
    bad = np.array([np.nan if name == "actor_loss" else 0 for name in run.metrics], np.float32)
    run.counters.updates = 10
    run.window = [good, good, bad, good]
    with pytest.raises(NonFiniteError, match=r"update 9 gave .* in actor_loss:"):
        run.window_array()
    run.window = [good, good]
    assert run.window_array().shape == (2, len(run.metrics))
    run.window = []
    assert run.window_array().shape == (0, len(run.metrics))


@pytest.mark.parametrize("delay", [0, 1])
def test_the_policy_that_acts_is_as_many_rounds_behind_as_it_should(delay):
    run = Run(tiny_config(acting_delay=delay, updates_per_interval=2))
    after_rounds = [run.actor.tobytes()]
    while run.counters.updates < 8:
        rounds = run.counters.updates // 2
        expected = after_rounds[max(0, rounds - delay)]
        assert run.acting.tobytes() == expected
        if run.counters.steps >= run.config.training.random_steps:
            noise = copy.deepcopy(run.exploration).standard_normal((1, run.spec.action_size), np.float32)
            chosen = run.policy.act(np.frombuffer(expected, np.float32), run.environments.observation.copy(), noise)
            position = run.replay.added
            run.step()
            stored = run.replay.layout.unpack(run.replay.rows[position : position + 1]).action
            np.testing.assert_array_equal(stored, chosen)
        else:
            run.step()
        if run.counters.updates // 2 > rounds:
            after_rounds.append(np.array(run.learner_state.actor.weights).tobytes())
    assert len(set(after_rounds)) == 5
    run.close()
