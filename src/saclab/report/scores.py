"""From the runs of an environment to scores, intervals, verdicts on pairs, and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from saclab.report.paper import TABLE_2
from saclab.report.runs import Arm, Comparison, tests
from saclab.report.statistics import (
    FEW_RUNS,
    Band,
    Improvement,
    Interval,
    area_under_curve,
    bootstrap_interval,
    interquartile_mean,
    mean,
    median,
    normalise,
    pair_sentence,
    performance_profile,
    probability_of_improvement,
    steps_to_threshold,
)
from saclab.training.run_folder import RunRecord

FINAL_SHARE = 0.1
"""The final return is the mean over this last share of the tests, at least one: a single test is noisy."""
PROFILE_POINTS = 101
MORE_SEEDS = "More seeds can change that: compare again with --seeds 5; finished runs are kept."
ONE_SEED = f"One seed of each variant allows no conclusion about which is better. {MORE_SEEDS}"


class RunScore(NamedTuple):
    """What one run reached within the horizon of its environment; NaN without a test."""

    seed: int
    final: float
    """Mean test return over the last tenth of the tests."""
    best: float
    """Highest test return: a maximum over `tests` noisy numbers, so it flatters. The paper's Table 2 reports it."""
    area: float
    """Mean test return over training: the area under the curve divided by its steps."""
    steps_to_threshold: float
    """Infinite if the threshold was not reached."""
    tests: int


class ArmScores(NamedTuple):
    """One arm in one environment."""

    arm: Arm
    runs: tuple[RunScore, ...]
    """Those with a test, in the order of their seeds."""
    final: Interval
    """Interquartile means with 95 % intervals, here and below."""
    best: Interval
    area: Interval
    final_mean: Interval
    final_median: Interval
    steps_to_threshold: Interval
    """Median."""
    reached: int
    """Runs that reached the threshold."""
    paper_best: float | None
    """The paper's number, if it has one."""
    profile: Band | None
    """Share of runs with a final return above each of EnvironmentScores.thresholds."""

    def values(self, field: str) -> np.ndarray:
        """f64[R]: a field of RunScore over runs."""
        return np.array([getattr(run, field) for run in self.runs], np.float64)

    @property
    def by_seed(self) -> dict[int, float]:
        """Seed -> final return."""
        return {run.seed: run.final for run in self.runs}


class Pair(NamedTuple):
    """Two arms compared by their final returns."""

    x: Arm
    y: Arm
    improvement: Improvement
    sentence: str


class EnvironmentScores(NamedTuple):
    environment: str
    horizon: float | None
    """Steps at which all runs were cut, since not all go further; None if nothing was cut."""
    threshold: float
    """Test return for steps_to_threshold: the final return of the weakest arm, so that every arm gets there."""
    arms: tuple[ArmScores, ...]
    pairs: tuple[Pair, ...]
    thresholds: np.ndarray
    """f64[PROFILE_POINTS]: final returns, for the performance profiles."""


class AggregateArm(NamedTuple):
    """Normalised final returns of one arm over all environments."""

    arm: Arm
    interquartile_mean: Interval
    mean: Interval
    median: Interval
    profile: Band


class AggregateScores(NamedTuple):
    """All environments together, for the arms that have runs in each."""

    arms: tuple[AggregateArm, ...]
    pairs: tuple[Pair, ...]
    thresholds: np.ndarray


def score_environment(comparison: Comparison, environment: str) -> EnvironmentScores:
    """All scores of the runs in one environment that have at least one test."""
    horizon = common_horizon(comparison.runs_of(environment))
    tested = {arm: [run for run in comparison.groups[environment, arm] if has_score(run)]
              for arm in comparison.arms_of(environment)}  # fmt: skip
    finals = {arm: [score_run(run, horizon, np.inf).final for run in runs] for arm, runs in tested.items()}
    levels = [float(interquartile_mean(np.array(values))) for values in finals.values() if values]
    threshold = min(levels, default=np.nan)
    everything = np.array([value for values in finals.values() for value in values])
    thresholds = np.linspace(everything.min(), everything.max(), PROFILE_POINTS) if len(everything) else np.zeros(0)
    arms = tuple(
        score_arm(environment, arm, [score_run(run, horizon, threshold) for run in runs], thresholds)
        for arm, runs in tested.items()
    )
    pairs = compare_pairs([{scores.arm: scores for scores in arms if scores.runs}])
    return EnvironmentScores(environment, horizon, threshold, arms, pairs, thresholds)


