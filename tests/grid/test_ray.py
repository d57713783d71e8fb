"""A grid on a real Ray cluster of this machine: the bits of local workers, whatever is killed or stopped on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest
from resume.helpers import assert_same_run, lines_of, run, start, wait_for

from saclab.errors import UserError
from saclab.grid.cluster import Cluster
from saclab.grid.launch import launch
from saclab.grid.local import local_pool
from saclab.grid.plan import Cell, make_grid
from saclab.grid.ray import ray_pool
from saclab.grid.tasks import RunStatus
from saclab.training.common_checkpoint import checkpoint_steps
from saclab.training.requests import Requests

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install '.[ray]'"),
]

VARIANTS = ("sac", "averaged-auto")
OFTEN = 0.005  # minutes: every 0.3 s
HERE = Cluster("local")  # a cluster of its own, whatever runs on this machine
SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "update_interval": 1, "replay_capacity": 1000,
    "evaluation_interval_steps": 2500, "evaluation_episodes": 1, "max_updates": 9000,
}  # fmt: skip
WORDS = (
    "compare", "Pendulum-v1", "--variants", *VARIANTS, "--protocol", "quick", "--seeds", "1",
    "--checkpoint-minutes", str(OFTEN), *(
        str(word) for name, value in SETTINGS.items()
        for word in ("--" + name.replace("_", "-"), *(value if isinstance(value, tuple) else (value,)))
    ),
)  # fmt: skip
ON_RAY = ("--launcher", "ray", "--ray-address", "local")


def grid(runs: Path) -> list[Cell]:
    return make_grid(["Pendulum-v1"], VARIANTS, "quick", [0], runs, overrides=SETTINGS)


def on_ray(cells: list[Cell], requests: Requests | None = None) -> Iterator[list[RunStatus]]:
    return launch(cells, ray_pool(HERE, 1, OFTEN), requests or Requests())


def finish_locally(cells: list[Cell]) -> list[RunStatus]:
    *_, statuses = launch(cells, local_pool(2, 1, OFTEN), Requests())
    assert {status.status for status in statuses} == {"finished"}
    return statuses


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> list[Cell]:
    """The grid, trained by local workers without a break."""
    cells = grid(tmp_path_factory.mktemp("straight"))
    finish_locally(cells)
    return cells


def assert_same_grid(cells: list[Cell], straight: list[Cell]) -> None:
    for ours, theirs in zip(cells, straight, strict=True):
        assert_same_run(ours.folder, theirs.folder)


def sessions(cell: Cell) -> list[dict]:
    return lines_of(cell.folder / "sessions.jsonl")


def status_of(process: int) -> tuple[str, int]:
    """State and parent of a process; ("X", 0) if there is none."""
    try:
        state, parent = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return "X", 0
    return state, int(parent)


def is_dead(process: int) -> bool:
    return status_of(process)[0] in "XZ"


def trained_a_while(cell: Cell) -> bool:
    return any(step > 1000 for step in checkpoint_steps(cell.folder))


def trained_together(cells: list[Cell]) -> bool:
    """Whether each run has trained a while; one that has sleeps until all have, so that none ends before."""
    ready = [cell for cell in cells if trained_a_while(cell)]
    all_are = len(ready) == len(cells)
    for cell in ready:
        with suppress(ProcessLookupError):
            os.kill(sessions(cell)[-1]["process"], signal.SIGCONT if all_are else signal.SIGSTOP)
    return all_are


def ray_process(worker: int) -> int:
    return status_of(worker)[1]


def kill_worker(cell: Cell, victim: Callable[[int], int]) -> None:
    """`kill -9` on the victim, which must be the end of the worker too, before anyone could start another.

    The worker is asleep, so that it cannot notice by itself that nobody listens any more.
    """
    worker = sessions(cell)[-1]["process"]
    os.kill(worker, signal.SIGSTOP)
    os.kill(victim(worker), signal.SIGKILL)
    wait_for(lambda: is_dead(worker), seconds=30)


def test_killed_processes_change_no_bit_of_a_grid(tmp_path, straight, capfd):
    cells = grid(tmp_path)
    victims = {cells[0].folder: ray_process, cells[1].folder: lambda worker: worker}
    statuses: list[RunStatus] = []
    for statuses in on_ray(cells):  # noqa: B007 - the last ones are looked at
        for cell in cells:
            if cell.folder in victims and trained_a_while(cell):
                kill_worker(cell, victims.pop(cell.folder))
    assert [status.status for status in statuses] == ["finished", "finished"]
    assert [len(status.warnings) for status in statuses] == [1, 1]
    assert "worker was lost (ActorDiedError: " in statuses[0].warnings[0]
    assert "worker was lost (killed by SIGKILL)" in statuses[1].warnings[0]
    for cell in cells:
        assert [line["from_step"] > 1000 for line in sessions(cell)] == [False, True]
    assert capfd.readouterr() == ("", ""), "Ray has said nothing"
    assert_same_grid(cells, straight)


def test_a_killed_process_changes_no_bit_of_a_run_group(tmp_path):
    """Its environments' processes end with it."""
    settings = {**SETTINGS, "max_updates": 6000, "acting_delay": 1}
    here, there = (
        make_grid(["Pendulum-v1"], ["sac", "sac-auto"], "quick", [0], tmp_path / name, overrides=settings)
        for name in ("local", "ray")
    )
    *_, statuses = launch(here, local_pool(1, 1, OFTEN, batch=2), Requests(), batch=2)
    assert {status.status for status in statuses} == {"finished"}
    killed = False
    for statuses in launch(there, ray_pool(HERE, 1, OFTEN), Requests(), batch=2):  # noqa: B007
        if not killed and all(trained_a_while(cell) for cell in there):
            killed = True
            kill_worker(there[0], ray_process)
    assert [status.status for status in statuses] == ["finished", "finished"]
    assert [len(status.warnings) for status in statuses] == [1, 1]
    assert_same_grid(there, here)


