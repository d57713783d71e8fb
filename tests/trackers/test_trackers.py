"""A tracker holds what the run's own logs hold, also of a run that was stopped and went on."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from saclab.api import compare
from saclab.errors import UserError
from saclab.extras import required
from saclab.protocols import make_config
from saclab.trackers import services
from saclab.trackers.asked import Tracking
from saclab.trackers.feed import track, track_runs
from saclab.training import events
from saclab.training.loop import train
from saclab.training.requests import Requests
from saclab.training.run_folder import RunRecord, read_run

SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 400, "log_interval": 50,
    "evaluation_interval_steps": 200, "evaluation_episodes": 2, "update_interval": 1,
}  # fmt: skip


def read_scalars(folder: Path) -> Iterator[tuple[str, int, float]]:
    """Name, step and value of each scalar in a folder's event files (TFRecord: length, checksum, content, checksum)."""
    for path in sorted(folder.glob("events.*")):
        content, position = path.read_bytes(), 0
        while position < len(content):
            (length,) = struct.unpack_from("<Q", content, position)
            event = Event.FromString(content[position + 12 : position + 12 + length])
            position += 12 + length + 4
            for value in event.summary.value:
                yield value.tag, event.step, value.simple_value


def require_same_numbers(scalars: list[tuple[str, int, float]], run: RunRecord) -> None:
    """What a tracker has is what the run's own logs have, each number once."""
    for tag, steps, values in (
        ("evaluation/mean_return", run.evaluations["steps"], run.evaluations["mean_return"]),
        ("training/return", run.episodes["steps"], run.episodes["return"]),
        ("losses/critic_loss", run.metrics["steps"], run.metrics["critic_loss"]),
    ):
        logged = [(step, value) for name, step, value in scalars if name == tag]
        assert [step for step, _ in logged] == steps.tolist()
        np.testing.assert_allclose([value for _, value in logged], values, rtol=1e-6)
        assert len(logged) > 0


def test_tensorboard_files_hold_the_runs_numbers(tmp_path: Path) -> None:
    config = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS)
    for _ in track(train(config, tmp_path), [services.TensorBoard()]):
        pass
    require_same_numbers(list(read_scalars(tmp_path / "tensorboard")), read_run(tmp_path))


class Noting:
    """A tracker that notes what it is given, and may break."""

    def __init__(self, breaks_at: str = "") -> None:
        self.breaks_at, self.noted = breaks_at, list[Any]()

    def note(self, what: str, *values: Any) -> None:
        if what == self.breaks_at:
            raise ValueError("out of order")
        self.noted.append((what, *values))

    def check(self) -> None:
        self.note("check")

    def open(self, started: events.Started) -> None:
        self.note("open", started.run)

    def log(self, values: Mapping[str, float], step: int) -> None:
        self.note("log", step, *values)

    def close(self, finished: bool) -> None:
        self.note("close", finished)


class Sound(Noting):
    """Of another kind."""


LOSS = {"critic_loss": 1.0}
OF_TWO_RUNS: list[tuple[int, events.Event]] = [
    (0, events.Started(Path("a"), 0, ("ratio",))),
    (1, events.Started(Path("b"), 0, ("ratio",))),
    (1, events.UpdatesLogged(10, 1, LOSS)),
    (0, events.UpdatesLogged(11, 1, LOSS)),
    (1, events.Failed("broken")),
    (0, events.UpdatesLogged(12, 2, LOSS)),
    (0, events.Finished("updates", 12, 2, 0, 0.0, 0.0)),
]


def test_each_run_of_a_group_has_trackers_of_its_own():
    first, second = Noting(), Noting()
    assert list(track_runs(OF_TWO_RUNS, [[first], [second]])) == OF_TWO_RUNS
    loss = "losses/critic_loss"
    assert first.noted == [("open", Path("a")), ("log", 11, loss), ("log", 12, loss), ("close", True)]
    assert second.noted == [("open", Path("b")), ("log", 10, loss), ("close", False)]


@pytest.mark.parametrize(
    ("breaks_at", "said", "noted"),
    [("open", "Noting cannot be used, and the run goes on without it: ", []),
     ("log", "Noting gets nothing more, and the run goes on: ", ["open"]),
     ("close", "Noting did not get the run's last numbers: ", ["open", "log", "log"])],
)  # fmt: skip
def test_a_tracker_that_breaks_is_warned_of_once_and_others_go_on(breaks_at, said, noted):
    broken, sound = Noting(breaks_at), Sound()
    passed = list(track_runs(OF_TWO_RUNS, [[broken, sound], []]))
    (warned,) = [each for each in passed if each not in OF_TWO_RUNS]
    assert warned[0] == 0
    assert warned[1].message.startswith(said)
    assert "out of order" in warned[1].message
    assert [what for what, *_ in broken.noted] == noted
    assert [what for what, *_ in sound.noted] == ["open", "log", "log", "close"]


def test_a_service_that_failed_one_run_of_a_group_is_not_asked_again():
    first, second = Noting(), Noting("log")
    passed = list(track_runs(OF_TWO_RUNS, [[first], [second]]))
    assert len(passed) == len(OF_TWO_RUNS) + 1
    assert [what for what, *_ in first.noted] == [what for what, *_ in second.noted] == ["open"]


