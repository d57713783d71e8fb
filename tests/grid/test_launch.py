"""Workers: what the launcher makes of what they say, and that stopping a grid leaves every run resumable."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from saclab.grid.launch import core_groups, launch
from saclab.grid.plan import Cell, make_grid
from saclab.grid.tasks import RunStatus
from saclab.machine import usable_cores
from saclab.training.requests import Requests
from saclab.training.run_folder import is_finished

SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 200, "update_interval": 1,
    "evaluation_interval_steps": 100, "evaluation_episodes": 1,
}  # fmt: skip


def grid(runs: Path, **overrides: object) -> list[Cell]:
    return make_grid(["Pendulum-v1"], ["sac", "sac-auto"], "quick", [0], runs, overrides={**SETTINGS, **overrides})


def test_a_grid_has_all_variants_of_a_seed_before_the_next_and_no_cell_twice(tmp_path: Path) -> None:
    cells = make_grid(["A-v0", "B-v0", "A-v0"], ["sac", "averaged", "sac"], "quick", [3, 4], tmp_path)
    named = [(cell.config.seed, cell.config.environment, cell.config.variant) for cell in cells]
    assert named == [
        (seed, environment, variant)
        for seed in (3, 4) for environment in ("A-v0", "B-v0") for variant in ("sac", "averaged")
    ]  # fmt: skip
    assert len({cell.folder for cell in cells}) == len(cells)


def test_a_status_takes_in_what_a_worker_says(tmp_path: Path) -> None:
    status = RunStatus(grid(tmp_path)[0])
    status.enter({"event": "progress", "fraction": 0.25, "updates": 50, "episodes": 1, "steps": 150, "seconds": 1.0})
    status.enter({"event": "evaluated", "mean_return": -3.5, "updates": 50})
    status.enter({"event": "warned", "message": "look"})
    assert (status.fraction, status.updates, status.test_return, status.warnings) == (0.25, 50, -3.5, ["look"])
    status.enter({"event": "failed", "message": "why"})
    assert (status.status, status.message) == ("failed", "why")


def test_a_stopped_grid_goes_on_where_it_was(tmp_path: Path) -> None:
    cells, requests = grid(tmp_path, max_updates=3000), Requests()
    for statuses in launch(cells, workers=2, threads=1, requests=requests):
        if any(status.updates > 100 for status in statuses):
            requests.stop = 1
    assert {status.status for status in statuses} == {"interrupted"}
    assert not any(is_finished(cell.folder) for cell in cells)
    *_, statuses = launch(cells, workers=2, threads=1, requests=Requests())
    assert [status.status for status in statuses] == ["finished", "finished"]
    sessions = [(cell.folder / "sessions.jsonl").read_text().count("\n") for cell in cells]
    assert max(sessions) == 2, "at least the run that had begun was continued, not begun again"


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not hold processes to cores")
def test_workers_that_fill_the_machine_keep_to_their_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    told = "import atexit, os; f = open(f'{os.path.dirname(__file__)}/cores-{os.getpid()}', 'w')\n"
    (tmp_path / "sitecustomize.py").write_text(
        told + "atexit.register(lambda: print(*sorted(os.sched_getaffinity(0)), file=f))\n"
    )
    cores = usable_cores()
    for _ in launch(grid(tmp_path), workers=len(cores), threads=1, requests=Requests()):
        pass
    kept = {tuple(map(int, path.read_text().split())) for path in tmp_path.glob("cores-*")} - {()}
    assert kept <= {(core,) for core in cores}
    assert len(kept) == min(2, len(cores))


def test_fewer_or_more_workers_than_cores_are_left_to_the_system() -> None:
    cores = len(usable_cores())
    assert core_groups(cores + 1, 1) == [[] for _ in range(cores + 1)]
    assert core_groups(cores, 2) == [[] for _ in range(cores)]
    assert core_groups(1, cores) == [usable_cores()]


def test_a_worker_that_dies_is_a_failed_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    (tmp_path / "sitecustomize.py").write_text("raise SystemExit('no python today')")
    *_, statuses = launch(grid(tmp_path), workers=2, threads=1, requests=Requests())
    assert [status.status for status in statuses] == ["failed", "failed"]
    assert "no python today" in statuses[0].message
