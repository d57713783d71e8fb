"""Event files hold what the run's own logs hold."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from saclab.cli import trackers
from saclab.errors import UserError
from saclab.extras import required
from saclab.protocols import make_config
from saclab.training.loop import train
from saclab.training.run_folder import read_run

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


def test_tensorboard_files_hold_the_runs_numbers(tmp_path: Path) -> None:
    config = make_config("Pendulum-v1", "sac-auto", "quick", overrides=SETTINGS)
    for _ in trackers.tensorboard(train(config, tmp_path)):
        pass
    run, scalars = read_run(tmp_path), list(read_scalars(tmp_path / "tensorboard"))
    for tag, steps, values in (
        ("evaluation/mean_return", run.evaluations["steps"], run.evaluations["mean_return"]),
        ("training/return", run.episodes["steps"], run.episodes["return"]),
        ("losses/critic_loss", run.metrics["steps"], run.metrics["critic_loss"]),
    ):
        logged = [(step, value) for name, step, value in scalars if name == tag]
        assert [step for step, _ in logged] == steps.tolist()
        np.testing.assert_allclose([value for _, value in logged], values, rtol=1e-6)
        assert len(logged) > 0


def test_a_missing_extra_says_how_to_install_it() -> None:
    with pytest.raises(UserError, match=r"--thing needs .*pip install 'saclab\[thing\]'"):
        required("no_such_package_for_sure", "thing", "--thing")
