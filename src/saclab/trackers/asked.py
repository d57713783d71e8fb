"""Which trackers are asked for; light, so that the command line can show them at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from saclab.config import Config

if TYPE_CHECKING:
    from saclab.trackers.feed import Tracker


@dataclass(frozen=True)
class Tracking:
    """Where a run's numbers are sent while it goes on, besides its own logs: nowhere, unless it is said."""

    tensorboard: bool = False
    """Write TensorBoard event files into the run folder; needs the extra `tensorboard`."""
    wandb: str | None = None
    """Send the run to this project of Weights & Biases; needs the extra `wandb`."""
    mlflow: str | None = None
    """Send the run to this experiment of MLflow, at MLFLOW_TRACKING_URI, or else in ./mlflow.db; needs the extra
    `mlflow`."""

    @property
    def any(self) -> bool:
        """Whether one is asked for."""
        return self.tensorboard or self.wandb is not None or self.mlflow is not None

    def trackers(self, config: Config, folder: Path) -> list[Tracker]:
        """Those that were asked for, of a run; raises UserError if an extra is missing."""
        from saclab.trackers import services

        chosen: list[Tracker] = []
        if self.tensorboard:
            chosen.append(services.TensorBoard())
        if self.wandb is not None:
            chosen.append(services.WeightsAndBiases(self.wandb, config, folder))
        if self.mlflow is not None:
            chosen.append(services.MLflow(self.mlflow, config))
        return chosen

    def usable(self, config: Config, folder: Path) -> list[Tracker]:
        """The same; raises UserError too if a service does not answer or will not have this user."""
        found = self.trackers(config, folder)
        for tracker in found:
            tracker.check()
        return found


NOWHERE = Tracking()
VARIABLES = ("WANDB_", "MLFLOW_")
"""What the names of environment variables begin with by which a user tells trackers where to send to, and as whom."""
WANDB_HERE = "WANDB_SERVICE"
"""The one that is about a process of this machine."""


def trackers_of(tracking: Tracking, runs: Sequence[tuple[Config, Path]]) -> list[list[Tracker]]:
    """For each run those that were asked for; none of one that is finished, of which nothing comes."""
    from saclab.training.run_folder import is_finished

    return [[] if is_finished(folder) else tracking.trackers(config, folder) for config, folder in runs]
