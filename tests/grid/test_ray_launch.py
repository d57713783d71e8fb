"""What the launcher of a Ray cluster makes of workers that are lost, without Ray: a stand-in answers for it."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from saclab import api
from saclab.errors import SettingError, UserError
from saclab.grid import ray as ray_launch
from saclab.grid.cluster import Cluster, chosen_cluster
from saclab.grid.launch import LOSSES
from saclab.grid.launch import launch as launch_grid
from saclab.grid.plan import Cell, make_grid
from saclab.grid.ray import ray_pool, worker_variables
from saclab.grid.tasks import RunStatus
from saclab.training.requests import Requests

SETTINGS = {"hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 200}


def grid(runs: Path) -> list[Cell]:
    return make_grid(["Pendulum-v1"], ["sac", "sac-auto"], "quick", [0], runs, overrides=SETTINGS)


class Lost(Exception):  # noqa: N818
    """What Ray says of a lost worker or machine."""


def says(*messages: dict[str, Any], code: int | None = None) -> dict[str, Any]:
    return {"messages": [{"run": 0, **message} for message in messages], "code": code, "errors": ""}


class StandIn:
    """As much of Ray as a grid uses. Each poll of a worker calls `answer(run folder, number of the worker)`."""

    exceptions = SimpleNamespace(RayError=Lost)

    def __init__(self, answer: Callable[[Path, int], dict[str, Any]], room: int = 100) -> None:
        self.answer, self.room = answer, room
        self.workers: dict[Path, int] = {}
        self.alive: list[Actor] = []
        self.most_alive = 0

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": {"CPU": 1.0}}]

    def remote(self, actor_type: type) -> Any:
        return SimpleNamespace(options=lambda **options: SimpleNamespace(remote=self.start))

    def start(self, task: dict[str, Any], *rest: object, **more: object) -> Actor:
        folder = Path(task["runs"][0]["folder"])
        self.workers[folder] = self.workers.get(folder, 0) + 1
        self.alive.append(Actor(folder, self.workers[folder]))
        self.most_alive = max(self.most_alive, len(self.alive))
        return self.alive[-1]

    def wait(self, answers: list[Poll], num_returns: int, timeout: float) -> tuple[list[Poll], list[Poll]]:
        return [poll for poll in answers if poll.actor in self.alive[: self.room]], []

    def get(self, poll: Poll | None) -> dict[str, Any]:
        return (
            says(code=0)
            if poll is None or poll.actor.told_to_stop
            else self.answer(poll.actor.folder, poll.actor.number)
        )

    def kill(self, actor: Actor) -> None:
        self.alive.remove(actor)


class Actor:
    def __init__(self, folder: Path, number: int) -> None:
        self.folder, self.number, self.told_to_stop = folder, number, False
        self.poll = SimpleNamespace(remote=lambda seconds: Poll(self))
        self.stop = self.finish = SimpleNamespace(remote=self._stop)

    def _stop(self) -> None:
        self.told_to_stop = True


class Poll:
    def __init__(self, actor: Actor) -> None:
        self.actor = actor


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Iterator[list[RunStatus]]]:
    """Launch the grid of two runs on a stand-in."""

    def on(ray: StandIn, workers: int | None = None, requests: Requests | None = None) -> Iterator[list[RunStatus]]:
        @contextmanager
        def connected(cluster: Cluster) -> Iterator[StandIn]:
            yield ray

        monkeypatch.setattr(ray_launch, "connected", connected)
        return launch_grid(grid(tmp_path), ray_pool(Cluster(), 1, workers=workers), requests or Requests())

    return on


def test_a_lost_worker_is_replaced_and_the_run_says_so(launch):
    def answer(folder: Path, number: int) -> dict[str, Any]:
        if "sac-auto" in folder.parts and number == 1:
            raise Lost("a stack\n  The machine is gone. Some advice.")
        return says({"event": "finished"}, code=0)

    *_, (first, second) = launch(ray := StandIn(answer))
    assert (first.status, first.warnings) == ("finished", [])
    assert second.status == "finished"
    assert second.warnings == ["its worker was lost (Lost: The machine is gone): continued from the last checkpoint"]
    assert sorted(ray.workers.values()) == [1, 2]
    assert not ray.alive


@pytest.mark.parametrize("code", [-signal.SIGKILL, 0])
def test_a_worker_that_the_system_kills_or_stops_is_lost_too(launch, code):
    def answer(folder: Path, number: int) -> dict[str, Any]:
        if number == 1:
            return says(*[{"event": "interrupted"}] * (code == 0), code=code)
        return says({"event": "finished"}, code=0)

    *_, statuses = launch(ray := StandIn(answer))
    assert [status.status for status in statuses] == ["finished", "finished"]
    assert all("lost" in status.warnings[0] for status in statuses)
    assert set(ray.workers.values()) == {2}


def test_a_run_that_keeps_losing_workers_fails_alone(launch):
    def answer(folder: Path, number: int) -> dict[str, Any]:
        if "sac-auto" in folder.parts:
            raise Lost("bad luck")
        return says({"event": "finished"}, code=0)

    *_, (first, second) = launch(ray := StandIn(answer))
    assert first.status == "finished"
    assert second.status == "failed"
    assert "bad luck" in second.message
    assert len(second.warnings) == LOSSES
    assert max(ray.workers.values()) == LOSSES + 1
    assert not ray.alive


def test_losses_are_counted_anew_once_the_run_got_further(launch):
    def answer(folder: Path, number: int) -> dict[str, Any]:
        if number <= 3 * LOSSES:
            (folder / "checkpoints" / f"step-{number // 2:012d}").mkdir(parents=True, exist_ok=True)
            raise Lost("preempted")
        return says({"event": "finished"}, code=0)

    *_, statuses = launch(StandIn(answer))
    assert [status.status for status in statuses] == ["finished", "finished"]
    assert len(statuses[0].warnings) == 3 * LOSSES


def test_a_run_that_fails_is_not_tried_again(launch):
    *_, statuses = launch(ray := StandIn(lambda folder, number: says({"event": "failed", "message": "why"}, code=1)))
    assert [(status.status, status.message) for status in statuses] == [("failed", "why")] * 2
    assert set(ray.workers.values()) == {1}


def test_stopping_lets_the_started_save_and_takes_back_the_others(launch):
    ray, requests = StandIn(lambda folder, number: says(), room=1), Requests()
    for statuses in launch(ray, requests=requests):
        if statuses[0].status == "running":
            assert statuses[1].status == "waiting"
            requests.stop = 1
    assert statuses[1].status == "waiting"
    assert set(ray.workers.values()) == {1}
    assert not ray.alive


def test_a_grid_that_is_dropped_leaves_no_worker_behind(launch):
    stream = launch(ray := StandIn(lambda folder, number: says()))
    next(stream)
    workers = list(ray.alive)
    stream.close()
    assert len(workers) == 2
    assert all(worker.told_to_stop for worker in workers)
    assert not ray.alive


def test_no_more_tasks_are_on_the_cluster_than_asked_for(launch):
    *_, statuses = launch(ray := StandIn(lambda folder, number: says({"event": "finished"}, code=0)), workers=1)
    assert [status.status for status in statuses] == ["finished", "finished"]
    assert ray.most_alive == 1


def test_settings_of_ray_are_refused_where_they_cannot_work():
    assert chosen_cluster("local", 1, None, None, 0.0) is None
    assert chosen_cluster("ray", 3, None, None, 0.0) == Cluster(None, 3, 0.0)
    assert chosen_cluster("ray", 3, "somewhere:6379", 0.5, 0.25) == Cluster("somewhere:6379", 0.5, 0.25)
    for name, settings in {
        "ray_address": ("auto", None, 0.0), "ray_cpus": (None, 2.0, 0.0), "ray_gpus": (None, None, 0.5)
    }.items():  # fmt: skip
        with pytest.raises(SettingError, match=f"{name} = .*launcher ray"):
            chosen_cluster("local", 1, *settings)
    for name, cpus, gpus in (("ray_cpus", 0.0, 0.0), ("ray_cpus", float("nan"), 0.0), ("ray_gpus", 1.0, 1.5)):
        with pytest.raises(SettingError, match=name):
            chosen_cluster("ray", 1, None, cpus, gpus)
    with pytest.raises(UserError, match="did you mean 'ray'"):
        chosen_cluster("rat", 1, None, None, 0.0)


def test_without_the_package_compare_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"--launcher ray .*pip install '\.\[ray\]'"):
        api.compare(["Pendulum-v1"], ["sac"], 1, "quick", runs=tmp_path, launcher="ray")
    assert not list(tmp_path.iterdir())


def test_a_workers_variables_hold_threads_gpus_and_what_the_user_told_jax(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("XLA_FLAGS", "--xla_some_flag=1")
    assert worker_variables(2, 0.0).items() >= {
        "OMP_NUM_THREADS": "2", "NPROC": "2", "XLA_FLAGS": "--xla_some_flag=1", "CUDA_VISIBLE_DEVICES": ""
    }.items()  # fmt: skip
    shared = worker_variables(1, 0.5)
    assert "CUDA_VISIBLE_DEVICES" not in shared, "Ray names the GPU"
    assert shared["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.375"
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION" not in worker_variables(1, 1.0)
