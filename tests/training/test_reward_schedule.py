"""A run under a reward schedule: which weights are in force when, what is learned, logged, resumed and measured."""

from __future__ import annotations

import csv
from contextlib import closing
from unittest import mock

import numpy as np
import pytest
from environments import tiny  # noqa: F401 - registers them
from resume.helpers import assert_same_run, finish, small_config, stop_at

from saclab.config import Config
from saclab.memory import needed_memory
from saclab.protocols import make_config
from saclab.records import Damaged
from saclab.training import loop
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.local_engine import LocalBuilder, LocalEngine
from saclab.training.logs import reward_term_columns
from saclab.training.requests import Requests
from saclab.training.run_folder import read_run
from saclab.training.starts import early_end_notes

CHEETAH = "HalfCheetah-v4"
SLOPE = {"reward_schedule": ("reward_ctrl: 0@0.25 1@0.75",)}
SMALL = {"hidden_layers": (8,), "batch_size": 16, "random_steps": 20, "max_updates": 8}


def weights_of_updates(config: Config, pausing: bool) -> list[float]:
    """The first term's weight in each update of a run, as its engine gives it to the learner.

    With `pausing`, there is a break after each update, in which the run could be saved.
    """
    found = []
    with closing(LocalEngine.new(config)) as engine:
        update = engine.update

        def noting(numbers, state, rows, context):
            found.append(float(context.reward_weights[0]))
            return update(numbers, state, rows, context)

        engine.update = noting
        while engine.run.finish_reason() is None:
            engine.step(lambda: pausing)
            while engine.run.updates_left:
                engine.make_updates(lambda: pausing)
    return found


@pytest.mark.parametrize("pausing", [False, True])
@pytest.mark.parametrize(
    ("round_of", "expected"),
    [
        (1, [0, 0, 0, 0.25, 0.5, 0.75, 1, 1]),  # after 0 … 7 of 8 updates
        (2, [0, 0, 0, 0, 0.5, 0.5, 1, 1]),  # the updates of a round have the weights of its beginning
    ],
)
def test_an_update_has_the_weights_of_the_updates_before_its_round(round_of, expected, pausing):
    rounds = {"update_interval": round_of, "updates_per_interval": round_of}
    config = make_config(CHEETAH, "sac", overrides={**SLOPE, **SMALL, **rounds})
    assert weights_of_updates(config, pausing) == expected


def test_the_best_evaluation_so_far_moves_weights_and_a_worse_one_not():
    changes = {"reward_schedule": ("reward_ctrl: 0@return=100 1@return=200",), **SMALL}
    with closing(LocalEngine.new(make_config(CHEETAH, "sac", overrides=changes))) as engine:
        found = [engine.run.reward_weights()[0]]
        for value in (150.0, 110.0, 175.0, 1000.0, 0.0):
            episodes = EvaluationEpisodes(np.array([value]), np.ones(1, np.int64), np.array([[0.0, value]]))
            engine.run.enter_evaluation(episodes, engine.actor(0))
            found.append(engine.run.reward_weights()[0])
    assert found == [0, 0.5, 0.5, 0.75, 1, 1]


def learned(**changes: object) -> np.ndarray:
    """The critics after 30 updates."""
    config = make_config(CHEETAH, "sac", overrides={**SMALL, "max_updates": 30, **changes})
    with closing(LocalEngine.new(config)) as engine:
        while engine.run.finish_reason() is None:
            engine.step()
        return np.asarray(engine.learner_state.critic.weights)


@pytest.mark.slow
def test_a_schedule_of_ones_is_the_run_with_terms_bit_for_bit():
    names = ("reward_run", "reward_ctrl")
    ones = learned(reward_schedule=[f"{name}: 1@0 1@0.4 1@1" for name in names])
    np.testing.assert_array_equal(ones, learned(reward_terms=names))
    np.testing.assert_allclose(ones, learned(), rtol=1e-3, atol=1e-5)  # but for the rounding of the terms
    assert np.abs(ones - learned(**SLOPE)).max() > 1e-3


