"""Paths stay where the user meant them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import saclab
from saclab.cli.main import parse
from saclab.cli.settings import with_absolute_paths
from saclab.errors import UserError
from saclab.files import absolute, same_directory

WANDERING = """
import os
import gymnasium
from gymnasium.envs.classic_control.pendulum import PendulumEnv

class Wandering(PendulumEnv):
    def step(self, action):
        os.chdir({elsewhere!r})
        return super().step(action)

gymnasium.register("Wandering-v0", Wandering, max_episode_steps=50)
"""


@pytest.mark.parametrize(
    "line",
    [
        ("train", "Pendulum-v1", "--runs", "r"), ("compare", "Pendulum-v1", "--runs", "r", "--report", "p"),
        ("reproduce", "--runs", "r", "--report", "p"), ("resume", "r"), ("evaluate", "r"),
        ("record", "r", "--video", "v.mp4"), ("report", "r", "s", "--out", "o"),
    ],
)  # fmt: skip
def test_every_path_of_a_line_becomes_absolute(tmp_path, monkeypatch, line):
    monkeypatch.chdir(tmp_path)
    told = repr(with_absolute_paths(parse(line)))
    found = [part.split("'")[1] for part in told.split("Path(")[1:]]
    assert found
    assert all(path.startswith(str(tmp_path)) for path in found), found


def test_a_removed_working_directory_is_told(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert absolute(tmp_path) == tmp_path
    with pytest.raises(UserError, match="runs: the working directory does not exist"):
        absolute("runs")
    monkeypatch.chdir(tmp_path)


def test_a_look_at_an_environment_leaves_the_directory_as_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    with same_directory():
        os.chdir("other")
    assert Path.cwd() == tmp_path


def test_a_run_whose_environment_wanders_lies_in_one_place(tmp_path, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "wandering.py").write_text(WANDERING.format(elsewhere=str(elsewhere)))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    record = saclab.train(
        "wandering:Wandering-v0", protocol="quick", runs="runs", hidden_layers=(4,), batch_size=8, random_steps=60,
        max_updates=4, evaluation_interval_steps=60, evaluation_episodes=1,
    )  # fmt: skip
    assert record.result is not None
    assert record.path.is_relative_to(tmp_path / "runs")
    assert list((record.path / "checkpoints").glob("step-*"))
    assert list(elsewhere.iterdir()) == []
