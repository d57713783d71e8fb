"""Runs of a run group learn as runs alone do: real learning, judged over seeds, so marked slow."""

from __future__ import annotations

import numpy as np
import pytest

import saclab

SEEDS = 8
SETTINGS = {
    "update_interval": 1, "random_steps": 1000, "hidden_layers": (64, 64), "max_updates": 3000, "acting_delay": 1,
    "evaluation_interval_steps": 500, "evaluation_episodes": 10,
}  # fmt: skip


@pytest.mark.slow
def test_curves_on_pendulum_agree(tmp_path):
    """The area under the learning curve of each seed: a difference of means well within its standard error."""
    areas = {}
    for name, batch in (("alone", 0), ("group", SEEDS)):
        result = saclab.compare(
            ["Pendulum-v1"], ["sac-auto"], SEEDS, "quick", batch=batch, runs=tmp_path / name, **SETTINGS
        )
        assert not result.failed
        curves = np.array([run.evaluations["mean_return"] for run in result.runs])
        assert len(curves) == SEEDS
        areas[name] = curves.mean(axis=1)
        assert np.median(curves[:, -1]) > -500, "most of the task is learned"
        assert curves[:, :3].mean() < -400, "and was not at the start"
    difference = areas["alone"].mean() - areas["group"].mean()
    standard_error = np.sqrt(sum(area.var(ddof=1) / SEEDS for area in areas.values()))
    assert abs(difference) < 4 * standard_error, "one draw in some thousands, if they learn alike"
    assert len({*areas["alone"], *areas["group"]}) == 2 * SEEDS, "they are not the same runs to the bit"
