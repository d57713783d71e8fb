"""A real full disk: a small file system in memory, where this user may mount one."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from saclab.errors import TrainingFailed
from saclab.training import loop
from saclab.training.checkpoint import newest_first

from .helpers import assert_same_run, finish, small_config, stop_at


def mount(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["mount", "-t", "tmpfs", *arguments], capture_output=True, text=True)


@pytest.fixture
def small_disk(tmp_path):
    """A folder that holds a megabyte."""
    folder = tmp_path / "disk"
    folder.mkdir()
    try:
        mounted = mount("-o", "size=1m", "tmpfs", str(folder))
    except FileNotFoundError:
        pytest.skip("there is no mount command here")
    if mounted.returncode != 0:
        pytest.skip(f"this user may not mount a file system in memory: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def fill(folder: Path, spare: int) -> Path:
    """A file that leaves so many bytes of the disk free."""
    free = os.statvfs(folder).f_bavail * os.statvfs(folder).f_frsize
    (folder / "filler").write_bytes(bytes(max(0, free - spare)))
    return folder / "filler"


NO_LOG = r"cannot write to .*No space left on device; what was saved is kept: make room.*saclab resume"
NO_CHECKPOINT = r"the disk is full\. The last good checkpoint, step-0+130, is kept; make room.*saclab resume"


@pytest.mark.parametrize(
    ("spare", "message"),
    [(0, NO_LOG), (5_000, NO_CHECKPOINT), (30_000, NO_CHECKPOINT)],
    ids=["before its first file", "in the middle", "near its end"],
)
def test_a_full_disk_keeps_the_last_good_checkpoint_and_says_what_to_do(small_disk, tmp_path, spare, message):
    config, straight, folder = small_config("Pendulum-v1"), tmp_path / "straight", small_disk / "run"
    finish(config, straight)
    stop_at(100, config, folder)
    stop_at(130, config, folder)
    filler = fill(small_disk, spare)
    before = newest_first(folder / "checkpoints")
    for _ in range(2):  # starting again does no harm either
        with pytest.raises(TrainingFailed, match=message):
            list(loop.train(config, folder, checkpoint_minutes=0))
        assert newest_first(folder / "checkpoints") == before
        assert not list((folder / "checkpoints").glob("*.partial"))
    filler.unlink()
    assert finish(config, folder)[0].resumed_at_step == 130
    assert_same_run(straight, folder)
