"""The tables of docs/curriculum.md, from made-up runs whose measures are known."""

from __future__ import annotations

import csv
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from saclab.training.logs import reward_term_columns

from .synthetic import write_run

RESULTS = Path(__file__).parents[2] / "examples" / "curriculum" / "results.py"


def write_arm(root: Path, environment: str, name: str, seed: int, values: list[tuple[float, float]]) -> None:
    """A run of which each evaluation has these returns of the forward and of the control term, and nothing else."""
    forward = {"HalfCheetah-v4": "reward_run", "Humanoid-v4": "reward_linvel"}[environment]
    terms = (forward, "reward_ctrl")
    scheduled = {} if name == "sac-auto" else {"reward_schedule": ("reward_ctrl: 1@0",)}
    folder = write_run(
        root, "sac-auto", seed, environment, overrides={"reward_terms": terms, **scheduled},
        name=None if name == "sac-auto" else name, returns=[sum(pair) for pair in values], finished=bool(values),
    )  # fmt: skip
    with (folder / "reward_terms.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(reward_term_columns(terms))
        for index, pair in enumerate(values, start=1):
            writer.writerow([index, 10_000 * index, 2000 * index, 10 * index, *pair, 0.0, 1.0, 1.0, 20.0 * index])


def printed(root: Path) -> str:
    return subprocess.run([sys.executable, RESULTS, root], capture_output=True, text=True, check=True).stdout


def test_areas_finals_and_pairs_by_hand(tmp_path):
    """Twenty evaluations of episodes of 1000 steps, the last two of which are final; the forward term alone is paid."""
    for seed in range(4):
        for name, first, last in (("sac-auto", 1000, 2000), ("curriculum", 500, 3000)):
            values = [(first + seed, 0.0)] * 18 + [(last + seed, 0.0)] * 2
            write_arm(tmp_path, "Humanoid-v4", name, seed, values)
    table = printed(tmp_path)
    area = 1000 + 1000 * 1.5 / 19  # of nineteen equal spans, one rises and one stays above
    assert (
        f"| `sac-auto` | 0 | {area:.0f} | 2000 | 1000 | 1000 | {area:.0f} | 2000 | 1.08 | 2.00 | 1000 | nan |" in table
    )
    (final,) = [line for line in table.splitlines() if line.startswith("| H2, H3") and "| return, final |" in line]
    assert "| +1000 [+998, +1002] | 1.00 [0.58, 1.00] | yes |" in final
    assert "| episode length, area | +0 [+0, +0] | 0.50 [" in table
    assert "| `curriculum` − `sac-auto` | Q bias | not measured | |  |" in table
    assert "H1" not in table


def test_the_late_bias_and_the_first_tenth_by_hand():
    """Of a run of ten updates with two evaluations in its first tenth, after 10 and 40 steps."""
    results = SimpleNamespace(**runpy.run_path(str(RESULTS)))
    evaluations = {"updates": np.array([1, 1, 6, 10]), "steps": np.array([10, 40, 50, 60])}
    q_bias = {"updates": np.array([5, 6, 10]), "mean_bias": np.array([9.0, 1.0, np.nan])}
    run = SimpleNamespace(evaluations=evaluations, q_bias=q_bias)
    assert results.late_bias(run) == 1.0
    first = results.by_steps(run, np.array([20.0, 60.0, 500.0, 500.0]), results.shares(run) <= results.FIRST)
    assert first == (20 * 10 + 60 * 30) / 40


@pytest.mark.parametrize(("late", "verdict"), [(-20.0, "holds"), (-60.0, "does not hold")])
def test_the_gate_asks_for_every_seed(tmp_path, late, verdict):
    for seed in range(3):
        write_arm(tmp_path, "HalfCheetah-v4", "sac-auto", seed, [(100.0, -50.0)] * 20)
        last = late if seed == 2 else -20.0
        write_arm(tmp_path, "HalfCheetah-v4", "control-late", seed, [(100.0, -90.0)] * 8 + [(100.0, last)] * 12)
    table = printed(tmp_path)
    assert "| 0 | -90 against -50 | -20 against -50 | yes |" in table
    assert f"\nH1 {verdict}" in table


def test_a_run_that_has_just_begun_is_left_out(tmp_path):
    """Its first evaluation may be written while its terms are not."""
    write_arm(tmp_path, "HalfCheetah-v4", "sac-auto", 0, [(100.0, -50.0)] * 20)
    write_arm(tmp_path, "HalfCheetah-v4", "sac-auto", 1, [(100.0, -50.0)])
    terms = next(tmp_path.rglob("seed-1/reward_terms.csv"))
    terms.write_text(terms.read_text().splitlines(keepends=True)[0])
    write_arm(tmp_path, "HalfCheetah-v4", "sac-auto", 2, [])
    table = printed(tmp_path)
    assert "| `sac-auto` | 0 |" in table
    assert "| `sac-auto` | 1 |" not in table
    assert "| `sac-auto` | 2 |" not in table