def has_score(run: RunRecord) -> bool:
    """A run that diverged to returns that are not numbers has none."""
    return tests(run) > 0 and bool(np.isfinite(run.evaluations["mean_return"]).all())


def common_horizon(runs: Sequence[RunRecord]) -> float | None:
    """Steps up to which all runs can be compared; None if all of them finished the same budget.

    A finished run that stopped early by the protocol's own rule (patience, a limit on episodes) cuts nobody. An
    unfinished one does: leaving it out would flatter a variant whose bad runs break off.
    """
    tested = [run for run in runs if has_score(run)]
    budgets = {(run.config.training.max_steps, run.config.training.max_updates, run.config.training.max_episodes)
               for run in runs}  # fmt: skip
    limiting = tested if len(budgets) > 1 else [run for run in tested if run.result is None]
    if not limiting:
        return None
    shortest = min(float(run.evaluations["steps"][-1]) for run in limiting)
    return shortest if any(run.evaluations["steps"][-1] > shortest for run in tested) else None


def score_run(run: RunRecord, horizon: float | None, threshold: float) -> RunScore:
    """Score a run with at least one test, on its tests up to `horizon` steps (its first test counts always)."""
    steps, returns = run.evaluations["steps"], run.evaluations["mean_return"]
    count = max(1, int(np.sum(steps <= horizon))) if horizon is not None else len(steps)
    steps, returns = steps[:count], returns[:count]
    return RunScore(
        seed=run.config.seed,
        final=float(np.mean(returns[-max(1, round(FINAL_SHARE * count)) :])),
        best=float(np.max(returns)),
        area=area_under_curve(steps, returns),
        steps_to_threshold=steps_to_threshold(steps, returns, threshold),
        tests=count,
    )


def score_arm(environment: str, arm: Arm, runs: Sequence[RunScore], thresholds: np.ndarray) -> ArmScores:
    def values(field: str) -> np.ndarray:
        return np.array([getattr(run, field) for run in runs], np.float64)

    final, to_threshold = values("final"), values("steps_to_threshold")
    return ArmScores(
        arm=arm,
        runs=tuple(runs),
        final=bootstrap_interval([final]),
        best=bootstrap_interval([values("best")]),
        area=bootstrap_interval([values("area")]),
        final_mean=bootstrap_interval([final], mean),
        final_median=bootstrap_interval([final], median),
        steps_to_threshold=bootstrap_interval([to_threshold], median),
        reached=int(np.sum(np.isfinite(to_threshold))),
        paper_best=TABLE_2.get(environment, {}).get(arm.paper_name or ""),
        profile=performance_profile([final], thresholds) if runs else None,
    )


def compare_pairs(environments: Sequence[dict[Arm, ArmScores]]) -> tuple[Pair, ...]:
    """Every pair of arms by final return, over environments that all have the arms of the first."""
    pairs = []
    for x, y in combinations(environments[0], 2):
        improvement = probability_of_improvement(
            [scores[x].values("final") for scores in environments],
            [scores[y].values("final") for scores in environments],
            [matched(scores[x], scores[y]) for scores in environments],
        )
        pairs.append(Pair(x, y, improvement, pair_sentence(x.name, y.name, improvement)))
    return tuple(pairs)


def matched(x: ArmScores, y: ArmScores) -> tuple[np.ndarray, np.ndarray]:
    """Final returns f64[P] of each on the seeds that both have."""
    seeds = sorted(x.by_seed.keys() & y.by_seed.keys())
    return np.array([x.by_seed[seed] for seed in seeds]), np.array([y.by_seed[seed] for seed in seeds])


