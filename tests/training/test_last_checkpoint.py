"""What a finished run leaves does not depend on when checkpoints were taken."""

from __future__ import annotations

from pathlib import Path

from saclab.protocols import make_config
from saclab.training.checkpoint import newest_first, read_manifest
from saclab.training.loop import train

SETTINGS = {
    "hidden_layers": (8,), "batch_size": 16, "random_steps": 100, "max_updates": 30, "update_interval": 1,
    "evaluation_interval_steps": 60, "evaluation_episodes": 1,
}  # fmt: skip


def last_counters(folder: Path, checkpoint_minutes: float) -> dict[str, object]:
    config = make_config("Pendulum-v1", "sac", "quick", overrides=SETTINGS)
    for _ in train(config, folder, checkpoint_minutes=checkpoint_minutes):
        pass
    counters = read_manifest(newest_first(folder / "checkpoints")[0]).state["counters"]
    return {name: value for name, value in counters.items() if name != "seconds"}


def test_the_last_checkpoint_is_the_one_after_the_last_evaluation(tmp_path: Path) -> None:
    """However often the run was saved."""
    always, once = last_counters(tmp_path / "always", 0.0), last_counters(tmp_path / "once", 10.0)
    assert always == once
    assert (once["evaluations"], once["evaluated_at_update"]) == (3, 30)  # at steps 60 and 120, and at the end
