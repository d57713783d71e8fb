"""The settings that are names: a wrong one is refused, and each known one has something to stand for."""

from __future__ import annotations

import pytest

from saclab.algorithm.heads import HEADS
from saclab.algorithm.learner import UPDATES
from saclab.algorithm.losses import FACTORS
from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.network import ACTIVATIONS
from saclab.algorithm.optimizer import SCHEDULES
from saclab.algorithm.targets import REDUCTIONS
from saclab.errors import SettingError
from saclab.settings import UPDATES as UPDATE_NAMES
from saclab.settings import AlgorithmSettings, choices

TABLES = {
    "network": NETWORKS,
    "critic_network": NETWORKS,
    "critic_head": HEADS,
    "activation": ACTIVATIONS,
    "target_reduction": REDUCTIONS,
    "actor_reduction": REDUCTIONS,
    "learning_rate_schedule": SCHEDULES,
    "temperature_gradient": FACTORS,
}
"""Setting -> what its names stand for. `settings.py` imports no numerical library, so the names are written twice."""
NO_TABLE = {"temperature", "weight_projection", "reward_scaling"}


@pytest.mark.parametrize("setting", choices())
def test_the_names_of_a_setting_are_those_of_its_table(setting):
    if setting in NO_TABLE:
        return
    names = set(choices()[setting]) - {None}
    missing, unnamed = sorted(names - TABLES[setting].keys()), sorted(TABLES[setting].keys() - names)
    assert not missing, f"{setting}: settings.py names {missing}, and its table has no such entry"
    assert not unnamed, f"{setting}: its table has {unnamed}, which the Literal in settings.py does not name"


def test_the_parts_of_an_update_are_those_that_the_settings_name():
    assert set(UPDATES) == set(UPDATE_NAMES)


def test_the_choices_are_those_of_the_hints():
    assert choices()["reward_scaling"] == ("none", "deviation", "deviation_or_bound")
    assert choices()["critic_network"] == (*choices()["network"], None)
    assert choices().keys() == TABLES.keys() | NO_TABLE


@pytest.mark.parametrize("setting", choices())
def test_a_name_that_is_not_known_is_refused_with_those_that_are(setting):
    with pytest.raises(SettingError, match=rf"{setting} = 'no such': use one of {choices()[setting][0]}, "):
        AlgorithmSettings(**{setting: "no such"})


def test_only_a_setting_that_may_be_left_out_can_be_none():
    assert AlgorithmSettings(critic_network=None).network_of_critic == "mlp"
    with pytest.raises(SettingError, match="network = None"):
        AlgorithmSettings(network=None)
