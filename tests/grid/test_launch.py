"""Workers: what the launcher makes of what they say, and that stopping a grid leaves every run resumable."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from saclab import memory
from saclab.api import reporting
from saclab.errors import SettingError, UserError
from saclab.grid.launch import launch
from saclab.grid.local import core_groups, local_pool
from saclab.grid.plan import Cell, make_grid, require_startable, seed_numbers
from saclab.grid.rate import RateMeter
from saclab.grid.tasks import RunStatus, Task
from saclab.machine import usable_cores
from saclab.training.common_checkpoint import checkpoint_steps
from saclab.training.lock import InUse, holder, locked
from saclab.training.requests import Requests
from saclab.training.run_folder import is_finished
from saclab.variants import VARIANTS, Variant

SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 200, "update_interval": 1,
    "evaluation_interval_steps": 100, "evaluation_episodes": 1,
}  # fmt: skip


def grid(runs: Path, **overrides: object) -> list[Cell]:
    return make_grid(["Pendulum-v1"], ["sac", "sac-auto"], "quick", [0], runs, overrides={**SETTINGS, **overrides})


def test_a_grid_goes_seed_by_seed_and_has_no_cell_twice(tmp_path: Path) -> None:
    cells = make_grid(["A-v0", "B-v0", "A-v0"], ["sac", "averaged", "sac"], "quick", [3, 4], tmp_path)
    named = [(cell.config.seed, cell.config.environment, cell.config.variant) for cell in cells]
    assert named == [
        (seed, environment, variant)
        for seed in (3, 4) for environment in ("A-v0", "B-v0") for variant in ("sac", "averaged")
    ]  # fmt: skip
    assert len({cell.folder for cell in cells}) == len(cells)


@pytest.mark.parametrize("order", [("sac", "large"), ("large", "sac")])
@pytest.mark.parametrize("row", [{"replay_capacity": 200_000}, {"reward_terms": tuple("abcdefghijkl")}])
def test_memory_must_do_for_the_largest_replay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: tuple[str, ...], row: dict[str, Any]
) -> None:
    """On Pendulum-v1 a row has 9 numbers: 100,000 of them take 3.6 MB, the larger buffers twice as much."""
    monkeypatch.setitem(VARIANTS, "large", Variant("Large", "", row))
    monkeypatch.setattr(memory, "available_memory", lambda: 10**7)
    tiny = {"hidden_layers": (4,), "batch_size": 8}
    small = make_grid(["Pendulum-v1"], ["sac", "sac-auto"], "quick", 1, tmp_path, overrides=tiny)
    require_startable(small, 2, "--workers")
    cells = make_grid(["Pendulum-v1"], order, "quick", 1, tmp_path, overrides=tiny)
    with pytest.raises(SettingError, match="in each of 2 runs at once"):
        require_startable(cells, 2, "--workers")
    require_startable(cells, 0, "--workers")


def test_arguments_of_every_environment_are_tried(tmp_path: Path) -> None:
    """Cells of one environment with other arguments are other environments."""
    cells = [cell for arguments in ({}, {"no_such": 1})
             for cell in make_grid(["Pendulum-v1"], ["sac"], "quick", 1, tmp_path, arguments)]  # fmt: skip
    with pytest.raises(UserError, match="no_such"):
        require_startable(cells, 0, "--workers")


def test_a_grid_is_not_begun_without_what_its_runs_begin_with(tmp_path: Path) -> None:
    cells = make_grid(["Pendulum-v1"], ["sac"], "quick", 2, tmp_path, overrides={"prefill": "replay:/no/such/run"})
    with pytest.raises(UserError, match="/no/such/run is not a run folder"):
        require_startable(cells, 2, "--workers")
    with pytest.raises(UserError, match="/no/such/run is not a run folder"):  # on this machine's device
        require_startable(cells, 0, "--batch")
    require_startable(cells, 0, "--workers", here=False)


def test_a_status_takes_in_what_a_worker_says(tmp_path: Path) -> None:
    status = RunStatus(grid(tmp_path)[0])
    status.enter({"event": "progress", "fraction": 0.25, "updates": 50, "episodes": 1, "steps": 150, "seconds": 1.0})
    status.enter({"event": "evaluated", "mean_return": -3.5, "evaluation": 2})
    status.enter({"event": "warned", "message": "look"})
    assert (status.fraction, status.updates, status.evaluation_return, status.warnings) == (0.25, 50, -3.5, ["look"])
    status.enter({"event": "failed", "message": "why"})
    assert (status.status, status.message) == ("failed", "why")


def test_a_stopped_grid_goes_on_where_it_was(tmp_path: Path) -> None:
    cells, requests = grid(tmp_path, max_updates=3000), Requests()
    for statuses in launch(cells, local_pool(2, threads=1), requests):
        if any(status.updates > 100 for status in statuses):
            requests.stop = 1
    assert {status.status for status in statuses} == {"interrupted"}
    assert not any(is_finished(cell.folder) for cell in cells)
    *_, statuses = launch(cells, local_pool(2, threads=1), Requests())
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
    for _ in launch(grid(tmp_path), local_pool(len(cores), threads=1), Requests()):
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
    *_, statuses = launch(grid(tmp_path), local_pool(2, threads=1), Requests())
    assert [status.status for status in statuses] == ["failed", "failed"]
    assert statuses[0].message == "its worker ended (exit status 1: SystemExit: no python today)"


def test_a_folder_that_cannot_be_made_stops_no_other_run(tmp_path: Path) -> None:
    cells = grid(tmp_path)
    cells[0].folder.parent.mkdir(parents=True)
    cells[0].folder.write_text("in the way")
    *_, statuses = launch(cells, local_pool(1, threads=1), Requests())
    assert [status.status for status in statuses] == ["failed", "finished"]
    assert statuses[0].message.startswith("cannot be started: ")


def test_a_worker_that_is_killed_is_a_failed_run_on_this_machine(tmp_path: Path) -> None:
    cells = grid(tmp_path, max_updates=1_000_000)[:1]
    killed = False
    for statuses in launch(cells, local_pool(1, threads=1), Requests()):
        if statuses[0].updates and not killed:
            os.kill(int((cells[0].folder / "lock").read_text()), signal.SIGKILL)
            killed = True
    assert (statuses[0].status, statuses[0].message) == ("failed", "its worker ended (killed by SIGKILL)")


def test_a_local_grid_that_is_dropped_saves_and_leaves_no_process_behind(tmp_path: Path) -> None:
    cells = grid(tmp_path, max_updates=1_000_000)
    stream = launch(cells, local_pool(2, threads=1), Requests())
    while not all(status.updates for status in next(stream)):
        pass
    workers = [int((cell.folder / "lock").read_text()) for cell in cells]
    stream.close()
    assert not [number for number in workers if Path(f"/proc/{number}").exists()]
    assert all(checkpoint_steps(cell.folder) for cell in cells)


def test_the_rate_leaves_out_what_comes_before_the_first_update() -> None:
    meter = RateMeter()
    for seconds, fraction, updates in ((0.0, 0.0, 0), (50.0, 0.1, 1), (60.0, 0.3, 101)):
        meter.enter(seconds, fraction, updates)
    assert meter.updates_per_second == 10.0
    assert meter.seconds_left == pytest.approx(35.0)


def test_a_name_is_for_one_variant(tmp_path: Path) -> None:
    (cell,) = make_grid(["A-v0"], ["sac"], "quick", [3], tmp_path, overrides={"polyak_rate": 0.1}, name="sac-fast")
    assert cell.folder == tmp_path / "A-v0/sac-fast/quick/seed-3"
    with pytest.raises(UserError, match=r"name = 'mine': .*and here are 2"):
        make_grid(["A-v0"], ["sac", "averaged"], "quick", [3], tmp_path, name="mine")


def test_seeds_are_counted_or_named_or_the_protocols() -> None:
    assert list(seed_numbers(None, "paper")) == [0, 1, 2, 3, 4]
    assert list(seed_numbers(2, "quick", first=7)) == [7, 8]
    assert list(seed_numbers([4, 9], "quick")) == [4, 9]
    with pytest.raises(UserError, match="seeds = 0"):
        seed_numbers(0, "quick")
    with pytest.raises(UserError, match="did you mean 'quick'"):
        seed_numbers(None, "quik")


# --- environments that harm their process, and runs of other processes


def rogue_grid(runs: Path, *environments: str) -> list[Cell]:
    settings = {**SETTINGS, "evaluation_interval_steps": 1000}
    return make_grid([f"environments.rogue:{name}" for name in environments], ["sac"], "quick", 1, runs,
                     overrides=settings)  # fmt: skip


@pytest.fixture
def rogues(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Workers find the environments of the tests, and say after half a second that one hangs."""
    tests = Path(__file__).parents[1]
    (tmp_path / "sitecustomize.py").write_text(
        "from saclab.environments import watch\nwatch.SECONDS, watch.LOOK_SECONDS = 0.5, 0.1\n"
    )
    for folder in (tests, tmp_path):
        monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)


