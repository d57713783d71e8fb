"""Real learning, judged over seeds: minutes, so marked slow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import saclab
from saclab.variants import VARIANTS

SOLVED = -200.0  # mean evaluation return of Pendulum-v1 that counts as solved; a random policy has about -1200
KEPT = -600.0  # what the median of its last three evaluations has to exceed
SEEDS = 2


SHORT = {"discount": 0.975}  # episodes of 200 steps
OTHERWISE = {
    "tqc": {"critic_hidden_layers": (64, 64), "dropped_quantiles": 1, "polyak_rate": 0.01},
    "crossq": {"critic_hidden_layers": (128, 128), "max_updates": 8000},
    "xqc": SHORT
    | {"critic_hidden_layers": (64, 64), "updates_per_interval": 2, "actor_interval": 1, "max_updates": 12_000},
    "simbav2": SHORT | {"hidden_layers": (32,), "critic_hidden_layers": (64,), "max_updates": 8000},
    "flashsac": SHORT | {"hidden_layers": (32, 32), "critic_hidden_layers": (32, 32), "max_updates": 6000},
}
"""What a variant needs beside the protocol to be steady after so few updates."""


SETTINGS = {
    "update_interval": 1, "random_steps": 1000, "hidden_layers": (64, 64), "max_updates": 5000,
    "evaluation_interval_steps": 1000, "evaluation_episodes": 20,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("variant", [name for name, row in VARIANTS.items() if not row.needs])
def test_every_variant_solves_pendulum_on_every_seed(variant: str, tmp_path: Path) -> None:
    changes = OTHERWISE.get(variant, {})
    result = saclab.compare(
        ["Pendulum-v1"], [variant], SEEDS, "quick", runs=tmp_path, **(SETTINGS | changes),
    )  # fmt: skip
    assert not result.failed
    # Numbers depend on the CPU, and now and then an evaluation falls into a dip of a policy that has learned: so
    # each seed has to solve it once, and to keep most of that.
    returns = {run.config.seed: run.evaluations["mean_return"] for run in result.runs}
    assert len(returns) == SEEDS
    assert {seed: each for seed, each in returns.items() if max(each) <= SOLVED} == {}
    assert {seed: each for seed, each in returns.items() if np.median(each[-3:]) <= KEPT} == {}
