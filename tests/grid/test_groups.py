"""Which runs of a grid make a batch, and that a grid of batches is trained, stopped and continued."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from resume.helpers import assert_same_run

import saclab
from saclab import api
from saclab.config import structure
from saclab.errors import SettingError
from saclab.grid.groups import batches
from saclab.grid.launch import launch
from saclab.grid.plan import Cell, make_grid
from saclab.training.requests import Requests
from saclab.training.run_folder import read_last_session, read_run

SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 300, "update_interval": 1,
    "evaluation_interval_steps": 100, "evaluation_episodes": 1, "acting_delay": 1,
}  # fmt: skip


def grid(runs: Path, seeds: int = 2, **overrides: object) -> list[Cell]:
    variants = ["sac", "sac-auto", "averaged", "averaged-auto"]
    return make_grid(["Pendulum-v1"], variants, "quick", range(seeds), runs, overrides={**SETTINGS, **overrides})


def named(cells: list[Cell], size: int) -> list[list[tuple[str, int]]]:
    groups = batches(cells, size)
    return [[(cells[index].config.variant, cells[index].config.seed) for index in group.members] for group in groups]


def test_the_number_of_snapshots_separates_batches_and_the_temperature_does_not(tmp_path):
    assert named(grid(tmp_path), 16) == [
        [("sac", 0), ("sac-auto", 0), ("sac", 1), ("sac-auto", 1)],
        [("averaged", 0), ("averaged-auto", 0), ("averaged", 1), ("averaged-auto", 1)],
    ]


def test_a_batch_has_no_more_runs_than_asked_for(tmp_path):
    assert [len(group) for group in named(grid(tmp_path, seeds=5), 4)] == [4, 4, 4, 4, 2, 2]


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({"discount": 0.5}, True),
        ({"actor_learning_rate": 0.1, "critic_learning_rate": 0.1, "temperature_learning_rate": 0.1}, True),
        ({"polyak_rate": 0.5, "snapshot_interval": 7}, True),
        ({"initial_temperature": 0.5, "target_entropy": 1.0}, True),
        ({"temperature": "learned"}, True),
        ({"max_episodes": 9, "evaluation_episodes": 4, "log_interval": 3}, True),
        ({"snapshots": 2}, False),
        ({"hidden_layers": (8, 8)}, False),
        ({"batch_size": 8}, False),
        ({"activation": "tanh"}, False),
        ({"temperature_gradient": "alpha"}, False),
        ({"parallel_environments": 2}, False),
        ({"update_interval": 3}, False),
        ({"acting_delay": 0}, False),
        ({"max_updates": 17}, False),
    ],
)
def test_plain_numbers_do_not_separate_batches(tmp_path, change, same):
    plain, changed = (grid(tmp_path, **extra)[0].config for extra in ({}, change))
    assert plain != changed
    assert (structure(plain) == structure(changed)) == same


@pytest.mark.slow
def test_a_grid_of_batches_is_stopped_and_goes_on_bit_for_bit(tmp_path):
    whole, stopped = grid(tmp_path / "whole", seeds=1), grid(tmp_path / "stopped", seeds=1)
    *_, statuses = launch(whole, workers=2, threads=1, requests=Requests(), batch=4)
    assert {status.status for status in statuses} == {"finished"}
    requests = Requests()
    for statuses in launch(stopped, workers=2, threads=1, requests=requests, batch=4):
        if statuses[2].updates > 20:
            requests.stop = 1
    assert [status.status for status in statuses] == ["finished", "finished", "interrupted", "interrupted"]
    *_, statuses = launch(stopped, workers=1, threads=1, requests=Requests(), batch=4)
    assert {status.status for status in statuses} == {"finished"}
    for ours, theirs in zip(whole, stopped, strict=True):
        assert_same_run(ours.folder, theirs.folder)


def test_a_batch_that_goes_on_without_some_of_its_runs_keeps_its_slots(tmp_path):
    """Two of four runs have finished when the others are continued: what is computed is the same."""
    cells = grid(tmp_path, seeds=2)[::2]  # sac and averaged, two seeds each
    stop = Requests()
    for statuses in launch(cells, workers=1, threads=1, requests=stop, batch=2):
        if statuses[0].updates > 20:
            stop.stop = 1
    saved = [cell for cell in cells if (cell.folder / "checkpoints").exists()]
    assert [cell.config.variant for cell in saved] == ["sac", "sac"]
    (saved[0].folder / "result.json").write_text("{}")  # as if it had finished
    left = [cell for cell in cells if not cell.finished]
    assert sorted((len(group.members), group.slots) for group in batches(left, 2)) == [(1, 2), (2, 2)]


def test_runs_that_were_saved_before_their_first_step_are_no_batch_with_new_ones(tmp_path):
    cells = grid(tmp_path, seeds=2)[::4]  # sac, two seeds
    saved_at(cells[0], 0)
    assert sorted(len(group.members) for group in batches(cells, 4)) == [1, 1]


def test_a_run_that_has_failed_does_not_hold_up_the_others(tmp_path):
    cells = grid(tmp_path, seeds=3)[::4]  # sac, three seeds
    for cell, steps in zip(cells, [(400, 300), (300, 200), (400, 300)], strict=True):
        for step in steps:
            saved_at(cell, step)
    (cells[1].folder / "failure").mkdir()
    assert [group.members for group in batches(cells, 4)] == [[0, 2], [1]]


def test_a_crash_in_the_middle_of_saving_does_not_separate_runs(tmp_path):
    cells = grid(tmp_path, seeds=3)[::4]
    for cell, steps in zip(cells, [(400, 300), (400, 300), (300, 200)], strict=True):
        for step in steps:
            saved_at(cell, step)
    assert [group.members for group in batches(cells, 4)] == [[0, 1, 2]]


def test_runs_keep_the_slots_in_which_they_were_begun_unless_smaller_batches_are_asked_for(tmp_path):
    """Some had not been saved when the process was killed, and some were."""
    cells = grid(tmp_path, seeds=4)[::4]
    for cell in cells:
        cell.folder.mkdir(parents=True)
        (cell.folder / "config.json").write_text(json.dumps({"machine": {"batch": 4}}))
    saved_at(cells[0], 100)
    assert sorted((len(group.members), group.slots) for group in batches(cells, 4)) == [(1, 4), (3, 4)]
    assert sorted((len(group.members), group.slots) for group in batches(cells, 2)) == [(1, 2), (1, 2), (2, 2)]


def saved_at(cell: Cell, step: int) -> None:
    (cell.folder / f"checkpoints/step-{step:012d}").mkdir(parents=True)


def test_compare_trains_batches_and_each_run_has_its_own_place(tmp_path):
    told = []
    result = saclab.compare(
        ["Pendulum-v1"], ["sac", "sac-auto"], 2, "quick", batch=4, runs=tmp_path, tell=told.append,
        **{name: value for name, value in SETTINGS.items() if name != "acting_delay"},
    )  # fmt: skip
    assert not result.failed
    assert result.report is not None
    assert len(result.runs) == 4
    assert {run.config.training.acting_delay for run in result.runs} == {1}
    assert {read_run(run.path).machine["batch"] for run in result.runs} == {4}
    assert "batches of 4 run(s)" in told[0]
    assert "acting_delay 1" in told[0]
    assert "update-to-data ratio 1" in told[0]
    for run in result.runs:
        assert (run.path / "best/policy.safetensors").exists()
        assert json.loads((run.path / "result.json").read_text())["updates"] == 300
        assert read_last_session(run.path)["machine"]["batch"] == 4


@pytest.mark.slow
def test_acting_delay_0_is_kept_if_it_is_asked_for(tmp_path):
    result = saclab.compare(["Pendulum-v1"], ["sac"], 1, "quick", batch=1, runs=tmp_path,
                            **{**SETTINGS, "acting_delay": 0})  # fmt: skip
    assert result.runs[0].config.training.acting_delay == 0


@pytest.mark.parametrize("present", [True, False])
def test_batches_are_made_where_there_is_an_accelerator(monkeypatch, present):
    monkeypatch.setattr(api, "accelerator", lambda: present)
    assert api.chosen_batch(None) == (16 if present else 0)
    assert api.chosen_batch(None, "ray", ray_gpus=0.5) == 16
    assert api.chosen_batch(None, "ray", ray_gpus=0.0) == 0
    assert (api.chosen_batch(0), api.chosen_batch(3)) == (0, 3)


def test_a_negative_batch_is_refused(tmp_path):
    with pytest.raises(SettingError, match=r"batch = -1: use a number of runs, or 0 to train each alone"):
        saclab.compare(["Pendulum-v1"], ["sac"], 1, "quick", batch=-1, runs=tmp_path)