ALL_AT_ONCE = {"reward_scaling": "deviation", "n_step": 3, "acting_delay": 1}


@pytest.mark.parametrize("changes", [ALL_AT_ONCE, pytest.param({}, marks=pytest.mark.slow)])
def test_a_run_that_stops_on_a_slope_goes_on_bit_for_bit(changes, tmp_path):
    """The stop comes between two rounds; one term goes by the updates, one by the returns."""
    schedule = ("reward_ctrl: 0@0.1 3@0.9", "reward_run: 0@return=-200 1@return=0")
    rounds = {"update_interval": 10, "updates_per_interval": 7}
    config = small_config(CHEETAH, "sac-auto", reward_schedule=schedule, **rounds, **changes)
    finish(config, tmp_path / "straight")
    stop_at(150, config, tmp_path / "stopped")
    finish(config, tmp_path / "stopped")
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")
    weights = read_run(tmp_path / "straight").reward_terms["weight_reward_ctrl"]
    assert 0 < weights[0] < weights[1] <= 3


def test_a_run_that_stops_within_a_round_on_a_slope_goes_on_bit_for_bit(tmp_path):
    """The rest of the round has the weights of its beginning, whatever was made of it before."""
    rounds = {"update_interval": 10, "updates_per_interval": 7, "max_steps": 130}
    config = small_config("Leaning-v0", "sac-auto", reward_schedule=("right: 0@0.1 3@0.9",), **rounds)
    finish(config, tmp_path / "straight")
    requests, real, left = Requests(), LocalEngine.make_updates, []

    def make_updates(engine, should_pause):
        def asked():
            if engine.run.counters.updates == 3 * 7 + 4:
                requests.stop = 1
                left.append(engine.run.updates_left)
            return should_pause()

        real(engine, asked)

    with mock.patch.object(LocalEngine, "make_updates", make_updates):
        list(loop.train(config, tmp_path / "stopped", requests))
    assert left == [3]
    finish(config, tmp_path / "stopped")
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")


def test_the_scale_of_the_rewards_is_that_of_the_weighed_ones():
    """Episodes of one step, of which twice the action counts: the returns are that, and the scale their deviation."""
    weights = {"reward_terms": ("right", "left"), "reward_weights": (2.0, 0.0), "reward_scaling": "deviation"}
    with closing(LocalEngine.new(make_config("Leaning-v0", "sac", overrides={**SMALL, **weights}))) as engine:
        for _ in range(20):
            engine.step()
        right = np.array(engine.replay.layout.unpack(engine.replay.rows[:20]).action[:, 0], np.float64)
        assert float(engine.context.reward_scale) == pytest.approx(2 * right.std(), rel=1e-3)


def test_each_evaluation_logs_the_terms_of_its_return_and_their_weights(tmp_path):
    changes = {"reward_schedule": ("reward_ctrl: 0@0 1@1", "reward_run: 5@0"), "evaluation_episodes": 2}
    config = small_config(CHEETAH, "sac", **changes)
    finish(config, tmp_path)
    run = read_run(tmp_path)
    terms, evaluations = run.reward_terms, run.evaluations
    added = terms["return_reward_ctrl"] + terms["return_reward_run"] + terms["return_remainder"]
    np.testing.assert_allclose(added, evaluations["mean_return"], rtol=1e-9)
    assert (terms["return_reward_ctrl"] < 0).all()
    np.testing.assert_allclose(terms["weight_reward_ctrl"], evaluations["updates"] / config.planned_updates, rtol=1e-6)
    assert terms["weight_reward_run"].tolist() == [5] * len(evaluations["updates"])
    assert run.result["best_return"] == evaluations["mean_return"].max()  # the environment's own reward
    (tmp_path / "reward_terms.csv").unlink()
    with pytest.raises(Damaged, match=r"reward_terms\.csv .*it is missing"):
        read_run(tmp_path)


def test_a_run_without_terms_has_no_such_log(tmp_path):
    finish(small_config("Pendulum-v1", "sac"), tmp_path)
    assert read_run(tmp_path).reward_terms == {}
    assert not (tmp_path / "reward_terms.csv").exists()


