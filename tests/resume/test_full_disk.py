"""A real full disk: a small file system in memory, where this user may mount one."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from saclab.errors import TrainingFailed
from saclab.training import loop
from saclab.training.checkpoint import newest_first

from .helpers import assert_same_run, finish, small_config


def mount(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["mount", "-t", "tmpfs", *arguments], capture_output=True, text=True)


@pytest.fixture
def small_disk(tmp_path):
    """A folder that holds 300 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    try:
        mounted = mount("-o", "size=300k", "tmpfs", str(folder))
    except FileNotFoundError:
        pytest.skip("there is no mount command here")
    if mounted.returncode != 0:
        pytest.skip(f"this user may not mount a file system in memory: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_keeps_the_last_good_checkpoint_and_says_what_to_do(small_disk, tmp_path):
    """The replay buffer grows until a third checkpoint has no room beside the two that are kept."""
    config = small_config(
        "Pendulum-v1", replay_capacity=10_000, max_steps=2_600, evaluation_interval_steps=2_000, update_interval=100
    )
    straight, folder = tmp_path / "straight", small_disk / "run"
    finish(config, straight)
    with pytest.raises(TrainingFailed) as error:
        list(loop.train(config, folder, checkpoint_minutes=0))
    kept = newest_first(folder / "checkpoints")
    assert len(kept) == 2
    assert not list(Path(folder / "checkpoints").glob("*.partial"))
    message = str(error.value)
    assert "the disk is full" in message
    assert f"The last good checkpoint, {kept[0].name}, is kept" in message
    assert f"make room, then continue with: saclab resume {folder}" in message

    with pytest.raises(TrainingFailed, match=r"full|No space"):  # still no room: nothing is lost
        list(loop.train(config, folder, checkpoint_minutes=0))
    assert newest_first(folder / "checkpoints")[0].name >= kept[0].name

    assert mount("-o", "remount,size=20m", "tmpfs", str(small_disk)).returncode == 0
    resumed = finish(config, folder)
    assert resumed[0].resumed_at_step >= int(kept[0].name.removeprefix("step-"))
    assert_same_run(straight, folder)