def aggregate(environments: Sequence[EnvironmentScores]) -> AggregateScores | None:
    """All environments together; None for fewer than two, or if no arm has runs in all of them.

    Final returns are normalised by environment: 0 is the lowest and 1 the highest final return of any run there. Such
    numbers hold within one report only. Probabilities of improvement need no normalisation.
    """
    complete = [{scores.arm: scores for scores in entry.arms if scores.runs} for entry in environments]
    if len(complete) < 2:
        return None
    shared = [arm for arm in complete[0] if all(arm in entry for entry in complete)]
    if not shared:
        return None
    thresholds = np.linspace(0, 1, PROFILE_POINTS)
    arms = []
    for arm in shared:
        strata = [normalise(entry[arm].values("final"), scores.thresholds[0], scores.thresholds[-1])
                  for entry, scores in zip(complete, environments)]  # fmt: skip
        iqm, average, middle = (bootstrap_interval(strata, each) for each in (interquartile_mean, mean, median))
        arms.append(AggregateArm(arm, iqm, average, middle, performance_profile(strata, thresholds)))
    pairs = compare_pairs([{arm: entry[arm] for arm in shared} for entry in complete])
    return AggregateScores(tuple(arms), pairs, thresholds)


def environment_sentences(scores: EnvironmentScores) -> list[str]:
    """The summary of an environment: first the verdicts, then the levels they rest on, then what to beware of."""
    tested = [arm for arm in scores.arms if arm.runs]
    if not tested:
        return ["No run has a test so far, so there is nothing to compare."]
    sentences = pair_sentences(scores.pairs)
    fewest, most = min(len(arm.runs) for arm in tested), max(len(arm.runs) for arm in tested)
    if most == 1:
        levels = "; ".join(f"{arm.arm.name} {number_text(arm.final.estimate)}" for arm in tested)
        sentences.append(f"Final test return (one seed, no interval): {levels}.")
    else:
        levels = "; ".join(f"{arm.arm.name} {interval_text(arm.final)}" for arm in tested)
        sentences.append(f"Final test return: {levels}.")
    if 1 < fewest < FEW_RUNS:
        sentences.append(
            f"With fewer than {FEW_RUNS} seeds the bootstrap intervals of returns are too narrow: read them as hints."
        )
    if scores.horizon is not None:
        sentences.append(
            f"All runs are scored up to {scores.horizon:,.0f} environment steps only, where the shortest one stands."
        )
    return sentences


def aggregate_sentences(together: AggregateScores) -> list[str]:
    """The summary of all environments together."""
    levels = "; ".join(f"{entry.arm.name} {interval_text(entry.interquartile_mean)}" for entry in together.arms)
    return [*pair_sentences(together.pairs), f"Normalised final test return: {levels.replace(' seeds', ' runs')}."]


def pair_sentences(pairs: Sequence[Pair]) -> list[str]:
    """Decided pairs first, then undecided ones; those that no interval exists for in one sentence."""
    known = [pair for pair in pairs if pair.improvement.exists]
    sentences = [pair.sentence for pair in sorted(known, key=lambda pair: not pair.improvement.decided)]
    runs = {pair.x: pair.improvement.runs_x for pair in pairs} | {pair.y: pair.improvement.runs_y for pair in pairs}
    alone = [arm.name for arm, count in runs.items() if count < 2]
    if alone and len(alone) == len(runs):
        return [ONE_SEED]
    if alone:
        sentences.append(f"With one seed only, nothing can be said about {', '.join(alone)}. {MORE_SEEDS}")
    return sentences


def interval_text(interval: Interval) -> str:
    """An estimate, its interval and its number of runs in words."""
    if interval.runs == 0:
        return "no test yet"
    seeds = f"{interval.runs} seed{'s' * (interval.runs != 1)}"
    if not interval.exists:
        return f"{number_text(interval.estimate)} (no interval: {seeds})"
    return f"{number_text(interval.estimate)} [{number_text(interval.low)}, {number_text(interval.high)}], {seeds}"


def number_text(value: float) -> str:
    """Three or more significant digits; an infinity is a threshold that was not reached."""
    if np.isinf(value):
        return "not reached"
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2
    return f"{value:,.{digits}f}".replace("-", "−")
