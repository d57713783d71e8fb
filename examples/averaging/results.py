"""The planned comparisons of docs/averaging.md, from run folders.

    python examples/averaging/results.py [RUNS]      examples/averaging/runs, if no folder is named
    python examples/averaging/results.py --write     puts what is printed between the marks in docs/averaging.md

For each pair and measure: the difference of means with its 95 % Welch interval, and the probability that a run of the
first scores above a run of the second, with its 95 % interval. An effect is claimed if both leave out no effect.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np

from saclab.report.arms import Arm
from saclab.report.runs import Comparison, read_comparison
from saclab.report.scores import score_run
from saclab.report.statistics import Interval, area_under_curve, difference_of_means, probability_of_improvement
from saclab.training.run_folder import RunRecord, find_runs

PAIRS = {
    "HalfCheetah-v4": {
        "H1": ("averaged", "sac"),
        "H2": ("averaged-spacing-200", "sac"),
        "H3": ("averaged-spacing-200", "sac-lag"),
        "H4": ("averaged-entropy", "sac"),
        "H5": ("averaged-auto", "sac-auto"),
        "H6": ("sac-auto", "sac"),
    },
    "Humanoid-v4": {"H1": ("averaged", "sac"), "H5": ("averaged-auto", "sac-auto"), "H6": ("sac-auto", "sac")},
}
FIRST_PHASE = 100  # training episodes


HERE = Path(__file__).parent
PAGE, BEGIN, END = HERE.parents[1] / "docs" / "averaging.md", "<!-- results -->\n", "<!-- end of results -->\n"


def main() -> None:
    if sys.argv[1:] != ["--write"]:
        print_results(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "runs")
        return
    told = StringIO()
    with redirect_stdout(told):
        print_results(HERE / "runs")
    before, after = PAGE.read_text().split(BEGIN)[0], PAGE.read_text().split(END)[1]
    PAGE.write_text(f"{before}{BEGIN}{told.getvalue()}\n{END}{after}")


def print_results(runs: Path) -> None:
    comparison = read_comparison(find_runs([runs]))
    for environment in comparison.environments:
        arms = {arm.name: arm for arm in comparison.arms_of(environment)}
        print(f"\n### {environment}\n")
        print_arms(comparison, environment, arms)
        print_pairs(comparison, environment, arms)


def print_arms(comparison: Comparison, environment: str, arms: dict[str, Arm]) -> None:
    print("| arm | seeds | area | final | first phase | Q bias | snapshot spread / critic spread |")
    print("|---|---|---|---|---|---|---|")
    for name, arm in arms.items():
        runs = comparison.groups[environment, arm]
        columns = [f"{np.mean(values):.0f}{deviation(values)}" for values in measures(runs).values()]
        bias, spread = np.mean([late_bias(run) for run in runs]), np.mean([relative_spread(run) for run in runs])
        print(f"| `{name}` | {len(runs)} | {' | '.join(columns)} | {bias:+.3f} | {spread:.3f} |")


def print_pairs(comparison: Comparison, environment: str, arms: dict[str, Arm]) -> None:
    if min(len(comparison.groups[environment, arm]) for arm in arms.values()) < 2:
        print("\nSome arm has one seed only: no interval exists, and nothing can be told yet.")
        return
    print("\n| | pair | measure | difference of means | P(first above second) | effect |\n|---|---|---|---|---|---|")
    for label, (x, y) in PAIRS[environment].items():
        if x not in arms or y not in arms:
            continue
        ours, theirs = (measures(comparison.groups[environment, arms[name]]) for name in (x, y))
        for measure in ours:
            difference = difference_of_means(ours[measure], theirs[measure])
            chance = probability_of_improvement([ours[measure]], [theirs[measure]], [(np.zeros(0), np.zeros(0))])
            effect = excludes(difference, 0) and chance.exists and not chance.low <= 0.5 <= chance.high
            print(
                f"| {label} | `{x}` − `{y}` | {measure} | {difference.estimate:+.0f} [{difference.low:+.0f}, "
                f"{difference.high:+.0f}] | {chance.estimate:.2f} [{chance.low:.2f}, {chance.high:.2f}] | "
                f"{'yes' if effect else 'cannot be told'} |"
            )


def measures(runs: Sequence[RunRecord]) -> dict[str, np.ndarray]:
    """Measure -> f64[runs]."""
    scores = [score_run(run, None, np.inf) for run in runs]
    early = [first_phase(run) for run in runs]
    return {
        "area": np.array([score.area for score in scores]),
        "final": np.array([score.final for score in scores]),
        "first phase": np.array(early),
    }


def first_phase(run: RunRecord) -> float:
    """The area over the first training episodes."""
    early = run.evaluations["episodes"] <= FIRST_PHASE
    return area_under_curve(run.evaluations["steps"][early], run.evaluations["mean_return"][early])


def late_bias(run: RunRecord) -> float:
    """Mean normalised Q bias after half of the training."""
    late = run.q_bias["updates"] > run.q_bias["updates"][-1] / 2
    return float(np.nanmean(run.q_bias["mean_bias"][late]))


def relative_spread(run: RunRecord) -> float:
    """How far the snapshots' values lie apart, in units of the critics' spread."""
    return float(np.mean(run.metrics["snapshot_spread"] / run.metrics["q_spread"]))


def deviation(values: np.ndarray) -> str:
    """Behind a mean: nothing for one run."""
    return f" ± {np.std(values, ddof=1):.0f}" if len(values) > 1 else ""


def excludes(interval: Interval, value: float) -> bool:
    return interval.exists and not interval.low <= value <= interval.high


if __name__ == "__main__":
    main()
