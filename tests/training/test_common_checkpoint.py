"""Runs that go on together go on from the newest step of which each of them has a whole checkpoint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from saclab.replay import ReplayBuffer, RowLayout
from saclab.training.checkpoint import Checkpoint, CheckpointError, newest_first, read_checkpoint, save_checkpoint
from saclab.training.common_checkpoint import load_newest_checkpoint, read_common
from saclab.training.manifest import Moment, moment_named

LAYOUT = RowLayout(2, 1)


def save(folder: Path, step: int, evaluate_first: bool = False, updates: int | None = None) -> Path:
    """With `updates`, of a moment within the round of this step."""
    moment = Moment(step, tested=not evaluate_first) if updates is None else Moment(step, False, updates)
    replay = ReplayBuffer(10, LAYOUT)
    replay.added = step
    content = Checkpoint({"learner": {".step": np.array(step)}}, {"step": step, "evaluated": not evaluate_first})
    return save_checkpoint(folder, moment, content, replay)


def damage(checkpoint: Path) -> None:
    (checkpoint / "learner.safetensors").write_bytes(b"")


def read_together(*folders: Path) -> tuple[list[dict], list[list[str]], list[str]]:
    """The states that were read, the warnings of each run, and the names of all checkpoints that were looked at."""
    warnings: list[list[str]] = [[] for _ in folders]
    looked_at = []

    def read(run: int, path: Path) -> Checkpoint:
        assert path.parent == folders[run]
        looked_at.append(path.name)
        return read_checkpoint(path, ReplayBuffer(10, LAYOUT))

    found = read_common(folders, read, [own.append for own in warnings])
    return [checkpoint.state for checkpoint in found], warnings, looked_at


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path]:
    """Both have checkpoints of steps 4 and 6."""
    first, second = tmp_path / "first/checkpoints", tmp_path / "second/checkpoints"
    for folder in (first, second):
        save(folder, 4)
        save(folder, 6)
    return first, second


def steps(states: list[dict]) -> list[int]:
    return [state["step"] for state in states]


def test_where_nothing_is_damaged_each_run_reads_one_checkpoint(runs):
    states, warnings, looked_at = read_together(*runs)
    assert steps(states) == [6, 6]
    assert warnings == [[], []]
    assert looked_at == ["step-000000000006"] * 2


def test_one_damaged_checkpoint_takes_all_back_to_the_step_before(runs):
    damage(runs[1] / "step-000000000006")
    states, warnings, _ = read_together(*runs)
    assert steps(states) == [4, 4]
    assert warnings[0] == []
    assert "step-000000000006 is damaged" in warnings[1][0]
    assert [path.name for folder in runs for path in newest_first(folder)] == ["step-000000000004"] * 2
    assert (runs[1] / "step-000000000006.damaged").exists()
    assert (runs[0] / "step-000000000006.partial").exists()


def test_a_step_that_only_some_have_reached_is_passed_over(runs):
    save(runs[0], 8)
    states, warnings, looked_at = read_together(*runs)
    assert steps(states) == [6, 6]
    assert warnings == [[], []]
    assert looked_at == ["step-000000000006"] * 2
    assert newest_first(runs[0])[0].name == "step-000000000006"


def test_before_and_after_an_evaluation_is_the_same_step(runs):
    """One run was to be evaluated when the group was stopped, and the other was not."""
    save(runs[0], 8, evaluate_first=True)
    save(runs[1], 8)
    states, *_ = read_together(*runs)
    assert states == [{"step": 8, "evaluated": False}, {"step": 8, "evaluated": True}]


def test_moments_of_a_round_lie_before_its_end(runs):
    """As their names have it; runs that were stopped at the same update of a round are equally far."""
    within = [Moment(8, False, 120), Moment(8, False, 121)]
    moments = [Moment(7), *within, Moment(8, tested=False), Moment(8), Moment(9, False, 140)]
    assert sorted(moments) == moments
    assert [moment_named(moment.name) for moment in moments] == moments
    assert within[1].name == "step-000000000008-update-000000000121"
    for folder, updates in zip(runs, ((120, 121), (119, 120)), strict=True):
        for made in updates:
            save(folder, 8, updates=made)
    _, _, looked_at = read_together(*runs)
    assert looked_at == [Moment(8, False, 120).name] * 2


@pytest.mark.parametrize("together", [False, True])
def test_a_damaged_checkpoint_after_an_evaluation_costs_the_evaluation(runs, together):
    """It costs no more than that."""
    first, second = runs
    save(first, 8, evaluate_first=True)
    damage(save(first, 8))
    save(second, 8)
    states, warnings, _ = read_together(*(runs if together else (first,)))
    assert states[0] == {"step": 8, "evaluated": False}
    assert "step-000000000008-untested before it is used" in warnings[0][0]


def test_nothing_in_common_is_told_and_nothing_is_touched(runs):
    damage(runs[0] / "step-000000000004")
    damage(runs[1] / "step-000000000006")
    before = sorted(runs[0].parents[1].rglob("*"))
    with pytest.raises(CheckpointError, match=r"no whole checkpoint of the same step: .*is damaged.*--batch 0"):
        read_together(*runs)
    with pytest.raises(CheckpointError, match=r"no whole checkpoint of the same step: .*second has none"):
        read_together(runs[0], runs[0].parents[1] / "second/none")
    assert sorted(runs[0].parents[1].rglob("*")) == before


def test_a_run_alone_is_the_case_of_one(runs):
    replay, warnings = ReplayBuffer(10, LAYOUT), []
    found = load_newest_checkpoint(runs[0], replay, warnings.append)
    assert found is not None
    assert (found.state["step"], found.transitions, replay.added) == (6, 6, 6)
    for path in newest_first(runs[0]):
        damage(path)
    with pytest.raises(CheckpointError, match="no checkpoint can be used"):
        load_newest_checkpoint(runs[0], replay, warnings.append)
