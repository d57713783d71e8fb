"""One process at a time, other versions and machines, environments that cannot be captured: told and recorded."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from environments import tiny  # noqa: F401 - registers them
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

from saclab.environments.make import make_environment
from saclab.environments.simulator import capture_mujoco, capture_state, restore_mujoco
from saclab.errors import UserError
from saclab.machine import machine_facts, visible_threads
from saclab.training import local_engine, loop
from saclab.training.checkpoint import CheckpointError, newest_first
from saclab.training.events import Saved, Started, Warned
from saclab.training.lock import locked
from saclab.training.run_folder import read_config

from .helpers import finish, lines_of, small_config, stop_at
from .stage import SECOND, newest, sign

HOLD = """
import sys, time
from pathlib import Path
from saclab.training.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_with_the_id_of_the_first(tmp_path):
    """The lock of a dead one is taken over."""
    first = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert first.stdout is not None
        assert first.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=f"in use by process {first.pid}"), locked(tmp_path):
            pass
    finally:
        first.kill()
        first.wait()
    assert (tmp_path / "lock").read_text() == str(first.pid), "it is stale"
    with locked(tmp_path):
        assert (tmp_path / "lock").read_text() == str(os.getpid())


def test_a_run_in_use_is_not_touched(stage, folder):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}
    with locked(folder), pytest.raises(UserError, match="in use by this process"):
        stage.continue_from(folder)
    assert {path: path.read_bytes() for path in before} == before


# --- versions and machines


def pretend(folder: Path, part: str, **facts: object) -> None:
    """Let the newest checkpoint have been made by other versions or on another machine."""
    manifest = json.loads((newest(folder) / "manifest.json").read_text())
    manifest["state"]["facts"][part] |= facts
    sign(newest(folder), manifest)


@pytest.mark.parametrize("name", ["jax", "jaxlib", "saclab", "numpy", "optax", "python"])
def test_another_version_is_told_and_recorded(stage, folder, name):
    pretend(folder, "versions", **{name: "0.0.1"})
    started = stage.continue_from(folder)
    assert started.resumed_at_step == SECOND
    notes = started.notes[1:]
    assert len(notes) == 1
    assert f"{name} was 0.0.1 when the checkpoint was made and is {machine_facts()['versions'][name]} now" in notes[0]
    assert "results may differ in the last bits" in notes[0]
    assert lines_of(folder / "sessions.jsonl")[-1]["notes"] == list(notes)


@pytest.mark.parametrize("name", ["mujoco", "gymnasium"])
def test_a_run_does_not_go_on_in_another_simulation(stage, folder, name):
    """It would be half of one task and half of another; a smaller step in the version is told as any other."""
    now = machine_facts()["versions"][name]
    same = now.partition(".")[0] + ".999"
    pretend(folder, "versions", **{name: same})
    assert f"{name} was {same}" in stage.continue_from(folder).notes[1]
    pretend(folder, "versions", **{name: "0.9.1"})
    with pytest.raises(UserError, match=rf"{name} was 0\.9\.1 .* is {now} now, .*pip install '{name}==0\.9\.1', or"):
        stage.continue_from(folder)


@pytest.mark.parametrize(
    ("name", "before", "way_out"),
    [
        ("threads", 64, "--threads 64 (or NPROC=64"),
        ("numpy_threads", 64, "OPENBLAS_NUM_THREADS=64"),
        ("xla_flags", "--xla_something", "XLA_FLAGS='--xla_something'"),
        ("processor", "Another One", "processor was Another One"),
    ],
)
def test_another_machine_is_told_with_the_setting_to_use(stage, folder, name, before, way_out):
    pretend(folder, "machine", **{name: before})
    started = stage.continue_from(folder)
    assert len(started.notes) == 2
    assert way_out in started.notes[1]
    assert lines_of(folder / "sessions.jsonl")[-1]["notes"] == [started.notes[1]]


def test_a_checkpoint_without_facts_is_read(stage, folder):
    """It comes from before a fact was recorded."""
    manifest = json.loads((newest(folder) / "manifest.json").read_text())
    del manifest["state"]["facts"]["machine"]["numpy_threads"]
    sign(newest(folder), manifest)
    assert "numpy_threads was not recorded" in stage.continue_from(folder).notes[1]


def test_the_same_machine_has_nothing_to_tell(stage, folder):
    assert len(stage.continue_from(folder).notes) == 1


def test_threads_are_those_of_the_environment_if_it_names_some(monkeypatch):
    monkeypatch.setenv("NPROC", "3")
    assert visible_threads("NPROC") == 3


@pytest.mark.parametrize("value", ["", "many", "0", "-2"])
def test_threads_are_as_many_as_cores_if_the_environment_names_none(monkeypatch, value):
    monkeypatch.setenv("NPROC", value)
    assert visible_threads("NPROC") == len(os.sched_getaffinity(0))


