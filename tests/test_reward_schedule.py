"""Weights of reward terms over training: by hand, as text, and what is refused."""

from __future__ import annotations

import pytest

from saclab.config import Config, group_key
from saclab.errors import SettingError, UserError
from saclab.grid.sweep import parse_sweep
from saclab.protocols import make_config, own_config
from saclab.reward_schedule import parse_schedule
from saclab.settings import AlgorithmSettings, structure
from saclab.training.reward_weights import reward_weights
from saclab.variants import VARIANTS

SLOPE = "run: 0.25@0.2 1.25@0.7"
CLIMB = "alive: 3@return=-100 1@return=100 0@return=500"


@pytest.mark.parametrize(
    ("share", "weight"), [(0, 0.25), (0.2, 0.25), (0.45, 0.75), (0.7, 1.25), (1, 1.25)],
)  # fmt: skip
def test_weights_by_the_share_of_the_updates_by_hand(share, weight):
    (term,) = parse_schedule([SLOPE])
    assert term.weight(share, None) == pytest.approx(weight, abs=1e-15)


@pytest.mark.parametrize(
    ("best_return", "weight"),
    [(None, 3), (-1e9, 3), (-100, 3), (-50, 2.5), (0, 2), (100, 1), (300, 0.5), (500, 0), (1e9, 0)],
)
def test_weights_by_the_evaluation_return_by_hand(best_return, weight):
    (term,) = parse_schedule([CLIMB])
    assert [term.weight(share, best_return) for share in (0, 1)] == [weight, weight]


def test_each_term_has_its_weight_and_the_remainder_one():
    settings = AlgorithmSettings(
        reward_terms=("run", "control", "contact"), reward_weights=(5, 7), reward_schedule=(SLOPE, CLIMB)
    )
    assert settings.terms_of_reward == ("run", "control", "contact", "alive")
    assert reward_weights(settings, 0.45, 0.0).tolist() == [0.75, 5, 7, 2, 1]
    assert reward_weights(AlgorithmSettings(), 0.45, 0.0).tolist() == [1]


def test_a_schedule_has_one_spelling():
    settings = AlgorithmSettings(reward_schedule=[" run:0.250@0.20   1.25@.7", "a: b: -1e3@return=+5"])
    assert settings.reward_schedule == ("run: 0.25@0.2 1.25@0.7", "a: b: -1000@return=5")
    assert settings == AlgorithmSettings(reward_schedule=settings.reward_schedule)
    config = make_config("HalfCheetah-v4", overrides={"reward_schedule": settings.reward_schedule})
    assert Config.from_dict(config.to_dict()) == config


@pytest.mark.parametrize(
    ("schedule", "message"),
    [
        (["run"], "write a term, a colon and its points"),
        (["run:"], "write a term, a colon and its points"),
        ([": 1@0"], "write a term, a colon and its points"),
        (["run: 1"], "'1' is no weight and point"),
        (["run: @0.5"], "'@0.5' is no weight and point"),
        (["run: nan@0"], "'nan@0' is no weight and point: write finite numbers"),
        (["run: 1@inf"], "'1@inf' is no weight"),
        (["run: 1e39@0"], "'1e39@0' is no weight"),
        (["run: 1@1.01"], r"is at 1.01 of the updates: use a share from 0 to 1, or write @return=1.01"),
        (["run: 1@-0.1"], "is at -0.1 of the updates"),
        (["run: 1@0.5 2@0.4"], "each further on than the one before: 0.4 is not after 0.5"),
        (["run: 1@0.5 2@0.5"], "0.5 is not after 0.5"),
        (["run: 1@return=5 2@return=-5"], "-5 is not after 5"),
        (["run: 1@0 2@return=5"], "all points of a term as shares of the updates"),
        (["run: 1@0", "run: 2@1"], "all points of a term at once"),
        ("run: 1@0", "give a list of texts"),
        ([1.0], "give a list of texts"),
    ],
)
def test_what_is_no_schedule_is_refused_with_what_would_work(schedule, message):
    with pytest.raises(SettingError, match=rf"^reward_schedule = .*{message}"):
        AlgorithmSettings(reward_schedule=schedule)


