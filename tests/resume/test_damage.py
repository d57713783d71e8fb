"""What has been damaged is named, and what was there before it is used."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import pytest
import safetensors.numpy

from saclab.errors import TrainingFailed, UserError
from saclab.trained_policy import load_policy
from saclab.training.events import Finished
from saclab.training.logs import LOGS
from saclab.training.manifest import newest_first
from saclab.training.run_folder import read_config, read_last_session, read_run

from .helpers import assert_same_run, finish, start
from .stage import FIRST, SECOND, newest, sign

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


@pytest.mark.parametrize("name", ["metrics.jsonl", "evaluations.csv"])
def test_damage_to_what_a_log_had_at_the_checkpoint_is_named(stage, folder, name):
    """A digit changed in the past: the length stays. The report and the run that would go on both see it."""
    log = folder / name
    content = log.read_bytes()
    place = content.index(b"1", len(content.splitlines()[0]) // 2)
    log.write_bytes(content[:place] + b"2" + content[place + 1 :])
    for read in (read_run, stage.continue_from):
        with pytest.raises(UserError, match=rf"{name} is damaged \(it does not match its checksum\)"):
            read(folder)
    assert log.read_bytes()[place : place + 1] == b"2", "left as it is"


def test_what_came_after_the_checkpoint_is_cut_off(stage, folder):
    for name in LOGS:
        with (folder / name).open("a") as log:
            log.write("torn 1e99")
    read_run(folder)
    assert stage.continue_from(folder).resumed_at_step == SECOND
    for name in LOGS:
        assert (folder / name).read_bytes() == (stage.saved / name).read_bytes()


def test_a_changed_configuration_is_not_continued(stage, folder):
    path = folder / "config.json"
    path.write_text(path.read_text().replace('"discount": 0.99', '"discount": 0.98'))
    with pytest.raises(UserError, match=r"config\.json is damaged \(it does not match its checksum\)"):
        read_config(folder)
    with pytest.raises(UserError, match=r"config\.json is damaged"):
        stage.continue_from(folder)


@pytest.mark.parametrize("name", ["config.json", *LOGS[:3]])
def test_a_finished_run_knows_its_files(stage, tmp_path, name):
    run = Path(shutil.copytree(stage.straight, tmp_path / "run"))
    read_run(run)
    with (run / name).open("a") as file:
        file.write("\n")
    with pytest.raises(UserError, match=rf"{name} is damaged \(it has \d+ bytes, and \d+ were written\)"):
        read_run(run)


def test_a_run_of_before_checksums_is_read_and_goes_on(stage, folder):
    """Checkpoints had the logs' lengths, results nothing."""
    for path in newest_first(folder / "checkpoints"):
        manifest = json.loads((path / "manifest.json").read_text())
        logs = manifest["state"]["logs"]
        manifest["state"]["logs"] = {name: logs[name]["bytes"] for name in LOGS}
        sign(path, manifest)
    read_run(folder)
    assert isinstance(finish(stage.config, folder)[-1], Finished)
    assert_same_run(stage.straight, folder)
    result = json.loads((folder / "result.json").read_text())
    assert result.pop("files").keys() == {"config.json", *LOGS}
    (folder / "result.json").write_text(json.dumps(result))
    assert read_run(folder).result["steps"] == 150


def test_a_policy_that_was_changed_or_swapped_is_named(stage, folder):
    best = folder / "best"
    load_policy(folder)
    for name, old, new in (("policy.json", '"relu"', '"tanh"'), ("policy.json", '"Pendulum-v1"', '"Pendulum-v2"')):
        content = (best / name).read_text()
        assert old in content
        (best / name).write_text(content.replace(old, new))
        with pytest.raises(UserError, match="do not match their checksum"):
            load_policy(folder)
        (best / name).write_text(content)
    arrays = safetensors.numpy.load((best / "policy.safetensors").read_bytes())
    for changed in (arrays | {"actor": arrays["actor"] + 1}, arrays | {"another": arrays["actor"]}):
        (best / "policy.safetensors").write_bytes(safetensors.numpy.save(changed))
        with pytest.raises(UserError, match=r"the policy in .*best is damaged"):
            load_policy(folder)
    del arrays["checksum"]
    (best / "policy.safetensors").write_bytes(safetensors.numpy.save(arrays))
    load_policy(folder)  # as saclab wrote it before


@pytest.mark.slow
def test_of_two_resumes_at_once_exactly_one_trains(folder):
    """The other says so, and the run comes to its end as ever."""
    for path in (folder / "checkpoints").iterdir():
        shutil.rmtree(path)  # the whole run is ahead: neither has finished before the other looks
    path = folder / "config.json"
    path.write_text(path.read_text().replace('"max_steps": 150', '"max_steps": 15000'))
    both = [start(folder.parent, "resume", folder.name) for _ in range(2)]
    told = [process.communicate(timeout=600)[0] for process in both]
    codes = [process.returncode for process in both]
    assert sorted(codes) == [0, 2], told
    assert f"is in use by process {both[codes.index(0)].pid}: wait for it" in told[codes.index(2)]
    assert "Traceback" not in "".join(told)
    assert read_run(folder).result["steps"] == 15000
    assert len((folder / "sessions.jsonl").read_text().splitlines()) == 3


def test_a_session_that_a_crash_cut_short_is_in_nobodys_way(stage, folder):
    sessions = folder / "sessions.jsonl"
    sessions.write_bytes(sessions.read_bytes() + b'{"began": "20')
    assert read_last_session(folder).from_step == FIRST
    stage.continue_from(folder)
    assert read_last_session(folder).from_step == SECOND
    assert len(sessions.read_text().splitlines()) == 4
