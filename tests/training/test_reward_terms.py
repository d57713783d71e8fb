"""Reward terms of a run: refused before anything is written, learned from with their weights."""

from __future__ import annotations

import json
from contextlib import closing

import numpy as np
import pytest
from batch.helpers import failures, tiny_environments

import saclab
from saclab.batch.loop import train_batch
from saclab.errors import RunBroken, SettingError
from saclab.protocols import make_config
from saclab.training.local_engine import LocalEngine
from saclab.training.loop import train

SMALL = {"hidden_layers": (8,), "batch_size": 16, "random_steps": 40, "max_steps": 60}


def test_a_term_that_is_not_told_is_refused_before_the_folder_is_made(tmp_path):
    with pytest.raises(SettingError, match=r"reward_terms = 'walking': HalfCheetah-v4 does not tell it .*reward_run"):
        saclab.train("HalfCheetah-v4", runs=tmp_path, reward_terms=["walking"], **SMALL)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("together", [False, True], ids=["alone", "in a group"])
def test_a_term_that_is_told_no_more_ends_the_run(tmp_path, together, monkeypatch):
    with tiny_environments(monkeypatch) as prefix:
        config = make_config(
            prefix + "Reticent-v0", "sac", environment_arguments={"told": 30},
            overrides={**SMALL, "reward_terms": ("left",)},
        )  # fmt: skip
        if together:
            (message,) = failures(list(train_batch([config], [tmp_path], workers=1))).values()
        else:
            with pytest.raises(RunBroken) as caught:
                list(train(config, tmp_path))
            message = str(caught.value)
    assert "reward term 'left'" in message
    assert "though it did in the first step" in message
    assert json.loads((tmp_path / "failure/failure.json").read_text())["counters"]["steps"] == 30


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
