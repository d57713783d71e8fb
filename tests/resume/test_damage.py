"""What has been damaged is named, and what was there before it is used."""

from __future__ import annotations

import json
import random

import pytest

from saclab.errors import TrainingFailed, UserError
from saclab.training.checkpoint import newest_first
from saclab.training.events import Finished
from saclab.training.run_folder import read_last_session

from .helpers import assert_same_run, finish
from .stage import FIRST, SECOND, newest

FILES = ("manifest.json", "manifest.sha256", "learner.safetensors", "environments.safetensors", "window.safetensors",
         "best.safetensors", "replay-0000.safetensors", "replay-0003.safetensors")  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_any_flipped_bit_or_missing_end_is_seen(stage, folder, name):
    """The checkpoint before is used then."""
    chance, path = random.Random(name), newest(folder) / name
    content = path.read_bytes()
    flips = [(position, 1 << chance.randrange(8)) for position in {0, len(content) - 2, chance.randrange(len(content))}]
    damaged = [
        content[:position] + bytes([content[position] ^ bit]) + content[position + 1 :] for position, bit in flips
    ]
    damaged += [content[:length] for length in (0, 1, len(content) // 2, len(content) - 2)] + [content + b"\0"]
    for bad in damaged:
        path.write_bytes(bad)
        started = stage.continue_from(folder)
        assert started.resumed_at_step == FIRST
        assert sum(f"step-{SECOND:012d} is damaged" in note for note in started.notes) == 1
        aside = path.parent.with_suffix(".damaged")
        assert (aside / name).read_bytes() == bad, "set aside as it was"
        aside.rename(path.parent)


def test_the_run_goes_on_from_the_one_before_to_the_same_end(stage, folder):
    path = newest(folder) / "replay-0001.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    assert isinstance(finish(stage.config, folder)[-1], Finished)
    assert_same_run(stage.straight, folder)
    assert not list((folder / "checkpoints").glob("*.damaged")), "gone when whole ones were written"
    session = json.loads((folder / "sessions.jsonl").read_text().splitlines()[-1])
    assert any("is damaged" in note for note in session["notes"])


def test_two_damaged_checkpoints_are_an_error_that_names_both(stage, folder):
    """Nothing is touched."""
    for path in newest_first(folder / "checkpoints"):
        (path / "learner.safetensors").write_bytes(b"")
    before = sorted(folder.rglob("*"))
    with pytest.raises(TrainingFailed, match=rf"step-{SECOND:012d} is damaged.*step-{FIRST:012d} is damaged"):
        stage.continue_from(folder)
    assert sorted(folder.rglob("*")) == before


def test_the_two_kept_checkpoints_share_no_file(stage, folder):
    first, second = (
        {file.stat().st_ino for file in path.iterdir()} for path in newest_first(stage.saved / "checkpoints")
    )
    assert first.isdisjoint(second)
    for file in newest(folder).iterdir():
        file.write_bytes(b"overwritten in place")
    assert stage.continue_from(folder).resumed_at_step == FIRST


def test_a_missing_log_or_a_shorter_one_is_named(stage, folder):
    log = folder / "episodes.csv"
    log.write_bytes(log.read_bytes()[:-1])
    with pytest.raises(UserError, match=r"episodes\.csv is damaged \(it has \d+ bytes, and \d+ were written\)"):
        stage.continue_from(folder)


def test_a_session_that_a_crash_cut_short_is_in_nobodys_way(stage, folder):
    sessions = folder / "sessions.jsonl"
    sessions.write_bytes(sessions.read_bytes() + b'{"began": "20')
    assert read_last_session(folder).from_step == FIRST
    stage.continue_from(folder)
    assert read_last_session(folder).from_step == SECOND
    assert len(sessions.read_text().splitlines()) == 4
