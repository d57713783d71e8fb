"""What a run counts and draws: its episodes, when it is evaluated, when it ends, its window of metrics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from saclab.environments.vector import EndedEpisode
from saclab.errors import NonFiniteError
from saclab.protocols import make_config
from saclab.replay import RowLayout
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.run_state import RunState
from saclab.training.saved_state import Counters


@pytest.fixture
def run():
    return RunState(make_config("Counting-v0", "sac", overrides={
        "batch_size": 4, "random_steps": 12, "max_steps": 60, "evaluation_interval_steps": 7, "evaluation_episodes": 2,
    }), RowLayout(1, 1))  # fmt: skip


def with_settings(run: RunState, **changes) -> None:
    run.config = dataclasses.replace(run.config, training=dataclasses.replace(run.config.training, **changes))


def test_evaluations_have_their_own_episodes_and_keep_the_best_policy(run):
    seen = []

    def enter(rewards, policy):
        seen.append(run.evaluation_seeds())
        return run.enter_evaluation(
            EvaluationEpisodes(np.array(rewards), np.ones(2, np.int64), np.array([rewards]).T), np.array([policy])
        )

    assert enter([0.0, 1.0], 1)
    assert enter([100.0, 50.0], 2)
    kept = run.best_actor
    assert not enter([70.0, 79.0], 3)
    assert not enter([75.0, 75.0], 4)  # equal is not better
    assert run.best_actor is kept
    assert kept == [2]
    assert (run.counters.best_return, run.counters.last_return) == (75.0, 75.0)
    assert len({tuple(some) for some in seen}) == 4


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


def test_an_evaluation_is_due_once_for_each_multiple_of_its_steps(run):
    due = []
    for steps in (5, 6, 7, 8, 13, 15, 16, 30, 35):
        run.counters.steps = steps
        due.append(run.evaluation_due())
    assert due == [False, False, True, False, False, True, False, True, True]


def test_an_evaluation_is_due_once_for_each_multiple_of_its_episodes(run):
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
    assert run.close_window().shape == (2, len(run.metrics))
    assert run.window_array().shape == (0, len(run.metrics))
    assert run.window_size == 0
