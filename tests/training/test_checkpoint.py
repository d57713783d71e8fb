"""Checkpoints are exact, survive damage and a full disk, and share no file with each other."""

from __future__ import annotations

import errno
import json
import shutil

import numpy as np
import pytest

from saclab.environments.vector import Transitions
from saclab.replay import ReplayBuffer, RowLayout
from saclab.training import checkpoint as checkpoints
from saclab.training.checkpoint import (
    Checkpoint,
    CheckpointError,
    newest_first,
    save_checkpoint,
)
from saclab.training.common_checkpoint import load_newest_checkpoint
from saclab.training.manifest import Moment

LAYOUT = RowLayout(2, 1)
CAPACITY = 50  # not a multiple of the segments' length


@pytest.fixture(autouse=True)
def short_segments(monkeypatch):
    monkeypatch.setattr(checkpoints, "SEGMENT_ROWS", 8)


def fill(replay: ReplayBuffer, count: int) -> None:
    """Add `count` transitions whose numbers tell which they are."""
    numbers = np.arange(replay.added, replay.added + count, dtype=np.float32)[:, None]
    replay.add(Transitions(numbers.repeat(2, 1), numbers, numbers, -numbers.repeat(2, 1), numbers[:, 0] % 2 == 0))


def content(step: int) -> Checkpoint:
    learner = {".actor": np.full(5, step, np.float32), ".step": np.array(step, np.int32)}
    return Checkpoint({"learner": learner}, {"counters": {"steps": step}, "big": 2**127 + step})


def save(folder, step: int, replay: ReplayBuffer):
    return save_checkpoint(folder, Moment(step), content(step), replay)


def load(folder) -> tuple[Checkpoint | None, ReplayBuffer, list[str]]:
    """The newest checkpoint, a fresh buffer, full of other numbers before, and the warnings."""
    replay, warnings = ReplayBuffer(CAPACITY, LAYOUT), []
    replay.rows[:] = 999
    return load_newest_checkpoint(folder, replay, warnings.append), replay, warnings


def assert_loads(folder, step: int, expected: ReplayBuffer) -> None:
    loaded, replay, warnings = load(folder)
    assert warnings == []
    assert_is(loaded, replay, step, expected)


def assert_is(loaded, replay, step, expected) -> None:
    assert loaded.state == content(step).state
    for name, array in content(step).groups["learner"].items():
        np.testing.assert_array_equal(loaded.groups["learner"][name], array)
        assert loaded.groups["learner"][name].dtype == array.dtype
    assert (replay.added, replay.size) == (expected.added, expected.size)
    np.testing.assert_array_equal(replay.rows[: replay.size], expected.rows[: expected.size])


def copy_of(replay: ReplayBuffer) -> ReplayBuffer:
    copied = ReplayBuffer(CAPACITY, LAYOUT)
    copied.rows[:], copied.added = replay.rows, replay.added
    return copied


def two_checkpoints(folder) -> tuple[ReplayBuffer, ReplayBuffer]:
    """Steps 20 and 30, with the buffer as it was at each."""
    replay = ReplayBuffer(CAPACITY, LAYOUT)
    fill(replay, 20)
    save(folder, 20, replay)
    first = copy_of(replay)
    fill(replay, 10)
    save(folder, 30, replay)
    return first, replay


def test_without_a_checkpoint_there_is_nothing_to_load(tmp_path):
    assert load(tmp_path / "none")[0] is None


@pytest.mark.parametrize("seed", range(3))
def test_every_save_is_exact_and_so_is_the_one_kept_before_it(tmp_path, seed):
    """Random numbers of transitions between saves: nothing, less than a segment, more than the whole buffer."""
    generator, replay, before = np.random.default_rng(seed), ReplayBuffer(CAPACITY, LAYOUT), None
    step = 0
    for number in range(25):
        count = int(generator.choice([0, 1, 3, 8, 13, 50, 61], p=[0.05, 0.2, 0.3, 0.2, 0.15, 0.05, 0.05]))
        for _ in range(count):
            fill(replay, 1)
        step += 10
        newest = save(tmp_path, step, replay)
        assert_loads(tmp_path, step, replay)
        kept = newest_first(tmp_path)
        assert kept[0] == newest
        assert len(kept) == min(2, number + 1)
        if before is not None:
            loaded = ReplayBuffer(CAPACITY, LAYOUT)
            assert_is(checkpoints.read_checkpoint(kept[1], loaded), loaded, step - 10, before)
        before = copy_of(replay)


def test_unchanged_segments_are_not_written_again(tmp_path, monkeypatch):
    """They are linked from the checkpoint that goes, so the two kept ones share no file."""
    replay, written = ReplayBuffer(CAPACITY, LAYOUT), []
    real = checkpoints.write_arrays
    monkeypatch.setattr(
        checkpoints, "write_arrays", lambda path, arrays: written.append(path.name) or real(path, arrays)
    )
    for step in range(1, 8):
        fill(replay, 10)
        del written[:]
        save(tmp_path, step, replay)
        newest, *others = newest_first(tmp_path)
        inodes = {path.stat().st_ino for path in newest.iterdir()}
        for other in others:
            assert inodes.isdisjoint(path.stat().st_ino for path in other.iterdir())
    # 20 of 50 rows have changed since the checkpoint before the last: at most 4 of the 7 segments
    segments = [name for name in written if name.startswith("replay-")]
    assert len(list(newest.glob("replay-*"))) == 7
    assert 3 <= len(segments) <= 4


def test_a_save_of_the_same_step_leaves_the_first_one(tmp_path):
    replay = ReplayBuffer(CAPACITY, LAYOUT)
    first = save(tmp_path, 5, replay)
    before = (first / "manifest.json").stat().st_ino
    assert save(tmp_path, 5, replay) == first
    assert (first / "manifest.json").stat().st_ino == before


