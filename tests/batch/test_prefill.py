"""Runs of a group that begin with other experience are those that they would be alone, stopped or not."""

from __future__ import annotations

import shutil

import gymnasium
import numpy as np
import pytest
from environments.recorded import record
from resume.helpers import assert_same_run, finish, small_config

from saclab.replay import ReplayBuffer, RowLayout
from saclab.training import loop
from saclab.training.checkpoint import newest_first, read_checkpoint
from saclab.training.run_folder import read_run

from .helpers import folders, mixed, stop_at, train


@pytest.fixture
def source(tmp_path, monkeypatch):
    """Kind -> the prefill; all of it lies in one folder."""
    folder = tmp_path / "source"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    record("pendulum/random-v0", gymnasium.make("Pendulum-v1"), 110, episode=40)
    finish(small_config("Pendulum-v1", "sac"), folder / "run")
    return {"minari": "minari:pendulum/random-v0", "policy": f"policy:{folder / 'run'}"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["minari", "policy"])
def test_a_prefilled_group_is_that_of_runs_alone_and_goes_on(source, tmp_path, kind):
    configs = mixed(prefill=source[kind], update_interval=7, parallel_environments=2, replay_capacity=400)
    train(tmp_path / "straight", configs)
    stop_at(40, tmp_path / "stopped", configs)
    list(loop.train(configs[0], tmp_path / "alone"))
    shutil.rmtree(tmp_path / "source")
    train(tmp_path / "stopped", configs)
    straight = folders(tmp_path / "straight", configs)
    for ours, theirs in zip(straight, folders(tmp_path / "stopped", configs), strict=True):
        assert_same_run(ours, theirs)
    alone, grouped = read_run(tmp_path / "alone"), read_run(straight[0])
    assert alone.prefill == grouped.prefill
    np.testing.assert_allclose(alone.evaluations["returns"], grouped.evaluations["returns"], rtol=1e-3)
    before_updates = alone.prefill.transitions + 60  # those that it began with, and the random steps
    ours, theirs = (rows_of(folder, configs[0])[:before_updates] for folder in (tmp_path / "alone", straight[0]))
    assert ours.tobytes() == theirs.tobytes()


def rows_of(folder, config):
    buffer = ReplayBuffer(config.training.replay_capacity, RowLayout(3, 1))
    read_checkpoint(newest_first(folder / "checkpoints")[0], buffer)
    return buffer.rows
