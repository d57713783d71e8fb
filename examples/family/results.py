"""The runs of examples/family/run.sh beside published curves, as Markdown.

    python examples/family/results.py [RUNS]      examples/family/runs, if no folder is named

For each step after our random ones at which both have an evaluation: our return, the published mean with its standard
deviation over seeds, and how many of those deviations lie between them. The last such step of a variant is the one to
judge by; a single new seed lies within ±2.4 of ten others 95 times in 100 (Student's t of 9 degrees, times √1.1). A
variant without such a step has its last evaluation told alone.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from saclab.training.run_folder import RunRecord, find_runs, read_run

HERE = Path(__file__).parent
ENVIRONMENT = "HalfCheetah-v4"


class Point(NamedTuple):
    """A point of a published curve."""

    steps: int
    seeds: int
    mean: float
    deviation: float


def main() -> None:
    runs = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "runs"
    curves, trained = published(), by_variant(runs / ENVIRONMENT)
    print("| variant | steps | ours, each seed | published, ± over seeds | apart |\n|---|---|---|---|---|")
    for variant, own in trained.items():
        for line in lines(own, curves.get(variant, [])):
            print(f"| `{variant}` | {line} |")


def by_variant(folder: Path) -> dict[str, list[RunRecord]]:
    """Variant -> its runs, in the order of their seeds; they lie in VARIANT/PROTOCOL/seed-N."""
    found: dict[str, list[RunRecord]] = {}
    for run in sorted(map(read_run, find_runs([folder])), key=lambda run: run.config.seed):
        if len(run.evaluations.get("steps", ())):
            found.setdefault(run.path.parents[1].name, []).append(run)
    return dict(sorted(found.items()))


def published() -> dict[str, list[Point]]:
    """Variant -> its curve."""
    curves: dict[str, list[Point]] = {}
    with (HERE / "published.csv").open() as file:
        for row in csv.DictReader(file):
            point = Point(int(row["steps"]), int(row["seeds"]), float(row["mean_return"]), float(row["deviation"]))
            curves.setdefault(row["variant"], []).append(point)
    return curves


def lines(runs: Sequence[RunRecord], curve: Sequence[Point]) -> Iterator[str]:
    """The cells of a variant's lines, but for its name."""
    learning = [point for point in curve if point.steps > runs[0].config.training.random_steps]
    shared = [point for point in learning if all(returns_at(run, point.steps).size for run in runs)]
    for point in shared:
        ours = np.concatenate([returns_at(run, point.steps) for run in runs])
        apart = (np.mean(ours) - point.mean) / point.deviation
        theirs = f"{point.mean:.0f} ± {point.deviation:.0f}, {point.seeds} seeds"
        yield f"{point.steps:,} | {listed(ours)} | {theirs} | {apart:+.1f}"
    if not shared:
        last = min(int(run.evaluations["steps"][-1]) for run in runs)
        ours = np.concatenate([returns_at(run, last) for run in runs])
        later = (point for point in curve if point.steps > last)
        first = next(
            (f"first at {steps:,}: {mean:.0f} ± {deviation:.0f}" for steps, _, mean, deviation in later), "none"
        )
        yield f"{last:,} | {listed(ours)} | {first} | "


def returns_at(run: RunRecord, steps: int) -> np.ndarray:
    """The mean return of the evaluation after so many environment steps, f64[1]; f64[0] if there is none."""
    found: np.ndarray = run.evaluations["mean_return"][run.evaluations["steps"] == steps]
    return found


def listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.0f}" for value in values)


if __name__ == "__main__":
    main()