def test_a_term_has_a_weight_or_a_schedule():
    given = {"reward_terms": ("run", "control"), "reward_schedule": (SLOPE,)}
    AlgorithmSettings(reward_weights=(2.0,), **given)
    with pytest.raises(SettingError, match="one for each of the 1 reward_terms without a reward_schedule, or none"):
        AlgorithmSettings(reward_weights=(2.0, 3.0), **given)


def test_a_term_is_named_once():
    with pytest.raises(SettingError, match="reward_terms = 'run control run': name each term once"):
        AlgorithmSettings(reward_terms=("run", "control", "run"))


def test_shares_need_a_number_of_updates_and_returns_do_not():
    limits = {"max_steps": None, "max_episodes": 10}
    make_config("HalfCheetah-v4", overrides={**limits, "reward_schedule": (CLIMB,)})
    with pytest.raises(SettingError, match=r"reward_schedule = 'run.*give max_updates or max_steps too"):
        make_config("HalfCheetah-v4", overrides={**limits, "reward_schedule": (CLIMB, SLOPE)})


def test_runs_of_different_schedules_are_one_program():
    schedules = [(SLOPE,), ("run: 1@0",), ("run: 3@return=5",)]
    configs = [make_config("HalfCheetah-v4", overrides={"reward_schedule": texts}) for texts in schedules]
    configs.append(make_config("HalfCheetah-v4", overrides={"reward_terms": ("run",), "reward_weights": (2,)}))
    assert len({group_key(config) for config in configs}) == 1
    assert structure(configs[0].algorithm).reward_terms == ("run",)
    assert group_key(make_config("HalfCheetah-v4")) != group_key(configs[0])


def test_a_sweep_takes_schedules():
    assert parse_sweep(["reward_schedule=a: 0@0 1@0.5; b: 2@0,a: 1@0"]) == {
        "reward_schedule": (("a: 0@0 1@0.5", "b: 2@0"), ("a: 1@0",))
    }


@pytest.mark.parametrize("variant", ["curriculum", "curriculum-fixed"])
def test_the_rows_stand_first_then_walk(variant):
    temperature = {"curriculum": ("learned", 1.0), "curriculum-fixed": ("fixed", 0.1)}[variant]
    for environment, forward in (("Humanoid-v4", "reward_linvel"), ("my.package:Humanoid-v5", "reward_forward")):
        settings = make_config(environment, variant, "paper").algorithm
        assert (settings.temperature, settings.initial_temperature) == temperature
        place = settings.terms_of_reward.index(forward)
        weights = [reward_weights(settings, share, None).tolist() for share in (0, 0.3, 0.5, 1)]
        assert [row.pop(place) for row in weights] == pytest.approx([0.2, 0.6, 1, 1])
        assert {weight for row in weights for weight in row} == {1.0}


def test_a_row_without_the_terms_of_an_environment_says_what_to_give():
    with pytest.raises(UserError, match=r"reward_schedule = None: this row does not know .* on HalfCheetah-v4"):
        make_config("HalfCheetah-v4", "curriculum")
    with pytest.raises(UserError, match=r"reward_schedule = \(\): this row does not know .* on HalfCheetah-v4"):
        make_config("HalfCheetah-v4", "curriculum", overrides={"reward_schedule": ()})
    given = make_config("HalfCheetah-v4", "curriculum", overrides={"reward_schedule": ("reward_run: 1@0",)})
    assert given.algorithm.terms_of_reward == ("reward_run",)
    assert own_config("HalfCheetah-v4", "curriculum", "quick").algorithm.reward_schedule == ()
    assert {name for name, row in VARIANTS.items() if row.needs} == {"curriculum", "curriculum-fixed"}
