"""From the runs of an environment to scores, intervals and pairs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saclab.report.arms import Arm
from saclab.report.notices import evaluations
from saclab.report.pairs import MEASURES, Pair, Scores, compare_pairs
from saclab.report.paper import TABLE_2
from saclab.report.runs import Comparison
from saclab.report.statistics import (
    Band,
    Interval,
    area_under_curve,
    bootstrap_interval,
    interquartile_mean,
    median,
    normalise,
    performance_profile,
    steps_to_threshold,
)
from saclab.settings import TrainingSettings
from saclab.training.run_folder import RunRecord

FINAL_SHARE = 0.1
"""The final return is the mean over this last share of the evaluations, at least one: a single one is noisy."""
PROFILE_POINTS = 101


class RunScore(NamedTuple):
    """What one run reached within the horizon of its environment; NaN without an evaluation."""

    seed: int
    final: float
    """Mean return over the last tenth of the evaluations."""
    best: float
    """Highest evaluation return: a maximum over `evaluations` noisy numbers, so it flatters. It is in Table 2."""
    area: float
    """Mean evaluation return over training: the area under the curve divided by its steps."""
    steps_to_threshold: float
    """Infinite if the threshold was not reached."""
    evaluations: int


class ArmScores(NamedTuple):
    """One arm in one environment."""

    arm: Arm
    runs: tuple[RunScore, ...]
    """Those with an evaluation, in the order of their seeds."""
    final: Interval
    """Interquartile means with 95 % intervals, here and below."""
    best: Interval
    area: Interval
    steps_to_threshold: Interval
    """Median over runs."""
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
    def by_seed(self) -> Scores:
        """The scores that pairs are compared by."""
        return {measure: {run.seed: getattr(run, measure) for run in self.runs} for measure in MEASURES}


class EnvironmentScores(NamedTuple):
    environment: str
    horizon: float | None
    """Steps at which all runs were cut, since not all go further; None if nothing was cut."""
    threshold: float
    """Evaluation return for steps_to_threshold: the final return of the weakest arm, so that every arm gets there."""
    arms: tuple[ArmScores, ...]
    pairs: tuple[Pair, ...]
    thresholds: np.ndarray
    """f64[PROFILE_POINTS]: final returns, for the performance profiles."""


class AggregateArm(NamedTuple):
    """Normalised final returns of one arm over all environments."""

    arm: Arm
    interquartile_mean: Interval
    profile: Band


class AggregateScores(NamedTuple):
    """All environments together, for the arms that have runs in each."""

    arms: tuple[AggregateArm, ...]
    pairs: tuple[Pair, ...]
    thresholds: np.ndarray


def score_environment(comparison: Comparison, environment: str) -> EnvironmentScores:
    """All scores of the runs in one environment that have at least one evaluation."""
    horizon = common_horizon(comparison.runs_of(environment))
    evaluated = {arm: [run for run in comparison.groups[environment, arm] if has_score(run)]
              for arm in comparison.arms_of(environment)}  # fmt: skip
    finals = {arm: [score_run(run, horizon, np.inf).final for run in runs] for arm, runs in evaluated.items()}
    levels = [float(interquartile_mean(np.array(values))) for values in finals.values() if values]
    threshold = min(levels, default=np.nan)
    everything = np.array([value for values in finals.values() for value in values])
    thresholds = np.linspace(everything.min(), everything.max(), PROFILE_POINTS) if len(everything) else np.zeros(0)
    arms = tuple(
        score_arm(environment, arm, [score_run(run, horizon, threshold) for run in runs], thresholds)
        for arm, runs in evaluated.items()
    )
    pairs = compare_pairs([{scores.arm: scores.by_seed for scores in arms if scores.runs}])
    return EnvironmentScores(environment, horizon, threshold, arms, pairs, thresholds)


def has_score(run: RunRecord) -> bool:
    return evaluations(run) > 0


def common_horizon(runs: Sequence[RunRecord]) -> float | None:
    """Steps up to which all runs can be compared; None if all of them finished the same budget.

    A finished run that stopped early by the protocol's own rule (patience, a limit on episodes) cuts nobody. An
    unfinished one does: leaving it out would flatter a variant whose bad runs break off.
    """
    evaluated = [run for run in runs if has_score(run)]
    budgets = {(planned_steps(run.config.training), run.config.training.max_episodes) for run in runs}
    limiting = evaluated if len(budgets) > 1 else [run for run in evaluated if run.result is None]
    if not limiting:
        return None
    shortest = min(float(run.evaluations["steps"][-1]) for run in limiting)
    return shortest if any(run.evaluations["steps"][-1] > shortest for run in evaluated) else None


def planned_steps(settings: TrainingSettings) -> float:
    """Environment steps that the limits on steps and updates allow; infinite if neither is set.

    How many a limit on updates means depends on the update-to-data ratio, which may be a variant's own.
    """
    by_updates = np.inf
    if settings.max_updates is not None:
        rounds = -(-settings.max_updates // settings.updates_per_interval)
        by_updates = settings.random_steps + rounds * settings.update_interval
    return min(by_updates, np.inf if settings.max_steps is None else settings.max_steps)


def score_run(run: RunRecord, horizon: float | None, threshold: float) -> RunScore:
    """Score a run with at least one evaluation, on those up to `horizon` steps (its first one counts always)."""
    steps, returns = run.evaluations["steps"], run.evaluations["mean_return"]
    count = max(1, int(np.sum(steps <= horizon))) if horizon is not None else len(steps)
    steps, returns = steps[:count], returns[:count]
    return RunScore(
        seed=run.config.seed,
        final=float(np.mean(returns[-max(1, round(FINAL_SHARE * count)) :])),
        best=float(np.max(returns)),
        area=area_under_curve(steps, returns),
        steps_to_threshold=steps_to_threshold(steps, returns, threshold),
        evaluations=count,
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
        steps_to_threshold=bootstrap_interval([to_threshold], median),
        reached=int(np.sum(np.isfinite(to_threshold))),
        paper_best=TABLE_2.get(environment, {}).get(arm.paper_name or ""),
        profile=performance_profile([final], thresholds) if runs else None,
    )


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
        arms.append(AggregateArm(arm, bootstrap_interval(strata), performance_profile(strata, thresholds)))
    pairs = compare_pairs([{arm: entry[arm].by_seed for arm in shared} for entry in complete])
    return AggregateScores(tuple(arms), pairs, thresholds)
