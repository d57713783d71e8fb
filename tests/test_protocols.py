"""Where a setting of a run comes from: defaults < protocol < variant < what the user says."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from saclab.errors import SettingError, UserError
from saclab.protocols import PROTOCOLS, make_config
from saclab.variants import COMPARED, VARIANTS, Variant, variant_settings


@pytest.fixture
def row(monkeypatch):
    """`row(batch_size=8)`: a variant named "mine" that differs from plain SAC in these settings."""
    return lambda **settings: monkeypatch.setitem(VARIANTS, "mine", Variant("Mine", "", settings))


def test_a_variant_keeps_its_own_settings_under_every_protocol(row):
    row(batch_size=48, critic_learning_rate=1e-4)
    for protocol in PROTOCOLS:
        algorithm = make_config("HalfCheetah-v4", "mine", protocol).algorithm
        assert (algorithm.batch_size, algorithm.critic_learning_rate) == (48, 1e-4)
    assert make_config("HalfCheetah-v4", "mine", "quick").algorithm.actor_learning_rate == 1e-3


def test_a_variant_may_set_how_a_run_is_trained(row):
    row(updates_per_interval=20, update_interval=1, random_steps=5000)
    training = make_config("Humanoid-v4", "mine", "paper").training
    assert (training.update_to_data_ratio, training.random_steps) == (20, 5000)
    assert training.patience_episodes == 750
    assert variant_settings("mine", "Humanoid-v4") == variant_settings("sac", "Humanoid-v4")


@pytest.mark.parametrize(
    ("environment", "entropy", "dropout", "dropped"),
    [
        ("Hopper-v4", -1, 0.0001, 5),
        ("HalfCheetah-v4", -3, 0.01, 0),
        ("Walker2d-v4", -3, 0.005, 2),
        ("Humanoid-v4", -2, 0.1, 2),
        ("Pendulum-v1", None, 0.01, 2),
    ],
)
def test_redq_droq_and_tqc_follow_their_authors_by_environment(environment, entropy, dropout, dropped):
    for variant in ("redq", "droq"):
        config = make_config(environment, variant, "standard")
        assert (config.algorithm.target_entropy, config.algorithm.actor_interval) == (entropy, 20)
        assert (config.training.update_to_data_ratio, config.training.random_steps) == (20, 5000)
    assert config.algorithm.critic_dropout == dropout
    assert variant_settings("tqc", environment).dropped_quantiles == dropped


def test_fast_on_humanoid_is_standard_with_an_update_every_fifth_step():
    """What `benchmarks/time_to_score.py` measured there as "1:5"; where evaluations are made is no part of it."""
    often = {"evaluation_interval_steps": 5000, "evaluation_episodes": 5}
    fast = make_config("Humanoid-v4", "sac-auto", "fast", overrides=often)
    standard = make_config("Humanoid-v4", "sac-auto", "standard", overrides={"update_interval": 5, **often})
    assert dataclasses.replace(fast, protocol="standard") == standard
    assert make_config("HumanoidStandup-v4", "sac-auto", "fast").training.update_interval == 1


def test_a_quick_run_of_a_dear_variant_is_held_to_what_takes_minutes(row):
    dear = {"batch_size": 512, "critic_hidden_layers": (2048, 128), "actor_interval": 2, "updates_per_interval": 20}
    row(**dear)
    quick = make_config("HalfCheetah-v4", "mine", "quick")
    assert (quick.algorithm.batch_size, quick.algorithm.critic_hidden_layers) == (64, (256, 128))
    assert (quick.algorithm.actor_interval, quick.training.updates_per_interval) == (2, 1)
    for protocol, overrides in (("standard", {}), ("quick", dear)):
        config = make_config("HalfCheetah-v4", "mine", protocol, overrides=overrides)
        assert config.algorithm.critic_hidden_layers == (2048, 128)
        assert (config.algorithm.batch_size, config.training.updates_per_interval) == (512, 20)


def test_what_the_user_says_counts_for_more_than_the_variant(row):
    row(batch_size=32, random_steps=500, snapshots=3)
    config = make_config("HalfCheetah-v4", "mine", "quick", overrides={"batch_size": 16, "random_steps": 99})
    assert (config.algorithm.batch_size, config.training.random_steps) == (16, 99)
    assert config.algorithm.snapshots == 3


def test_the_temperature_of_an_environment_counts_for_least(row, monkeypatch):
    row(initial_temperature=0.7)
    assert make_config("Humanoid-v4", "sac").algorithm.initial_temperature == 0.1
    assert make_config("Humanoid-v4", "mine").algorithm.initial_temperature == 0.7
    warm = dataclasses.replace(PROTOCOLS["quick"], algorithm={"initial_temperature": 0.5})
    monkeypatch.setitem(PROTOCOLS, "quick", warm)
    assert make_config("Humanoid-v4", "sac", "quick").algorithm.initial_temperature == 0.5
    assert make_config("Humanoid-v4", "mine", "quick").algorithm.initial_temperature == 0.7


def test_a_setting_that_does_not_exist_is_refused_wherever_it_stands(row):
    row(batch_sise=3)
    with pytest.raises(UserError, match="did you mean 'batch_size'"):
        make_config("HalfCheetah-v4", "mine")
    with pytest.raises(UserError, match="did you mean 'discount'"):
        make_config("HalfCheetah-v4", "sac", overrides={"discout": 0.9})


def test_the_variants_of_a_comparison_exist():
    assert set(COMPARED) < set(VARIANTS)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"discount": "x"}, "discount = 'x': Expected `float`, got `str`"),
        ({"batch_size": 32.5}, "batch_size = 32.5: Expected `int`, got `float`"),
        ({"hidden_layers": 32}, "hidden_layers = 32: Expected `array`, got `int`"),
        ({"max_steps": "many"}, "max_steps = 'many': Expected `int | null`"),
    ],
)
def test_a_value_of_another_type_is_refused_in_words(settings, message):
    with pytest.raises(SettingError, match=re.escape(message)):
        make_config("Pendulum-v1", overrides=settings)
    with pytest.raises(SettingError, match="seed = 'a': Expected `int`"):
        make_config("Pendulum-v1", seed="a")


def test_numbers_of_numpy_and_lists_are_taken_as_their_type_has_them():
    changed = {
        "discount": np.float32(0.5),
        "batch_size": np.int64(8),
        "hidden_layers": [4, 4],
        "initial_temperature": 1,
    }
    algorithm = make_config("Pendulum-v1", overrides=changed).algorithm
    assert (algorithm.discount, algorithm.batch_size, algorithm.hidden_layers) == (0.5, 8, (4, 4))
    assert [type(algorithm.discount), type(algorithm.batch_size), type(algorithm.initial_temperature)] == [
        float,
        int,
        float,
    ]


@pytest.mark.parametrize("changes", [{"parallel_environments": 600}, {"parallel_environments": 2, "n_step": 300}])
def test_a_replay_buffer_holds_a_window_of_every_environment(changes):
    with pytest.raises(SettingError, match="replay_capacity = 512: use at least 600: n_step"):
        make_config("Pendulum-v1", "sac", "quick", overrides={"replay_capacity": 512, **changes})
