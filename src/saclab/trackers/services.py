"""TensorBoard, Weights & Biases, MLflow: a small class each."""

from __future__ import annotations

import os
import re
import secrets
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from saclab.config import Config, flatten
from saclab.errors import UserError, in_words
from saclab.extras import required
from saclab.files import replace_file
from saclab.training import events


def name_of(folder: Path) -> str:
    """A run's name in a tracker: environment, variant, protocol and seed, as in its path."""
    return "-".join(folder.parts[-4:])


class TensorBoard:
    """Event files in the run folder's `tensorboard`; a resumed run takes back what it had logged too far."""

    def __init__(self) -> None:
        """Raises UserError if the extra is not installed."""
        self.writer_type: Any = required("tensorboardX", "tensorboard", "--tensorboard").SummaryWriter

    def check(self) -> None:
        """Files can be written as soon as there is a run folder."""

    def open(self, started: events.Started) -> None:
        self.writer = self.writer_type(str(started.run / "tensorboard"), purge_step=started.resumed_at_step + 1)

    def log(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)

    def close(self, finished: bool) -> None:
        self.writer.close()


class WeightsAndBiases:
    """A run at Weights & Biases, under an id that lies in the run folder, so that a resumed run goes on there.

    It is the run's alone: one of the same path elsewhere, or trained anew, has another.

    The seeds of an arm are a group there.
    """

    def __init__(self, project: str, config: Config, folder: Path) -> None:
        """Raises UserError if the extra is not installed."""
        self.project, self.config, self.folder = project, config, folder
        self.module: Any = required("wandb", "wandb", "--wandb")

    def check(self) -> None:
        """Ask for the key at a terminal, if there is none yet."""
        try:
            ready = self.module.setup().settings.mode != "online" or self.module.login()
        except Exception as error:
            raise UserError(f"--wandb {self.project}: {in_words(error)}; {LOGIN}") from error
        if not ready:
            raise UserError(f"--wandb {self.project}: not logged in; {LOGIN}")

    def open(self, started: events.Started) -> None:
        name, known = name_of(self.folder), started.run / "wandb.txt"
        if not known.exists():
            replace_file(known, f"{name}-{secrets.token_hex(4)}\n".encode())
        self.run = self.module.init(
            project=self.project, name=name, id=known.read_text().strip(), group="-".join(self.folder.parts[-4:-1]),
            resume="allow", config=self.config.to_dict(), dir=str(self.folder),
            reinit="create_new",  # a run group has several at a time in one process
        )  # fmt: skip

    def log(self, values: Mapping[str, float], step: int) -> None:
        self.run.log(dict(values), step=step)

    def close(self, finished: bool) -> None:
        self.run.finish()


LOGIN = "use `wandb login` or WANDB_API_KEY, or WANDB_MODE=offline to keep it on this machine"
PATIENCE = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}
"""MLflow's own are minutes of silence before a server that does not answer is told of."""


class MLflow:
    """A run of an MLflow experiment; its id lies in the run folder, so that a resumed run goes on there.

    Nothing can be taken back from MLflow, and a second value of a step would stand beside the first one. So a resumed
    run logs nothing of a step that MLflow has already: it goes on bit for bit, and the numbers are the same.
    """

    HOLD_SECONDS = 2.0
    """Numbers are sent together: a request takes as long as several steps."""

    def __init__(self, experiment: str, config: Config) -> None:
        """Raises UserError if the extra is not installed."""
        for name, value in PATIENCE.items():
            os.environ.setdefault(name, value)
        self.mlflow: Any = required("mlflow", "mlflow", "--mlflow")
        self.name, self.config = experiment, config
        self.held: list[Any] = []
        self.sent_at = time.monotonic()

    def check(self) -> None:
        """Find the experiment, or make it."""
        try:
            self.client = self.mlflow.MlflowClient()
            found = self.client.get_experiment_by_name(self.name)
            self.experiment = self.client.create_experiment(self.name) if found is None else found.experiment_id
        except Exception as error:
            place = self.mlflow.get_tracking_uri()
            raise UserError(
                f"--mlflow {self.name}: {place} cannot be used: {in_words(error)}; the environment variable "
                "MLFLOW_TRACKING_URI names a server or a database"
            ) from error

    def open(self, started: events.Started) -> None:
        self.check()
        known = started.run / "mlflow.txt"
        self.run = self._found(known) or self._made(name_of(started.run))
        replace_file(known, f"{self.run}\n".encode())
        self.client.update_run(self.run, status="RUNNING")
        self.logged = {
            name: max(metric.step for metric in self.client.get_metric_history(self.run, name))
            for name in self.client.get_run(self.run).data.metrics
        }

    def _found(self, known: Path) -> str | None:
        """The run whose id a file holds, if MLflow has it."""
        run = known.read_text(errors="replace").strip() if known.exists() else ""
        if not re.fullmatch("[0-9a-f]{32}", run):
            return None
        try:
            found = self.client.get_run(run)
        except self.mlflow.MlflowException as error:
            if error.error_code == "RESOURCE_DOES_NOT_EXIST":
                return None
            raise
        here = found.info.experiment_id == self.experiment and found.info.lifecycle_stage == "active"
        return run if here else None

    def _made(self, name: str) -> str:
        """A new run with the settings as its parameters."""
        run: str = self.client.create_run(self.experiment, run_name=name).info.run_id
        settings = flatten(self.config.to_dict())
        parameters = [self.mlflow.entities.Param(key, str(value)) for key, value in settings.items()]
        for start in range(0, len(parameters), 100):  # MLflow takes no more at once
            self.client.log_batch(run, params=parameters[start : start + 100])
        return run

    def log(self, values: Mapping[str, float], step: int) -> None:
        now = int(1000 * time.time())
        self.held += [
            self.mlflow.entities.Metric(name, value, now, step)
            for name, value in values.items()
            if step > self.logged.get(name, -1)
        ]
        if time.monotonic() - self.sent_at > self.HOLD_SECONDS:
            self._send()

    def _send(self) -> None:
        for start in range(0, len(self.held), 1000):  # MLflow takes no more at once
            self.client.log_batch(self.run, metrics=self.held[start : start + 1000])
        self.held, self.sent_at = [], time.monotonic()

    def close(self, finished: bool) -> None:
        self._send()
        self.client.set_terminated(self.run, "FINISHED" if finished else "KILLED")