def flip_a_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGES = {
    "flipped bit": flip_a_byte,
    "cut short": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "empty": lambda path: path.write_bytes(b""),
    "missing": lambda path: path.unlink(),
}
FILES = ("learner.safetensors", "replay-0000.safetensors", "manifest.json", "manifest.sha256")


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_newest_checkpoint_is_told_and_the_one_before_is_used(tmp_path, file, damage):
    first, _ = two_checkpoints(tmp_path)
    newest = newest_first(tmp_path)[0]
    DAMAGES[damage](newest / file)
    loaded, replay, warnings = load(tmp_path)
    assert_is(loaded, replay, 20, first)
    assert len(warnings) == 1
    assert newest.name in warnings[0]


def test_if_both_are_damaged_nothing_is_loaded_and_both_are_named(tmp_path):
    two_checkpoints(tmp_path)
    for path in newest_first(tmp_path):
        flip_a_byte(path / "learner.safetensors")
    with pytest.raises(CheckpointError, match=r"step-000000000030 is damaged.*step-000000000020 is damaged"):
        load(tmp_path)


def test_a_manifest_that_leads_out_of_the_checkpoint_is_refused(tmp_path):
    replay = ReplayBuffer(CAPACITY, LAYOUT)
    folder = save(tmp_path, 5, replay)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["../../secret.safetensors"] = manifest["files"]["learner.safetensors"]
    written = json.dumps(manifest).encode()
    (folder / "manifest.json").write_bytes(written)
    (folder / "manifest.sha256").write_text(checkpoints.hashlib.sha256(written).hexdigest())
    with pytest.raises(CheckpointError, match=r"names a file '\.\./\.\./secret\.safetensors'"):
        load(tmp_path)


def test_another_replay_capacity_is_refused(tmp_path):
    two_checkpoints(tmp_path)
    with pytest.raises(CheckpointError, match="replay capacity is 50, not 60"):
        load_newest_checkpoint(tmp_path, ReplayBuffer(60, LAYOUT), lambda warning: None)


def test_other_columns_of_the_same_width_are_refused(tmp_path):
    two_checkpoints(tmp_path)
    other = RowLayout(1, 1, reward_terms=3)
    assert other.width == LAYOUT.width
    with pytest.raises(CheckpointError, match=r"columns of its transitions are .*'reward_terms': 1.* not .*: 3"):
        load_newest_checkpoint(tmp_path, ReplayBuffer(CAPACITY, other), lambda warning: None)


@pytest.mark.parametrize("files_before", [0, 2, 5])
def test_a_full_disk_is_told_and_leaves_what_was_there(tmp_path, monkeypatch, files_before):
    _, replay = two_checkpoints(tmp_path)
    expected, real, written = copy_of(replay), checkpoints.write_bytes, []

    def full(path, data):
        if len(written) == files_before:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(path)
        real(path, data)

    monkeypatch.setattr(checkpoints, "write_bytes", full)
    fill(replay, 15)
    with pytest.raises(CheckpointError, match=r"the disk is full.*step-000000000030, is kept.*saclab resume"):
        save(tmp_path, 40, replay)
    assert [path.name for path in newest_first(tmp_path)] == ["step-000000000030", "step-000000000020"]
    assert not list(tmp_path.glob("*.partial"))
    assert_loads(tmp_path, 30, expected)
    monkeypatch.undo()
    monkeypatch.setattr(checkpoints, "SEGMENT_ROWS", 8)
    save(tmp_path, 40, replay)
    assert_loads(tmp_path, 40, replay)


def test_what_a_killed_save_left_is_neither_read_nor_in_the_way(tmp_path):
    _, replay = two_checkpoints(tmp_path)
    shutil.copytree(newest_first(tmp_path)[0], tmp_path / "step-000000000040.partial")
    assert_loads(tmp_path, 30, replay)
    fill(replay, 3)
    save(tmp_path, 40, replay)
    assert_loads(tmp_path, 40, replay)


@pytest.mark.parametrize("steps", [(25, 31, 35, 40), (25, 30, 35, 40)], ids=["beside its step", "over its step"])
@pytest.mark.parametrize("file", FILES)
def test_after_a_damaged_checkpoint_whole_ones_are_saved(tmp_path, file, steps):
    """The damaged one, of step 30, must not be linked from, stop a save, or take a whole one's place."""
    two_checkpoints(tmp_path)
    flip_a_byte(newest_first(tmp_path)[0] / file)
    _, replay, _ = load(tmp_path)
    for step in steps:
        fill(replay, 1)
        save(tmp_path, step, replay)
        loaded, read, warnings = load(tmp_path)
        assert_is(loaded, read, step, replay)
        assert warnings == []
    assert [path.name[-2:] for path in newest_first(tmp_path)] == ["40", "35"]


def test_what_cannot_be_removed_harms_no_checkpoint(tmp_path, monkeypatch):
    """As a file on NFS that another process has open; the next save removes it."""
    replay, refused = ReplayBuffer(CAPACITY, LAYOUT), [OSError(errno.EBUSY, "busy")]
    for step in (1, 2):
        fill(replay, 5)
        save(tmp_path, step, replay)
    real = checkpoints.remove_all

    def busy(folders):
        if list(folders) and refused:
            raise refused.pop()
        real(folders)

    monkeypatch.setattr(checkpoints, "remove_all", busy)
    fill(replay, 5)
    save(tmp_path, 3, replay)
    assert not refused
    assert_loads(tmp_path, 3, replay)
    monkeypatch.undo()
    save(tmp_path, 4, replay)
    assert len(list(tmp_path.iterdir())) == 2