@pytest.mark.parametrize("number", [0, 5, "1", None, 10**30])
def test_another_format_is_told_in_words(stage, folder, number):
    for path in newest_first(folder / "checkpoints"):
        manifest = json.loads((path / "manifest.json").read_text())
        sign(path, manifest | {"format": number})
    words = f"it has format {number!r}, .* reads formats 1 to 4" if isinstance(number, int) else "Expected `int`, got"
    with pytest.raises(CheckpointError, match=words):
        stage.continue_from(folder)


GOLDEN = Path(__file__).with_name("golden") / "format-1"


def test_a_checkpoint_of_format_1_is_still_read_and_continues(tmp_path):
    """The folder was written by the first version; it must be readable for ever."""
    folder = Path(shutil.copytree(GOLDEN, tmp_path / "run"))
    events = finish(read_config(folder), folder)
    assert isinstance(events[0], Started)
    assert events[0].resumed_at_step == 120
    assert any("format 1, of an earlier saclab" in note for note in events[0].notes)
    result = json.loads((folder / "result.json").read_text())
    assert (result["steps"], result["updates"]) == (150, 45)
    assert lines_of(folder / "metrics.jsonl")[:4] == lines_of(GOLDEN / "metrics.jsonl")


# --- environments that cannot be captured


def test_an_environment_that_cannot_be_captured_starts_a_new_episode(tmp_path):
    """That is told and recorded."""
    config = small_config("Counting-v0", environments=2, hidden_layers=(8,))
    stop_at(123 + 1, config, tmp_path)
    events = finish(config, tmp_path)
    started, rest = events[0], events[1:]
    told = [note for note in started.notes if "cannot be captured" in note]
    assert len(told) == 1
    assert "environments [0, 1] started a new episode" in told[0]
    assert not any(isinstance(event, Warned) for event in rest)
    assert [line["notes"] for line in lines_of(tmp_path / "sessions.jsonl")] == [[], told]


def test_its_new_episode_is_not_the_first_one_again(tmp_path, monkeypatch):
    """Otherwise a run that is stopped often would see the same start over and over."""
    config = small_config("Counting-v0", environments=2, hidden_layers=(8,))
    starts, real = [], local_engine.restored_environments

    def restored(start):
        environments = real(start)
        if start.environments is not None:
            starts.append(environments.observation[:, 2].tolist())
        return environments

    monkeypatch.setattr(local_engine, "restored_environments", restored)
    for step in (62, 64, 66, 68):
        stop_at(step, config, tmp_path)
    numbers = [number for start in starts for number in start]
    assert len(set(numbers)) == len(numbers) == 6


class Weather(HopperEnv):
    """A MuJoCo environment that keeps more than the simulator does."""

    wind = 0.0

    def step(self, action: np.ndarray) -> tuple:
        self.wind += 1
        return super().step(action)


class OpenWeather(Weather):
    """The same, which tells."""

    def saclab_capture(self) -> dict[str, np.ndarray]:
        return {"wind": np.array(self.wind), **capture_mujoco(self)}

    def saclab_restore(self, state: dict[str, np.ndarray]) -> None:
        self.wind = float(state["wind"])
        restore_mujoco(self, state)


gymnasium.register("Weather-v0", Weather, max_episode_steps=100)
gymnasium.register("OpenWeather-v0", OpenWeather, max_episode_steps=100)


def test_a_subclass_may_keep_more_than_saclab_knows_of_unless_it_says_what():
    environment = make_environment("Weather-v0")
    environment.reset(seed=0)
    assert capture_state(environment) is None
    telling = make_environment("OpenWeather-v0")
    telling.reset(seed=0)
    state = capture_state(telling)
    assert state is not None
    assert set(state["physics"]) == {"wind", "integration", "xpos", "xipos", "subtree_com"}


@pytest.mark.parametrize("wrapper", [gymnasium.wrappers.ClipAction, gymnasium.wrappers.FlattenObservation])
def test_wrappers_without_a_state_are_no_hindrance(wrapper):
    environment = wrapper(make_environment("Pendulum-v1"))
    environment.reset(seed=0)
    assert capture_state(environment) is not None

    class Subclass(wrapper):
        """It might keep something."""

    other = Subclass(make_environment("Pendulum-v1"))
    other.reset(seed=0)
    assert capture_state(other) is None


def test_checkpoints_are_taken_every_so_many_minutes(tmp_path):
    config = small_config("Pendulum-v1", random_steps=32, max_steps=36)
    saved = [event for event in loop.train(config, tmp_path, checkpoint_minutes=0) if isinstance(event, Saved)]
    assert len({event.checkpoint for event in saved}) == 37, "before the first step and after each"
    assert [path.name[-2:] for path in newest_first(tmp_path / "checkpoints")] == ["36", "35"]