def test_local_workers_finish_what_was_stopped_on_ray(tmp_path, straight):
    cells, requests = grid(tmp_path), Requests()
    statuses: list[RunStatus] = []
    for statuses in on_ray(cells, requests):  # noqa: B007 - the last ones are looked at
        if trained_together(cells):
            requests.stop = 1
    assert [status.status for status in statuses] == ["interrupted", "interrupted"]
    assert all(is_dead(sessions(cell)[-1]["process"]) for cell in cells)
    finish_locally(cells)
    assert all(sessions(cell)[-1]["from_step"] > 1000 for cell in cells)
    assert_same_grid(cells, straight)


def test_a_grid_that_is_dropped_saves_and_leaves_no_process_behind(tmp_path):
    cells = grid(tmp_path)
    stream = on_ray(cells)
    while not trained_together(cells):
        next(stream)
    workers = [sessions(cell)[-1]["process"] for cell in cells]
    ray_processes = list(map(ray_process, workers))
    seen = [checkpoint_steps(cell.folder)[0] for cell in cells]
    stream.close()
    assert all(map(is_dead, workers))
    assert all(checkpoint_steps(cell.folder)[0] > step for cell, step in zip(cells, seen, strict=True))
    wait_for(lambda: all(map(is_dead, ray_processes)), seconds=120)


def test_the_run_of_a_lost_machine_goes_on_at_another(tmp_path, straight):
    from ray.cluster_utils import Cluster as Machines

    machines = Machines(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        second = machines.add_node(num_cpus=1)
        cells, statuses = grid(tmp_path), []
        cluster = Cluster(machines.address)
        for statuses in launch(cells, ray_pool(cluster, 1, OFTEN), Requests()):  # noqa: B007
            if second is not None and trained_together(cells):
                machines.remove_node(second, allow_graceful=False)
                second = None
        assert [status.status for status in statuses] == ["finished", "finished"]
        assert sorted(len(status.warnings) for status in statuses) == [0, 1]
        assert sorted(len(sessions(cell)) for cell in cells) == [1, 2]
        assert_same_grid(cells, straight)
    finally:
        machines.shutdown()


def compare_on_ray(folder: Path) -> tuple[subprocess.Popen[str], list[int]]:
    """`saclab compare` once both runs have trained a while, and its workers."""
    process, cells = start(folder, *WORDS, *ON_RAY), grid(folder / "runs")
    wait_for(lambda: process.poll() is not None or trained_together(cells))
    assert process.poll() is None, process.communicate()
    return process, [sessions(cell)[-1]["process"] for cell in cells]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_saves_on_a_signal_and_says_nothing_of_rays(tmp_path, straight, number):
    process, workers = compare_on_ray(tmp_path)
    process.send_signal(number)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 128 + number, output
    assert output.count("interrupted") == 2, output
    assert output.splitlines()[-1] == "saved; the same command continues where it stopped"
    assert "ray" not in output.lower()
    assert all(map(is_dead, workers))
    run(tmp_path, *WORDS, *ON_RAY)
    assert_same_grid(grid(tmp_path / "runs"), straight)


def test_nothing_writes_on_once_the_command_is_killed(tmp_path, straight):
    process, workers = compare_on_ray(tmp_path)
    process.kill()
    process.communicate(timeout=600)
    wait_for(lambda: all(map(is_dead, workers)), seconds=180)
    run(tmp_path, *WORDS)
    assert_same_grid(grid(tmp_path / "runs"), straight)


def test_a_cluster_that_is_not_there_or_too_small_is_a_users_error(tmp_path):
    began = time.monotonic()
    with pytest.raises(UserError, match=r"127\.0\.0\.1:1"):
        next(launch(grid(tmp_path), ray_pool(Cluster("127.0.0.1:1"), 1), Requests()))
    with pytest.raises(UserError, match="host:port"):
        next(launch(grid(tmp_path), ray_pool(Cluster("somewhere"), 1), Requests()))
    assert time.monotonic() - began < 60
    with pytest.raises(UserError, match=r"1000 cores and 0 GPUs .*--ray-cpus"):
        next(launch(grid(tmp_path), ray_pool(Cluster("local", cpus=1000), 1), Requests()))
    assert not list(tmp_path.iterdir())
