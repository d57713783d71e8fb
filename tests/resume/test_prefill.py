"""A run that began with other experience goes on bit for bit, though that has gone meanwhile."""

from __future__ import annotations

import shutil
from contextlib import closing

import gymnasium
import pytest
from environments.recorded import record

from saclab.replay import RowLayout
from saclab.training import checkpoint, loop
from saclab.training.events import Saved, Started
from saclab.training.guide import guide_from
from saclab.training.manifest import CheckpointError, newest_first, read_manifest

from .helpers import (
    STEPS,
    assert_same_run,
    finish,
    kill,
    run,
    settings,
    small_config,
    start,
    stop_at,
    vanish_after,
    wait_for,
)

CHANGES = {"reward_scaling": "deviation", "observation_normalisation": "running", "n_step": 3, "longest_noise": 4}


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """Where data sets lie; a checkpoint has several segments."""
    monkeypatch.setattr(checkpoint, "SEGMENT_ROWS", 40)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "shelf"))
    record("pendulum/random-v0", gymnasium.make("Pendulum-v1"), 110, episode=40)
    return tmp_path / "shelf"


@pytest.fixture
def other(tmp_path):
    finish(small_config("Pendulum-v1", "sac"), tmp_path / "other")
    return tmp_path / "other"


def assert_exact(config, source, folder) -> None:
    """Stopped before its first step, in the random steps and after them, and vanished once, its source gone."""
    finish(config, folder / "straight")
    broken = folder / "broken"
    with closing(loop.train(config, broken)) as events:
        assert isinstance(next(events), Started)  # and it is killed
    stop_at(3, config, broken)
    shutil.rmtree(source)
    stop_at(60 - 60 % 3, config, broken)
    vanish_after(STEPS // 2, config, broken)
    finish(config, broken)
    assert_same_run(folder / "straight", broken)


@pytest.mark.parametrize("environments", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_a_run_with_a_data_set_goes_on_without_it(shelf, tmp_path, environments):
    config = small_config(
        "Pendulum-v1", "sac", environments, prefill="minari:pendulum/random-v0", prefill_transitions=97, **CHANGES
    )
    assert_exact(config, shelf, tmp_path)
    manifest = read_manifest(newest_first(tmp_path / "broken" / "checkpoints")[0])
    assert (manifest.replay.added, manifest.state["prefilled"]) == (97 + STEPS, 97)


def test_a_run_with_anothers_replay_goes_on_without_it(other, tmp_path):
    assert_exact(small_config("Pendulum-v1", "sac", prefill=f"replay:{other}", random_steps=5), other, tmp_path)


def test_a_run_with_anothers_policy_goes_on_without_it(other, tmp_path):
    """As long as the random steps last, the policy is in the checkpoints; then it is in none."""
    config = small_config("Pendulum-v1", "sac", 3, prefill=f"policy:{other}", random_steps=90, **CHANGES)
    assert_exact(config, other, tmp_path)
    manifest = read_manifest(newest_first(tmp_path / "broken" / "checkpoints")[0])
    assert manifest.state["guide"] is None
    assert "guide.safetensors" not in manifest.files


def test_a_damaged_policy_in_a_checkpoint_is_refused():
    with pytest.raises(CheckpointError, match="has nothing for the first steps"):
        guide_from({}, {}, RowLayout(3, 1))
    with pytest.raises(CheckpointError, match=r"settings of the policy of the first steps: .*no_such"):
        guide_from({"no_such": 1}, {}, RowLayout(3, 1))


def test_a_checkpoint_before_the_first_step_holds_the_data(shelf, tmp_path):
    config = small_config("Pendulum-v1", "sac", prefill="minari:pendulum/random-v0")
    with closing(loop.train(config, tmp_path / "run", checkpoint_minutes=0)) as events:
        saved = next(event for event in events if isinstance(event, Saved))
    assert saved.checkpoint.name == "step-000000000000"
    assert read_manifest(saved.checkpoint).replay.added == 110


@pytest.mark.slow
def test_a_killed_process_goes_on_without_the_data_set(shelf, tmp_path):
    """`kill -9` after the first checkpoint, then `saclab resume` in a process that knows of no data set."""
    words = ["train", "Pendulum-v1", "--variant", "sac", *settings(max_steps=2000),
             "--prefill", "minari:pendulum/random-v0"]  # fmt: skip
    run(tmp_path, *words, "--runs", "straight")
    process = start(tmp_path, *words, "--runs", "broken", "--checkpoint-minutes", "0.001")
    folder = tmp_path / "broken" / "Pendulum-v1" / "sac" / "standard" / "seed-0"
    wait_for(lambda: len(newest_first(folder / "checkpoints")) == 2)
    kill(process)
    assert not (folder / "result.json").exists()
    shutil.rmtree(shelf)
    run(tmp_path, "resume", str(folder))
    assert_same_run(tmp_path / "straight" / folder.relative_to(tmp_path / "broken"), folder)