def test_trackers_are_closed_when_nobody_goes_on_with_the_runs():
    tracker = Noting()
    stream = track_runs(OF_TWO_RUNS, [[tracker], []])
    next(stream)
    stream.close()
    assert tracker.noted[-1] == ("close", False)


@pytest.fixture(scope="module")
def mlflow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """MLflow, which keeps what it gets in a database of these tests."""
    module = pytest.importorskip("mlflow")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path_factory.mktemp('mlflow')}/mlflow.db")
        yield module


def runs_in(mlflow: Any, experiment: str) -> list[Any]:
    client = mlflow.MlflowClient()
    return list(client.search_runs([client.get_experiment_by_name(experiment).experiment_id]))


def history(mlflow: Any, run: Any) -> list[tuple[str, int, float]]:
    """Name, step and value of each number of a run in MLflow."""
    client = mlflow.MlflowClient()
    return [
        (name, metric.step, metric.value)
        for name in run.data.metrics
        for metric in client.get_metric_history(run.info.run_id, name)
    ]


def test_a_run_killed_and_resumed_is_one_run_of_mlflow(tmp_path: Path, mlflow: Any) -> None:
    config, folder, requests = (
        make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS),
        tmp_path / "run",
        Requests(),
    )
    stream = track(train(config, folder, requests), [tracker := services.MLflow("pendulum", config)])
    for event in stream:
        if isinstance(event, events.UpdatesLogged):
            requests.save = event.updates == 100
            tracker._send()
            if event.updates == 200:  # those after the last checkpoint are logged again when the run goes on
                break
    stream.close()
    (stopped,) = runs_in(mlflow, "pendulum")
    assert stopped.info.status == "KILLED"
    assert stopped.data.params["discount"] == "0.99"
    assert stopped.data.params["environment"] == "Pendulum-v1"

    for _ in track(train(config, folder), [services.MLflow("pendulum", config)]):
        pass
    (run,) = runs_in(mlflow, "pendulum")
    assert run.info.run_id == stopped.info.run_id
    assert run.info.status == "FINISHED"
    require_same_numbers(history(mlflow, run), read_run(folder))


def test_a_tracker_that_breaks_is_told_of_and_the_run_goes_on(tmp_path: Path, mlflow: Any) -> None:
    config = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS | {"max_updates": 10})
    tracker = services.MLflow("broken", config)
    tracker.HOLD_SECONDS = -1
    told = []
    for event in track(train(config, tmp_path), [tracker]):
        told.append(event)
        if isinstance(event, events.Started):
            mlflow.MlflowClient().delete_run(tracker.run)
    (warned,) = [event for event in told if isinstance(event, events.Warned)]
    assert "MLflow gets nothing more, and the run goes on" in warned.message
    assert isinstance(told[-1], events.Finished)


@pytest.mark.slow
def test_resume_goes_on_with_the_trackers_that_are_named(tmp_path: Path, mlflow: Any) -> None:
    config, requests = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS), Requests()
    for event in train(config, tmp_path, requests):
        requests.stop = int(isinstance(event, events.UpdatesLogged))
    (tmp_path / "mlflow.txt").write_text("0123456789abcdef" * 2)  # a run of another MLflow
    words = [sys.executable, "-m", "saclab", "resume", str(tmp_path), "--tensorboard", "--mlflow", "later"]
    subprocess.run(words, check=True, capture_output=True)
    (run,) = runs_in(mlflow, "later")
    assert (tmp_path / "mlflow.txt").read_text() == run.info.run_id + "\n"
    since_then = read_run(tmp_path).metrics["steps"].tolist()[1:]
    for numbers in (history(mlflow, run), list(read_scalars(tmp_path / "tensorboard"))):
        assert [step for name, step, _ in numbers if name == "losses/critic_loss"] == since_then


@pytest.mark.slow
@pytest.mark.parametrize("batch", [0, 2])
def test_every_run_of_a_comparison_is_tracked(tmp_path: Path, mlflow: Any, batch: int) -> None:
    """In processes of their own, and two as one run group; one that is finished already sends nothing."""
    experiment = f"comparison {batch}"
    tracking = Tracking(tensorboard=True, mlflow=experiment)
    for seeds in (1, 2):
        result = compare(
            ["Pendulum-v1"], ["sac", "sac-auto"], seeds, "quick",
            runs=tmp_path, workers=2, batch=batch, tracking=tracking, **SETTINGS,
        )  # fmt: skip
        assert not result.failed
    sent = {run.info.run_name: run for run in runs_in(mlflow, experiment)}
    assert len(sent) == len(runs_in(mlflow, experiment)) == 4
    for run in result.runs:
        require_same_numbers(history(mlflow, sent["-".join(run.path.parts[-4:])]), run)
        require_same_numbers(list(read_scalars(run.path / "tensorboard")), run)


def test_a_comparison_is_refused_before_it_starts_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"--wandb needs .*pip install"):
        compare(["Pendulum-v1"], ["sac"], 1, "quick", runs=tmp_path, tracking=Tracking(wandb="project"))
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_does_not_answer_is_named(mlflow: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(UserError, match=r"--mlflow e: http://127.0.0.1:9 cannot be used: .*MLFLOW_TRACKING_URI"):
        Tracking(mlflow="e").usable(config, Path("run"))


def test_a_missing_extra_says_how_to_install_it() -> None:
    with pytest.raises(UserError, match=r"--thing needs .*pip install '\.\[thing\]'"):
        required("no_such_package_for_sure", "thing", "--thing")
