"""What this process may not read or write is one line and an exit status; nothing is lost, nothing begun anew."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from resume.helpers import finish, small_config, stop_at

from saclab.training.checkpoint import newest_first

from .conftest import Told

TRAIN = ("--hidden-layers", "8", "--batch-size", "16", "--random-steps", "40", "--max-steps", "60",
         "--evaluation-episodes", "1")  # fmt: skip
STOPPED = 130


def is_one_line(told: Told, status: int, words: str) -> None:
    assert "Traceback" not in told.output + told.errors, told
    assert (told.status, told.errors.count("\n")) == (status, 1), told
    assert re.search(words, told.errors), told


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two checkpoints, and one that is finished."""
    folder = tmp_path_factory.mktemp("saved")
    config = small_config("Pendulum-v1", max_steps=150)
    stop_at(100, config, folder / "stopped")
    stop_at(STOPPED, config, folder / "stopped")
    finish(config, folder / "finished")
    return folder


@pytest.fixture
def runs(saved: Path, tmp_path: Path) -> Iterator[Path]:
    folder = Path(shutil.copytree(saved, tmp_path / "runs"))
    yield folder
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)


UNREADABLE = ("config.json", "evaluations.csv", "metrics.jsonl", "episodes.csv", "result.json", "")


@pytest.mark.parametrize("name", UNREADABLE)
def test_an_unreadable_run_is_told_of_by_a_report(saclab_confined, runs, tmp_path, name):
    (runs / "finished" / name).chmod(0)
    is_one_line(saclab_confined("report", runs / "finished", "--out", tmp_path / "alone"), 2, "Permission denied")
    strict = saclab_confined("report", runs, "--out", tmp_path / "strict", "--strict")
    is_one_line(strict, 2, "1 of 2 folders cannot be read: .*Permission denied")


def test_an_unreadable_run_is_left_out_of_a_report(saclab_confined, runs, tmp_path):
    (runs / "finished").chmod(0)
    (runs / "stopped/evaluations.csv").chmod(0o444)
    told = saclab_confined("report", runs, "--out", tmp_path / "report")
    assert (told.status, told.errors) == (0, ""), told
    assert re.search(r"left out: .*finished.*Permission denied", told.output)


@pytest.mark.parametrize("name", ["report", "report/figures"])
def test_a_report_into_a_place_without_permission_is_one_line(saclab_confined, runs, tmp_path, name):
    out, place = tmp_path / "report", tmp_path / name
    (out / "figures").mkdir(parents=True)
    place.chmod(0o555)
    is_one_line(
        saclab_confined("report", runs / "finished", "--out", out),
        2,
        "cannot write the report to .*Permission denied.*--out",
    )


@pytest.mark.parametrize("name", ["best/policy.json", "best/policy.safetensors", "best", ""])
@pytest.mark.parametrize("command", ["evaluate", "record"])
def test_an_unreadable_policy_is_one_line(saclab_confined, runs, command, name):
    (runs / "finished" / name).chmod(0)
    is_one_line(saclab_confined(command, runs / "finished"), 2, "Permission denied")


def test_a_film_without_permission_is_one_line(saclab_confined, runs):
    (runs / "finished/best").chmod(0o555)
    is_one_line(saclab_confined("record", runs / "finished", "--steps", "2"), 2, "Permission denied")


UNWRITABLE = {
    "the run's folder": ("", 0o555, 1), "a log": ("metrics.jsonl", 0o444, 1), "the lock": ("lock", 0o444, 1),
    "the sessions": ("sessions.jsonl", 0o444, 1), "the checkpoints": ("checkpoints", 0o555, 1),
}  # fmt: skip
HIDDEN = {
    "the run": ("", 0, 2), "the configuration": ("config.json", 0, 2), "the checkpoints": ("checkpoints", 0, 2),
    "the names of the checkpoints": ("checkpoints", 0o311, 2), "a log": ("evaluations.csv", 0, 2),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "mode", "status"),
    [pytest.param(*case, id=f"{kind} {what}") for kind, cases in (("read-only", UNWRITABLE), ("hidden", HIDDEN))
     for what, case in cases.items()],
)  # fmt: skip
def test_a_resume_without_permission_loses_nothing(saclab_confined, runs, name, mode, status):
    """It ends with a line, and goes on where it was once it may."""
    run = runs / "stopped"
    (run / name).chmod(mode)
    is_one_line(saclab_confined("resume", run), status, "Permission denied")
    for path in (run, run / name):
        path.chmod(0o755)
    newest = newest_first(run / "checkpoints")[0].name
    told = saclab_confined("resume", run)
    assert told.status == 0, told
    assert f"resumed at step {int(newest.split('-')[1])}" in told.output
    assert int(newest.split("-")[1]) >= STOPPED


def test_an_unreadable_checkpoint_is_passed_over(saclab_confined, runs):
    (newest_first(runs / "stopped/checkpoints")[0] / "learner.safetensors").chmod(0)
    told = saclab_confined("resume", runs / "stopped")
    assert told.status == 0, told
    assert "resumed at step 100" in told.output
    assert re.search(r"is damaged: learner\.safetensors.*Permission denied", told.output)


@pytest.mark.parametrize("command", ["train", "compare"])
def test_runs_in_a_place_without_permission_are_one_line(saclab_confined, tmp_path, command):
    place = tmp_path / "closed"
    place.mkdir(mode=0o555)
    told = saclab_confined(command, "Pendulum-v1", *TRAIN, "--runs", place / "runs")
    assert told.status in (1, 2)
    is_one_line(told, told.status, f"{place}.*Permission denied")
    assert not list(place.iterdir())