def test_terms_whose_names_are_no_words_are_numbered():
    names = ("run", 'a,"b', "7", "remainder", "é")
    columns = reward_term_columns(names)
    assert columns[4:10] == ("return_run", "return_1", "return_2", "return_3", "return_4", "return_remainder")
    assert next(csv.reader([",".join(columns)])) == list(columns)


def test_the_memory_of_the_terms_is_forecast():
    """Two terms and a remainder for one reward: two numbers more in each row."""
    needed = []
    for changes in ({}, {"reward_schedule": ("reward_run: 1@0", "reward_ctrl: 1@0")}):
        config = make_config(CHEETAH, "sac", overrides={**SMALL, "replay_capacity": 1000, **changes})
        needed.append(needed_memory(config, LocalBuilder(config).layout).replay)
    assert needed[1] - needed[0] == 1000 * 2 * 4


def test_the_q_bias_is_that_of_the_weighed_reward():
    """Without a discount a return is a reward: that of the critics, halfway up a slope from 0 to −2 of the control."""
    config = make_config(
        CHEETAH, "sac",
        overrides={**SMALL, "q_bias_episodes": 1, "discount": 0.0, "reward_schedule": ("reward_ctrl: 0@0 -4@1",),
                   "reward_terms": ("reward_run",), "reward_weights": (0.0,)},
    )  # fmt: skip
    with closing(LocalEngine.new(config)) as engine:
        while engine.run.counters.updates < 4:
            engine.step()
        assert engine.run.reward_weights().tolist() == [0, -2, 1]
        bias = engine.measure_q_bias([0])[0]
        engine.run.counters.steps = 0  # the weights of the beginning: nothing of the reward is left
        nothing = engine.measure_q_bias([0])[0]
    control = bias.mean_return / -2  # −0.1 of the squared action, of which there are six of at most 1
    assert -0.6 <= control < -0.05
    assert nothing.mean_return == pytest.approx(0, abs=1e-6)


FLIP = ("right: 1@0.4 0@0.6", "left: 0@0.4 1@0.6")


def leaning(**changes: object) -> list[float]:
    """The deterministic action, in the middle of the first weights and at the end, of a policy that learns to lean."""
    changes = {
        "hidden_layers": (16,), "batch_size": 32, "random_steps": 100, "max_updates": 400, "polyak_rate": 0.05,
        "actor_learning_rate": 0.01, "critic_learning_rate": 0.01, "initial_temperature": 0.1, **changes,
    }  # fmt: skip
    found = []
    with closing(LocalEngine.new(make_config("Leaning-v0", "sac", overrides=changes))) as engine:
        while engine.run.finish_reason() is None:
            engine.step()
            if engine.run.counters.updates in (160, 400):
                found.append(float(engine.policy.mode(engine.actor(0), np.ones((1, 1), np.float32))[0, 0]))
    return found


def test_the_best_action_flips_with_the_weights_though_replay_is_old():
    """The environment's own reward is 0 throughout; at the end, half of replay was gathered leaning right."""
    first, last = leaning(reward_schedule=FLIP)
    assert first > 0.7
    assert last < -0.7


def test_limits_that_may_cut_a_schedule_off_are_told_of():
    (note,) = early_end_notes(make_config("Humanoid-v4", "curriculum", "paper"))
    assert note.startswith("reward_schedule: over 1500000 planned updates")
    assert note.endswith("without: --max-episodes None --patience-episodes None")
    (note,) = early_end_notes(make_config(CHEETAH, "xqc", "standard", overrides={"max_episodes": 40}))
    assert note.startswith("learning_rate_schedule: over 1990000 planned updates, before which max_episodes may")
    by_return = {"reward_schedule": ("reward_linvel: 0.2@return=500 1@return=900",)}
    assert early_end_notes(make_config("Humanoid-v4", "curriculum", "paper", overrides=by_return)) == []
    assert early_end_notes(make_config("Humanoid-v4", "curriculum", "standard")) == []
    assert early_end_notes(make_config(CHEETAH, "sac", "paper")) == []