def test_a_group_hangs_as_a_whole_and_comes_back_as_a_whole(tmp_path: Path) -> None:
    task = Task([RunStatus(cell) for cell in grid(tmp_path)], slots=2)
    task.enter({"run": 0, "event": "stalled", "message": "step has taken 60 s"})
    assert [run.stalled for run in task.runs] == [True, True]
    task.enter({"run": 1, "event": "progress", "fraction": 0.5, "updates": 1, "episodes": 0})
    assert [run.stalled for run in task.runs] == [False, False]


@pytest.mark.slow
@pytest.mark.usefixtures("rogues")
def test_a_run_that_hangs_or_dies_keeps_no_other_from_its_end(tmp_path: Path) -> None:
    """One place; the report of the others is written before the end."""
    cells = rogue_grid(tmp_path / "runs", "Hanging-v0", "Dying-v0", "Rogue-v0")
    told: list[str] = []
    requests = Requests()
    for statuses in reporting(launch(cells, local_pool(1, threads=1), requests), tmp_path / "report", told.append):
        if told and not requests.stop:
            requests.stop = 1
            assert [status.state for status in statuses] == ["hangs?", "failed", "finished"]
            assert (tmp_path / "report/index.html").exists()
            os.kill(int((cells[0].folder / "lock").read_text()), signal.SIGKILL)
    assert "nothing goes on but 1 run(s) that hang" in told[0]
    assert "step has taken" in statuses[0].warnings[-1]
    assert statuses[1].message == "its worker ended (exit status 7)"


