"""The planned comparisons of docs/curriculum.md, from run folders, as Markdown.

    python examples/curriculum/results.py RUNS

For each pair and measure: the difference of means with its 95 % Welch interval, and the probability that a run of the
first lies above a run of the second, with its 95 % interval. An effect is claimed if both leave out no effect.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from saclab.report.runs import Comparison, read_comparison
from saclab.report.statistics import area_under_curve, difference_of_means, probability_of_improvement
from saclab.training.run_folder import RunRecord, find_runs

PAIRS = {
    "H2, H3": ("curriculum", "sac-auto"),
    "H4": ("curriculum-slow", "sac-auto"),
    "H5": ("curriculum-slow", "curriculum"),
}
"""Of the runs on Humanoid-v4; those on HalfCheetah-v4 answer H1."""
FORWARD = {"HalfCheetah-v4": "return_reward_run", "Humanoid-v4": "return_reward_linvel"}
CONTROL = "return_reward_ctrl"
EARLY, LATE = 0.4, 0.8
"""Shares of the updates: the control is free up to the first and dear from the second on."""
FIRST, FINAL = 0.1, 0.9
"""Shares of the updates: the curricula on Humanoid-v4 have one weight up to the first; final is from the second on."""

Runs = dict[str, tuple[RunRecord, ...]]
"""Arm -> its runs, in the order of their seeds."""


def main() -> None:
    comparison = read_comparison(find_runs([Path(sys.argv[1])]))
    for environment in comparison.environments:
        runs = runs_of(comparison, environment)
        print(f"### {environment}\n")
        print_runs(runs, environment)
        if environment == "HalfCheetah-v4":
            print_gate(runs)
        else:
            print_pairs(runs, environment)


def runs_of(comparison: Comparison, environment: str) -> Runs:
    """Without a run that has just begun, and one caught between the writing of its two files."""
    forward = FORWARD[environment]
    return {
        arm.name: tuple(
            run
            for run in comparison.groups[environment, arm]
            if 0 < len(run.evaluations["steps"]) == len(run.reward_terms[forward])
        )
        for arm in comparison.arms_of(environment)
    }


def print_runs(runs: Runs, environment: str) -> None:
    """Every run by itself: so few seeds are not told by a mean alone."""
    print(f"| arm | seed | {' | '.join(MEASURES)} |\n|{'---|' * (2 + len(MEASURES))}")
    for name, own in runs.items():
        for run in own:
            found = [f"{value:.{digits(measure)}f}" for measure, value in measures(run, environment).items()]
            print(f"| `{name}` | {run.config.seed} | {' | '.join(found)} |")


def print_pairs(runs: Runs, environment: str) -> None:
    print("\n| | pair | measure | difference of means | P(first above second) | effect |\n|---|---|---|---|---|---|")
    for label, (x, y) in PAIRS.items():
        if x not in runs or y not in runs:
            continue
        ours, theirs = ([measures(run, environment) for run in runs[name]] for name in (x, y))
        for measure in MEASURES:
            mine, other = (np.array([found[measure] for found in each]) for each in (ours, theirs))
            print(f"| {label} | `{x}` − `{y}` | {measure} | {compared(mine, other, digits(measure))} |")
    print()


def compared(x: np.ndarray, y: np.ndarray, places: int) -> str:
    """The cells of a pair: f64[R] against f64[S]."""
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return "not measured | | "
    difference, chance = difference_of_means(x, y), probability_of_improvement([x], [y])
    effect = difference.exists and not difference.low <= 0 <= difference.high and chance.exists and chance.decided
    interval = f"{difference.estimate:+.{places}f} [{difference.low:+.{places}f}, {difference.high:+.{places}f}]"
    share = f"{chance.estimate:.2f} [{chance.low:.2f}, {chance.high:.2f}]"
    return f"{interval} | {share} | {'yes' if effect else 'cannot be told'}"


def print_gate(runs: Runs) -> None:
    """H1: with every seed the control is spent more freely while it costs nothing, and less once it costs more."""
    print("\n| seed | control, early | control, late | as predicted |\n|---|---|---|---|")
    plain = {run.config.seed: run for run in runs.get("sac-auto", ())}
    verdicts = []
    for run in runs.get("control-late", ()):
        if run.config.seed not in plain:
            continue
        (early, late), (plain_early, plain_late) = control(run), control(plain[run.config.seed])
        verdicts.append(early < plain_early and late > plain_late)
        cells = f"{early:.0f} against {plain_early:.0f} | {late:.0f} against {plain_late:.0f}"
        print(f"| {run.config.seed} | {cells} | {'yes' if verdicts[-1] else 'no'} |")
    passed = len(verdicts) >= 3 and all(verdicts)
    print(f"\nH1 {'holds: Humanoid-v4 may be trained' if passed else 'does not hold'}.\n")


def control(run: RunRecord) -> tuple[float, float]:
    """The mean control term over the evaluations of the first and of the last updates, by steps."""
    share = shares(run)
    return tuple(by_steps(run, run.reward_terms[CONTROL], part) for part in (share <= EARLY, share > LATE))


MEASURES = (
    *(
        f"{what}, {when}"
        for what in ("return", "episode length", "forward return", "forward return per step")
        for when in ("area", "final")
    ),
    "episode length, first tenth",
    "Q bias",
)


def measures(run: RunRecord, environment: str) -> dict[str, float]:
    """Measure -> value, of one run."""
    evaluations, forward = run.evaluations, run.reward_terms[FORWARD[environment]]
    lengths = evaluations["lengths"].mean(axis=1)
    found = []
    for values in (evaluations["mean_return"], lengths, forward, forward / lengths):
        found += [area_under_curve(evaluations["steps"], values), by_steps(run, values, shares(run) > FINAL)]
    found += [by_steps(run, lengths, shares(run) <= FIRST), late_bias(run)]
    return dict(zip(MEASURES, found, strict=True))


def by_steps(run: RunRecord, values: Sequence[float] | np.ndarray, part: np.ndarray) -> float:
    """Mean of some evaluations, each counted by the steps since the one before; NaN if there is none."""
    steps = np.diff(run.evaluations["steps"], prepend=0)[part]
    return float(np.average(np.asarray(values)[part], weights=steps)) if steps.sum() > 0 else float("nan")


def late_bias(run: RunRecord) -> float:
    """Mean normalised Q bias after half of the updates; NaN if it was not measured."""
    late = run.q_bias["mean_bias"][run.q_bias["updates"] > run.evaluations["updates"][-1] / 2]
    return float(np.nanmean(late)) if np.isfinite(late).any() else float("nan")


def shares(run: RunRecord) -> np.ndarray:
    """Each evaluation's share of the updates that the run has made."""
    updates: np.ndarray = run.evaluations["updates"]
    return updates / updates[-1]


def digits(measure: str) -> int:
    return 3 if measure == "Q bias" else 2 if "per step" in measure else 0


if __name__ == "__main__":
    main()
