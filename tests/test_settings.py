"""The settings that are names: a wrong one is refused, and each known one has something to stand for."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from saclab.algorithm.heads import HEADS
from saclab.algorithm.learner import UPDATES
from saclab.algorithm.losses import FACTORS
from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.network import ACTIVATIONS, INITIALISATIONS, PROJECTIONS
from saclab.algorithm.networks.normalised_inputs import INPUT_NORMALISATIONS
from saclab.algorithm.optimizer import SCHEDULES
from saclab.algorithm.policy import BOUNDINGS
from saclab.algorithm.scalars import ELSEWHERE, pack, scalars, unpack
from saclab.algorithm.targets import REDUCTIONS, TARGET_REDUCTIONS
from saclab.errors import SettingError
from saclab.settings import UPDATES as UPDATE_NAMES
from saclab.settings import AlgorithmSettings, choices, plain_numbers, structure
from saclab.training.reward_scale import SCALES

TABLES = {
    "network": NETWORKS,
    "critic_network": NETWORKS,
    "critic_head": HEADS,
    "activation": ACTIVATIONS,
    "target_reduction": TARGET_REDUCTIONS,
    "actor_reduction": REDUCTIONS,
    "learning_rate_schedule": SCHEDULES,
    "temperature_gradient": FACTORS,
    "weight_projection": PROJECTIONS,
    "initialisation": INITIALISATIONS,
    "log_std_bounding": BOUNDINGS,
    "observation_normalisation": INPUT_NORMALISATIONS,
    "reward_scaling": SCALES,
}
"""Setting -> what its names stand for. `settings.py` imports no numerical library, so the names are written twice."""
NO_TABLE = {"temperature", "critic_mode_for_actor"}  # two learning rates, two functions of a network


@pytest.mark.parametrize("setting", TABLES)
def test_the_names_of_a_setting_are_those_of_its_table(setting):
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


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"target_critics": 3}, "target_critics = 3: use at most the number of critics, 2"),
        ({"target_critics": 0}, "target_critics = 0: use a whole number of at least 1"),
        ({"target_reduction": "truncated"}, "target_reduction = 'truncated': use it with critic_head quantile"),
        (
            {"target_reduction": "truncated", "critic_head": "quantile", "critic_atoms": 5, "dropped_quantiles": 5},
            "dropped_quantiles = 5: use fewer than critic_atoms, 5",
        ),
        ({"critic_dropout": 0.1}, "critic_dropout = 0.1: use critic_network layer_norm_mlp: mlp has no dropout"),
        (
            {"critic_dropout": 1.0, "network": "layer_norm_mlp"},
            "critic_dropout = 1.0: use 0, or a value from",
        ),
        (
            {"initialisation": "xavier", "network": "batch_norm_mlp"},
            "use network: batch_norm_mlp starts in",
        ),
        ({"critic_head": "quantile", "entropy_window": 10}, "use 1 together with critic_head quantile"),
        ({"critic_network": "batch_norm_mlp", "batch_size": 1}, "use at least 2 with batch_norm_mlp"),
        ({"actor_interval": 5_000_000_000}, "use whole numbers of at most 2147483647"),
    ],
)
def test_critics_that_cannot_be_are_refused_with_the_way_out(settings, said):
    with pytest.raises(SettingError, match=said):
        AlgorithmSettings(**settings)


def test_only_a_setting_that_may_be_left_out_can_be_none():
    assert AlgorithmSettings(critic_network=None).network_of_critic == "mlp"
    with pytest.raises(SettingError, match="network = None"):
        AlgorithmSettings(network=None)


def test_every_plain_number_is_an_argument_of_the_update():
    """One that is not would silently have its default in all that is compiled."""
    assert plain_numbers()
    assert set(plain_numbers()) - set(ELSEWHERE) == set(scalars(AlgorithmSettings(), 1)) - {"planned_updates"}
    changed = AlgorithmSettings(discount=0.5, snapshot_interval=7, adam_beta_1=0.25, target_entropy=-9.0)
    numbers = scalars(changed, 3)
    assert (numbers["discount"], numbers["snapshot_interval"], numbers["adam_beta_1"]) == (0.5, 7, 0.25)
    assert (numbers["target_entropy"], scalars(AlgorithmSettings(), 3)["target_entropy"]) == (-9, -3)
    assert scalars(AlgorithmSettings(target_entropy_per_action=-0.5), 3)["target_entropy"] == -1.5
    assert numbers["snapshot_interval"].dtype == "int32"
    assert {name: (value, value.dtype) for name, value in unpack(jnp.asarray(pack(numbers))).items()} == {
        name: (value, value.dtype) for name, value in numbers.items()
    }


def test_two_ways_to_say_the_same_structure_are_one():
    said = AlgorithmSettings(critic_hidden_layers=(256, 256), critic_network="mlp", discount=0.5)
    assert structure(said) == structure(AlgorithmSettings())


def test_lists_are_as_good_as_tuples():
    settings = AlgorithmSettings(hidden_layers=[8], reward_terms=["a"], reward_weights=[2.0])
    assert settings == AlgorithmSettings(hidden_layers=(8,), reward_terms=("a",), reward_weights=(2.0,))
    assert hash(settings)