@pytest.mark.slow
def test_what_an_environment_prints_is_no_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]), prepend=os.pathsep)
    (cell,) = make_grid(["environments.rogue:Meddling-v0"], ["sac"], "quick", 1, tmp_path / "runs",
                        {"folder": str(tmp_path)}, overrides={**SETTINGS, "max_updates": 20})  # fmt: skip
    *_, statuses = launch([cell], local_pool(1, threads=1), Requests())
    assert [status.status for status in statuses] == ["finished"], statuses[0].message
    assert (cell.folder / "worker.log").stat().st_size > 10**6


@pytest.mark.slow
def test_a_run_of_another_process_is_waited_for_and_taken_over(tmp_path: Path) -> None:
    cells = grid(tmp_path, max_updates=100_000)
    other, ours = launch(cells, local_pool(2, threads=1), Requests()), Requests()
    while not all(status.updates for status in next(other)):
        pass
    workers = [int((cell.folder / "lock").read_text()) for cell in cells]
    for statuses in launch(cells, local_pool(2, threads=1), ours):
        if all(status.state == f"waits for process {worker}" for status, worker in zip(statuses, workers, strict=True)):
            other.close()  # it saves and stops
        if all(status.status == "running" and status.updates for status in statuses):
            ours.stop = 1
    assert [status.status for status in statuses] == ["interrupted"] * 2
    assert [(cell.folder / "sessions.jsonl").read_text().count("\n") for cell in cells] == [2, 2]


def test_who_comes_second_to_a_folder_waits(tmp_path: Path) -> None:
    """The worker finds it locked, though the launcher found it free."""
    status = RunStatus(grid(tmp_path)[0], "running")
    status.enter({"event": "in_use", "message": "…"})
    assert status.status == "waiting"
    with locked(status.cell.folder):
        assert holder(status.cell.folder) == str(os.getpid())
        with pytest.raises(InUse), locked(status.cell.folder):
            pass
    assert holder(status.cell.folder) is None
    assert holder(tmp_path / "nowhere") is None
