"""Reward terms of a run: refused before anything is written, learned from with their weights."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

import saclab
from saclab.errors import SettingError
from saclab.protocols import make_config
from saclab.training.local_engine import LocalEngine

SMALL = {"hidden_layers": (8,), "batch_size": 16, "random_steps": 40, "max_steps": 60}


def test_a_term_that_is_not_told_is_refused_before_the_folder_is_made(tmp_path):
    with pytest.raises(SettingError, match=r"reward_terms = 'walking': HalfCheetah-v4 does not tell it .*reward_run"):
        saclab.train("HalfCheetah-v4", runs=tmp_path, reward_terms=["walking"], **SMALL)
    assert list(tmp_path.iterdir()) == []


def test_the_terms_are_stored_as_they_came_whatever_their_weights():
    overrides = {"reward_terms": ("reward_run", "reward_ctrl"), "reward_weights": (0.0, 3.0), **SMALL}
    weighted = make_config("HalfCheetah-v4", "sac", overrides=overrides)
    plain = make_config("HalfCheetah-v4", "sac", overrides=SMALL)
    with closing(LocalEngine.new(weighted)) as ours, closing(LocalEngine.new(plain)) as theirs:
        for _ in range(40):  # random steps: the same actions
            ours.step()
            theirs.step()
        terms, rewards = (
            engine.replay.layout.unpack(engine.replay.rows[:40]).reward_terms for engine in (ours, theirs)
        )
        assert terms.shape == (40, 3)
        np.testing.assert_allclose(terms.sum(axis=1), rewards[:, 0], rtol=1e-4, atol=1e-5)
        assert ours.context.reward_weights.tolist() == [0.0, 3.0, 1.0]
