"""A tracker holds what the run's own logs hold, also of a run that was stopped and went on."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from saclab.cli import trackers
from saclab.errors import UserError
from saclab.extras import required
from saclab.protocols import make_config
from saclab.training import events
from saclab.training.loop import train
from saclab.training.requests import Requests
from saclab.training.run_folder import RunRecord, read_run

from .conftest import Told

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
    for _ in trackers.track(train(config, tmp_path), trackers.TensorBoard()):
        pass
    require_same_numbers(list(read_scalars(tmp_path / "tensorboard")), read_run(tmp_path))


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
    stream = trackers.track(train(config, folder, requests), tracker := trackers.MLflow("pendulum", config))
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

    for _ in trackers.track(train(config, folder), trackers.MLflow("pendulum", config)):
        pass
    (run,) = runs_in(mlflow, "pendulum")
    assert run.info.run_id == stopped.info.run_id
    assert run.info.status == "FINISHED"
    require_same_numbers(history(mlflow, run), read_run(folder))


def test_a_tracker_that_breaks_is_told_of_and_the_run_goes_on(tmp_path: Path, mlflow: Any) -> None:
    config = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS | {"max_updates": 10})
    tracker = trackers.MLflow("broken", config)
    tracker.HOLD_SECONDS = -1
    told = []
    for event in trackers.track(train(config, tmp_path), tracker):
        told.append(event)
        if isinstance(event, events.Started):
            mlflow.MlflowClient().delete_run(tracker.run)
    (warned,) = [event for event in told if isinstance(event, events.Warned)]
    assert "MLflow gets nothing more, and the run goes on" in warned.message
    assert isinstance(told[-1], events.Finished)


@pytest.mark.slow
def test_resume_goes_on_with_the_trackers_that_are_named(
    tmp_path: Path, mlflow: Any, saclab_again: Callable[..., Told]
) -> None:
    config, requests = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS), Requests()
    for event in train(config, tmp_path, requests):
        requests.stop = int(isinstance(event, events.UpdatesLogged))
    (tmp_path / "mlflow.txt").write_text("0123456789abcdef" * 2)  # a run of another MLflow
    told = saclab_again("resume", tmp_path, "--tensorboard", "--mlflow", "later", folder=tmp_path)
    assert told.status == 0, told.errors
    (run,) = runs_in(mlflow, "later")
    assert (tmp_path / "mlflow.txt").read_text() == run.info.run_id + "\n"
    since_then = read_run(tmp_path).metrics["steps"].tolist()[1:]
    for numbers in (history(mlflow, run), list(read_scalars(tmp_path / "tensorboard"))):
        assert [step for name, step, _ in numbers if name == "losses/critic_loss"] == since_then


def test_a_server_that_does_not_answer_is_named(mlflow: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(UserError, match=r"--mlflow e: http://127.0.0.1:9 cannot be used: .*MLFLOW_TRACKING_URI"):
        trackers.MLflow("e", config)


def test_a_missing_extra_says_how_to_install_it() -> None:
    with pytest.raises(UserError, match=r"--thing needs .*pip install '\.\[thing\]'"):
        required("no_such_package_for_sure", "thing", "--thing")
