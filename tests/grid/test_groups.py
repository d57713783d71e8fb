"""Which runs of a grid make a run group, and that a grid of them is trained, stopped and continued."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from resume.helpers import assert_same_run

import saclab
from saclab.config import group_key
from saclab.errors import SettingError
from saclab.grid import resources
from saclab.grid.groups import run_groups
from saclab.grid.launch import launch
from saclab.grid.local import local_pool
from saclab.grid.plan import Cell, make_grid
from saclab.training.requests import Requests
from saclab.training.run_folder import read_last_session, read_run
from saclab.variants import VARIANTS, Variant

SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 300, "update_interval": 1,
    "evaluation_interval_steps": 100, "evaluation_episodes": 1, "acting_delay": 1,
}  # fmt: skip


def grid(runs: Path, seeds: int = 2, **overrides: object) -> list[Cell]:
    variants = ["sac", "sac-auto", "averaged", "averaged-auto"]
    return make_grid(["Pendulum-v1"], variants, "quick", range(seeds), runs, overrides={**SETTINGS, **overrides})


def named(cells: list[Cell], size: int) -> list[list[tuple[str, int]]]:
    groups = run_groups(cells, size)
    return [[(cells[index].config.variant, cells[index].config.seed) for index in group.members] for group in groups]


def test_snapshots_separate_run_groups_and_the_temperature_does_not(tmp_path):
    assert named(grid(tmp_path), 16) == [
        [("sac", 0), ("sac-auto", 0), ("sac", 1), ("sac-auto", 1)],
        [("averaged", 0), ("averaged-auto", 0), ("averaged", 1), ("averaged-auto", 1)],
    ]


def test_a_run_group_has_no_more_runs_than_asked_for(tmp_path):
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
def test_plain_numbers_do_not_separate_run_groups(tmp_path, change, same):
    plain, changed = (grid(tmp_path, **extra)[0].config for extra in ({}, change))
    assert plain != changed
    assert (group_key(plain) == group_key(changed)) == same


@pytest.mark.slow
def test_a_grid_of_run_groups_is_stopped_and_goes_on_bit_for_bit(tmp_path):
    whole, stopped = (grid(tmp_path / name, seeds=1, max_updates=5000) for name in ("whole", "stopped"))
    *_, statuses = launch(whole, local_pool(2, threads=1, batch=4), Requests(), batch=4)
    assert {status.status for status in statuses} == {"finished"}
    requests = Requests()
    for statuses in launch(stopped, local_pool(2, threads=1, batch=4), requests, batch=4):
        if statuses[2].updates > 20:
            requests.stop = 1
    assert [status.status for status in statuses] == ["finished", "finished", "interrupted", "interrupted"]
    *_, statuses = launch(stopped, local_pool(1, threads=1, batch=4), Requests(), batch=4)
    assert {status.status for status in statuses} == {"finished"}
    for ours, theirs in zip(whole, stopped, strict=True):
        assert_same_run(ours.folder, theirs.folder)


def test_a_run_group_that_lost_some_runs_keeps_its_slots(tmp_path):
    """Two of four runs have finished when the others are continued: what is computed is the same."""
    cells = grid(tmp_path, seeds=2, max_updates=100_000)[::2]  # sac and averaged, two seeds each
    stop = Requests()
    for statuses in launch(cells, local_pool(1, threads=1, batch=2), stop, batch=2):
        if statuses[0].updates > 20:
            stop.stop = 1
    saved = [cell for cell in cells if (cell.folder / "checkpoints").exists()]
    assert [cell.config.variant for cell in saved] == ["sac", "sac"]
    (saved[0].folder / "result.json").write_text("{}")  # as if it had finished
    left = [cell for cell in cells if not cell.finished]
    assert sorted((len(group.members), group.slots) for group in run_groups(left, 2)) == [(1, 2), (2, 2)]


def test_runs_saved_before_their_first_step_join_no_new_ones(tmp_path):
    cells = grid(tmp_path, seeds=2)[::4]  # sac, two seeds
    saved_at(cells[0], 0)
    assert sorted(len(group.members) for group in run_groups(cells, 4)) == [1, 1]


def test_a_run_that_has_failed_does_not_hold_up_the_others(tmp_path):
    cells = grid(tmp_path, seeds=3)[::4]  # sac, three seeds
    for cell, steps in zip(cells, [(400, 300), (300, 200), (400, 300)], strict=True):
        for step in steps:
            saved_at(cell, step)
    (cells[1].folder / "failure").mkdir()
    assert [group.members for group in run_groups(cells, 4)] == [[0, 2], [1]]


def test_a_crash_in_the_middle_of_saving_does_not_separate_runs(tmp_path):
    cells = grid(tmp_path, seeds=3)[::4]
    for cell, steps in zip(cells, [(400, 300), (400, 300), (300, 200)], strict=True):
        for step in steps:
            saved_at(cell, step)
    assert [group.members for group in run_groups(cells, 4)] == [[0, 1, 2]]


def test_runs_keep_their_slots_unless_smaller_groups_are_asked_for(tmp_path):
    """Some had not been saved when the process was killed, and some were."""
    cells = grid(tmp_path, seeds=4)[::4]
    for cell in cells:
        cell.folder.mkdir(parents=True)
        (cell.folder / "config.json").write_text(json.dumps({"machine": {"batch": 4}}))
    saved_at(cells[0], 100)
    assert sorted((len(group.members), group.slots) for group in run_groups(cells, 4)) == [(1, 4), (3, 4)]
    assert sorted((len(group.members), group.slots) for group in run_groups(cells, 2)) == [(1, 2), (1, 2), (2, 2)]


def saved_at(cell: Cell, step: int) -> None:
    (cell.folder / f"checkpoints/step-{step:012d}").mkdir(parents=True)


@pytest.mark.slow
def test_compare_trains_run_groups_and_each_run_has_its_own_place(tmp_path):
    told = []
    result = saclab.compare(
        ["Pendulum-v1"], ["sac", "sac-auto"], 2, "quick", batch=4, runs=tmp_path, tell=told.append,
        **{name: value for name, value in SETTINGS.items() if name != "acting_delay"},
    )  # fmt: skip
    assert not result.failed
    assert result.report is not None
    assert len(result.runs) == 4
    assert {run.config.training.acting_delay for run in result.runs} == {0}, "how it is computed is no setting"
    assert {read_run(run.path).machine["batch"] for run in result.runs} == {4}
    assert "run groups of 4 run(s)" in told[0]
    assert "--acting-delay 1 is faster" in told[0]
    assert "update-to-data ratio 1" in told[0]
    for run in result.runs:
        assert (run.path / "best/policy.safetensors").exists()
        assert json.loads((run.path / "result.json").read_text())["updates"] == 300
        assert read_last_session(run.path).machine.batch == 4


@pytest.mark.slow
def test_a_grid_begun_alone_goes_on_in_run_groups(tmp_path):
    """The runs of a laptop are those of a GPU: how a run is computed writes none of its settings."""
    settings = {name: value for name, value in SETTINGS.items() if name != "acting_delay"} | {"max_updates": 50}
    alone = saclab.compare(["Pendulum-v1"], ["sac"], 1, "quick", batch=0, runs=tmp_path, **settings)
    both = saclab.compare(["Pendulum-v1"], ["sac", "sac-auto"], 1, "quick", batch=2, runs=tmp_path, **settings)
    assert not both.failed
    assert both.report is not None, "its runs are comparable"
    assert [run.machine["batch"] for run in both.runs] == [0, 1]
    assert alone.runs[0].config.training == both.runs[1].config.training


def test_the_delay_of_a_run_group_is_the_users_choice(tmp_path):
    (cell,) = grid(tmp_path, seeds=1, acting_delay=1)[:1]
    assert "one round of updates behind (acting_delay 1)" in resources.group_note([cell], 4)


def test_what_differs_between_variants_is_said_of_each(tmp_path, monkeypatch):
    monkeypatch.setitem(VARIANTS, "redq", Variant("REDQ", "", {"updates_per_interval": 20, "acting_delay": 1}))
    cells = make_grid(["Pendulum-v1"], ["sac", "redq", "averaged"], "standard", 1, tmp_path)
    note = resources.group_note(cells, 4)
    assert "; sac, averaged: the environments wait for the updates (" in note
    assert "; redq: the policy that acts is one round of updates behind (acting_delay 1); " in note
    assert "; sac, averaged: 1 update(s) per 1 environment step(s): update-to-data ratio 1; " in note
    assert note.endswith("; redq: 20 update(s) per 1 environment step(s): update-to-data ratio 20")


@pytest.mark.parametrize("present", [True, False])
def test_run_groups_are_made_where_there_is_an_accelerator(monkeypatch, present):
    monkeypatch.setattr(resources, "accelerator", lambda: present)
    assert resources.chosen_batch(None) == (16 if present else 0)
    assert resources.chosen_batch(None, "ray", ray_gpus=0.5) == 16
    assert resources.chosen_batch(None, "ray", ray_gpus=0.0) == 0
    assert (resources.chosen_batch(0), resources.chosen_batch(3)) == (0, 3)


def test_a_negative_batch_is_refused(tmp_path):
    with pytest.raises(SettingError, match=r"batch = -1: use a number of runs, or 0 to train each alone"):
        saclab.compare(["Pendulum-v1"], ["sac"], 1, "quick", batch=-1, runs=tmp_path)
