"""Damaged and hostile run folders: whatever has happened to one, it is read, or what is wrong with it is told.

And what is read is right: where success is claimed, every evaluation is there as it was written.
"""

from __future__ import annotations

import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saclab.errors import TrainingFailed, UserError
from saclab.machine import machine_facts
from saclab.protocols import make_config
from saclab.report.report import write_report
from saclab.report.runs import read_comparison
from saclab.report.scores import score_environment
from saclab.report.tables import scores_csv
from saclab.trained_policy import load_policy, read_description
from saclab.training import loop
from saclab.training.common_checkpoint import group_slots
from saclab.training.events import Evaluated, Saved
from saclab.training.local_engine import LocalBuilder
from saclab.training.logs import Logs
from saclab.training.manifest import newest_first
from saclab.training.run_folder import find_runs, read_config, read_last_session, read_run
from saclab.training.starts import find_beginnings

from .conftest import FAST, SLOW
from .damage import Damage, apply, damages

SMALL = {
    "hidden_layers": (4,), "batch_size": 4, "random_steps": 8, "replay_capacity": 64, "max_steps": 60,
    "evaluation_interval_steps": 15, "evaluation_episodes": 2, "log_interval": 10, "q_bias_episodes": 1,
}  # fmt: skip
CONFIG = make_config("Pendulum-v1", "sac", overrides=SMALL)


class Runs:
    """A finished run, one that was broken off after a checkpoint, and the evaluations that each has."""

    def __init__(self, folder: Path) -> None:
        self.folders = {"finished": folder / "finished", "unfinished": folder / "unfinished"}
        list(loop.train(CONFIG, self.folders["finished"]))
        events = loop.train(CONFIG, self.folders["unfinished"], checkpoint_minutes=0)
        evaluated = saved = 0
        for event in events:
            evaluated += isinstance(event, Evaluated)
            saved += isinstance(event, Saved)
            if evaluated >= 2 and isinstance(event, Saved):
                break
        events.close()
        self.newest = {name: newest_first(path / "checkpoints")[0].name for name, path in self.folders.items()}
        self.builder, self.facts = LocalBuilder(CONFIG), machine_facts()
        self.evaluations = {name: read_run(path).evaluations["mean_return"] for name, path in self.folders.items()}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return Runs(tmp_path_factory.mktemp("fuzz"))


def told(read: Callable[[], Any]) -> Any:
    """What it gives, or None if it tells what is wrong in words."""
    try:
        return read()
    except (TrainingFailed, UserError):
        return None


def resume(runs: Runs, folder: Path) -> None:
    """What a session does before its first step; an engine is only built of what belongs to this configuration."""
    config = read_config(folder)
    read_last_session(folder)
    group_slots(folder)
    if config == CONFIG:
        (beginning,) = find_beginnings(runs.builder, [folder], runs.facts)
        Logs(folder, config.training.evaluation_episodes, beginning.logs).close()


def is_same(checkpoint: Path, original: Path) -> bool:
    """Whether what a checkpoint has recorded is still there, so that it can tell of damage elsewhere."""
    pairs = [(checkpoint / name, original / name) for name in ("manifest.json", "manifest.sha256")]
    return all(path.is_file() and path.read_bytes() == own.read_bytes() for path, own in pairs)


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Break off what hangs."""

    def stop(*_: object) -> NoReturn:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def check(runs: Runs, name: str, found: list[Damage]) -> None:
    with tempfile.TemporaryDirectory() as root, limited(120):
        folder = Path(root) / "run"
        shutil.copytree(runs.folders[name], folder)
        for damage in found:
            apply(folder, damage)
        comparison = told(lambda: read_comparison(find_runs([Path(root)])))
        if comparison is not None:
            scores = [score_environment(comparison, environment) for environment in comparison.environments]
            scores_csv(comparison, scores)
            (run,) = comparison.runs
            newest = Path("checkpoints") / runs.newest[name]
            if (folder / "result.json").is_file() or is_same(folder / newest, runs.folders[name] / newest):
                expected, means = runs.evaluations[name], run.evaluations.get("mean_return", np.zeros(0))
                np.testing.assert_array_equal(means[: len(expected)], expected)
        told(lambda: (load_policy(folder), read_description(folder)))
        told(lambda: resume(runs, folder))


kinds = st.sampled_from(("finished", "unfinished"))


@FAST
@given(name=kinds, found=st.lists(damages, min_size=1, max_size=2))
def test_a_damaged_run_folder_is_read_right_or_told_of(runs: Runs, name: str, found: list[Damage]) -> None:
    check(runs, name, found)


@pytest.mark.slow
@SLOW
@given(name=kinds, found=st.lists(damages, min_size=1, max_size=3))
def test_thousands_of_damaged_run_folders(runs: Runs, name: str, found: list[Damage]) -> None:
    check(runs, name, found)


def test_a_damaged_folder_among_others_is_listed_in_a_whole_report(runs: Runs, tmp_path: Path) -> None:
    """The pages too, which the fuzzer has no time for."""
    for name, folder in runs.folders.items():
        shutil.copytree(folder, tmp_path / "runs" / name)
    (tmp_path / "runs" / "unfinished" / "metrics.jsonl").write_text("[1]\n")
    lines: list[str] = []
    page = write_report(find_runs([tmp_path / "runs"]), tmp_path / "report", tell=lines.append)
    (left_out,) = [line for line in lines if line.startswith("left out: ")]
    assert "metrics.jsonl is damaged" in left_out
    assert "metrics.jsonl is damaged" in page.read_text()
