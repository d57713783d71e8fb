"""What is searched: defaults of every variant, changed by a table, drawn and read back."""

from __future__ import annotations

import dataclasses

import optuna
import pytest

from saclab.errors import SettingError, UserError
from saclab.protocols import make_config
from saclab.settings import AlgorithmSettings
from saclab.tuning.plan import make_plan
from saclab.tuning.space import Choice, Range, changed_space, default_space, read_space, suggested_value, values_of
from saclab.variants import VARIANTS

WITH_LOG = {"low": 1e-4, "high": 1e-2, "log": True}


def plan(space=(), variant="sac-auto", overrides=(), objective="mean", score=None):
    return make_plan("Pendulum-v1", variant, "quick", 1, objective, score, dict(space), dict(overrides), {}, 0, True)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_has_a_space_whose_ends_can_all_be_built(variant):
    given = dict.fromkeys(VARIANTS[variant].needs, ("reward: 0.5@0.1 1@0.5",))
    searched = plan(variant=variant, overrides=given).space
    assert {"discount", "critic_learning_rate", "actor_learning_rate"} <= searched.keys()
    for name, dimension in searched.items():
        for value in dimension.ends:
            make_config("Pendulum-v1", variant, "quick", overrides={name: value, **given})


def test_what_a_variant_does_not_have_is_not_searched():
    plain = AlgorithmSettings()
    assert "initial_temperature" in default_space(plain)
    assert not {"temperature_learning_rate", "target_entropy_per_action", "snapshots"} & default_space(plain).keys()
    learned = dataclasses.replace(plain, temperature="learned", snapshots=10)
    assert {"temperature_learning_rate", "snapshots", "snapshot_interval"} <= default_space(learned).keys()
    assert "initial_temperature" not in default_space(learned)
    assert "polyak_rate" not in default_space(dataclasses.replace(plain, snapshots=0))


def test_choices_that_the_other_settings_do_not_allow_are_left_out():
    space = plan(overrides={"random_steps": 200}).space
    assert space["batch_size"] == Choice((64, 128)), "an update draws from what the random steps have stored"
    assert "polyak_rate" not in plan(overrides={"polyak_rate": 0.01}).space, "what the user has set is not searched"


def test_a_file_changes_the_space(tmp_path):
    file = tmp_path / "space.toml"
    file.write_text(
        "discount = false\nbatch_size = [32, 64]\nn_step = {low = 1, high = 5}\n"
        "[critic_learning_rate]\nlow = 1e-4\nhigh = 1e-2\nlog = true\n[hidden_layers]\nchoices = [[8], [8, 8]]\n"
    )
    space = changed_space(default_space(AlgorithmSettings()), read_space(file))
    assert "discount" not in space
    assert "polyak_rate" in space
    assert space["batch_size"] == Choice((32, 64))
    assert space["n_step"] == Range(1, 5)
    assert space["critic_learning_rate"] == Range(1e-4, 1e-2, log=True)
    assert space["hidden_layers"] == Choice(((8,), (8, 8)))
    assert changed_space(space, {"defaults": False, "n_step": [1, 3]}) == {"n_step": Choice((1, 3))}


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"polyak_rat": [1, 2]}, "unknown setting 'polyak_rat': did you mean 'polyak_rate'"),
        ({"max_steps": [1, 2]}, "space = 'max_steps': all trials must agree in it"),
        ({"polyak_rate": 0.1}, "write low and high"),
        ({"polyak_rate": {"low": 0.1}}, "write low and high"),
        ({"polyak_rate": {"low": 0.2, "high": 0.1}}, "space, polyak_rate: low = 0.2: use a value below high"),
        ({"polyak_rate": {"low": 0.0, "high": 0.1, "log": True}}, "low = 0.0: use a value above 0 together with log"),
        ({"polyak_rate": ["fast", "slow"]}, "Expected `float`"),
        ({"snapshots": [1.5, 2]}, "Expected `int`"),
        ({"snapshots": [1]}, "give at least two values"),
        ({"network": {"low": "mlp", "high": "tqc"}}, "network"),
        ({"hidden_layers": {"low": [8], "high": [9]}}, "only numbers have a range"),
        ({"discount": {"low": 0.9, "high": 1.0}}, "discount = 1.0: use a value in"),
        ({"defaults": False}, "leave at least one setting to search"),
    ],
)
def test_what_cannot_be_searched_is_refused_with_what_would_work(space, message):
    with pytest.raises(UserError, match=message):
        plan(space)


def test_a_setting_is_searched_or_given_and_not_both():
    with pytest.raises(SettingError, match="it is given for all trials as well"):
        plan({"polyak_rate": WITH_LOG}, overrides={"polyak_rate": 0.01})


def test_a_file_that_is_not_there_or_no_toml_is_a_users_error(tmp_path):
    with pytest.raises(UserError, match="No such file"):
        read_space(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("discount = [")
    with pytest.raises(UserError, match="is not TOML"):
        read_space(tmp_path / "bad.toml")


def test_what_is_drawn_lies_in_the_space_and_is_read_back():
    space = changed_space(
        {},
        {"polyak_rate": WITH_LOG, "n_step": {"low": 1, "high": 5}, "hidden_layers": [[8], [8, 8]],
         "target_entropy": [None, -1.0]},
    )  # fmt: skip
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        trial = study.ask()
        settings = {name: suggested_value(trial, name, dimension) for name, dimension in space.items()}
        assert all(space[name].holds(value) for name, value in settings.items() if value is not None)
        assert isinstance(settings["n_step"], int)
        assert values_of(space, trial.params) == settings
    assert {str(values_of(space, trial.params)["hidden_layers"]) for trial in study.trials} == {"(8,)", "(8, 8)"}
