"""What a reward is made of: by hand, and on real environments."""

from __future__ import annotations

import numpy as np
import pytest

from saclab.environments.reward_terms import split_reward
from saclab.environments.vector import TrainingEnvironments
from saclab.errors import NonFiniteError, SettingError
from saclab.protocols import make_config
from saclab.training.engine import spec_of

TERMS = {
    "Ant-v4": ("reward_forward", "reward_ctrl", "reward_survive"),
    "Ant-v5": ("reward_forward", "reward_ctrl", "reward_contact", "reward_survive"),
    "HalfCheetah-v4": ("reward_run", "reward_ctrl"),
    "HalfCheetah-v5": ("reward_forward", "reward_ctrl"),
    "Hopper-v4": (),
    "Hopper-v5": ("reward_forward", "reward_ctrl", "reward_survive"),
    "Humanoid-v4": ("reward_linvel", "reward_quadctrl", "reward_alive"),
    "Humanoid-v5": ("reward_forward", "reward_ctrl", "reward_survive", "reward_contact"),
    "HumanoidStandup-v4": ("reward_linup", "reward_quadctrl", "reward_impact"),
    "HumanoidStandup-v5": ("reward_linup", "reward_quadctrl", "reward_impact"),
    "Swimmer-v4": ("reward_fwd", "reward_ctrl"),
    "Swimmer-v5": ("reward_forward", "reward_ctrl"),
    "Walker2d-v4": (),
    "Walker2d-v5": ("reward_forward", "reward_ctrl", "reward_survive"),
    "Pendulum-v1": (),
}
NOT_TOLD = {"HumanoidStandup-v4": 1.0, "HumanoidStandup-v5": 1.0}
"""What an environment adds to each step's reward without telling it: the remainder."""


def test_the_remainder_is_what_the_terms_leave():
    info = {"forward": 2.0, "control": np.float64(-0.5), "position": np.zeros(3)}
    assert split_reward("Some-v0", 4.0, info, ("forward", "control")) == (2.0, -0.5, 2.5)
    assert split_reward("Some-v0", 4.0, info, ()) == (4.0,)


def test_a_term_that_is_not_told_is_named_with_those_that_are():
    with pytest.raises(SettingError, match=r"reward_terms = .*walking.*it tells forward$"):
        split_reward("Some-v0", 1.0, {"forward": 2.0, "position": np.zeros(3)}, ("walking",))


@pytest.mark.parametrize(("named", "setting"), [((), "reward_schedule"), (("flying",), "reward_terms")])
def test_a_term_that_is_not_told_names_the_setting_it_comes_from(named, setting):
    changes = {"reward_terms": named, "reward_schedule": ("flying: 1@0",)}
    with pytest.raises(SettingError, match=f"^{setting} = 'flying': HalfCheetah-v4 does not tell it"):
        spec_of(make_config("HalfCheetah-v4", overrides=changes))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_a_term_that_is_not_finite_is_named(value):
    with pytest.raises(NonFiniteError, match="reward term forward"):
        split_reward("Some-v0", 1.0, {"forward": value}, ("forward",))


@pytest.mark.parametrize(("environment", "names"), TERMS.items())
def test_the_terms_of_real_environments_add_up_to_their_reward(environment, names):
    ours = TrainingEnvironments(environment, {}, [3, 4], names)
    plain = TrainingEnvironments(environment, {}, [3, 4])
    generator = np.random.default_rng(0)
    for _ in range(20):
        action = generator.uniform(-1, 1, (2, ours.spec.action_size)).astype(np.float32)
        terms, whole = ours.step(action)[0].reward_terms, plain.step(action)[0].reward_terms
        assert terms.shape == (2, len(names) + 1)
        rounding = (len(names) + 2) * 2**-24 * np.abs(terms).sum(axis=1)
        assert (np.abs(terms.sum(axis=1) - whole[:, 0]) <= rounding).all()
        if names:
            np.testing.assert_allclose(terms[:, -1], NOT_TOLD.get(environment, 0), atol=1e-5)
    for environments in (ours, plain):
        environments.close()
