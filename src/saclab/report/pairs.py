"""Pairs of arms: how probable it is that a run of one scores above one of the other, and by how much on average."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from saclab.report.arms import Arm
from saclab.report.statistics import Improvement, Interval, difference_of_means, probability_of_improvement

Scores = dict[str, dict[int, float]]
"""Measure -> seed -> score, of one arm in one environment."""
MEASURES = {"final": "final evaluation return", "area": "mean over training"}
"""What pairs are compared by."""


class PairScores(NamedTuple):
    """Two arms compared by one measure."""

    improvement: Improvement
    difference: Interval
    """Mean of the first minus mean of the second, Welch's interval; all NaN over several environments, whose returns
    have no common scale."""


class Pair(NamedTuple):
    """Two arms compared."""

    x: Arm
    y: Arm
    final: PairScores
    area: PairScores

    @property
    def improvement(self) -> Improvement:
        """How probable it is that a run of `x` ends above one of `y`: what the summary says."""
        return self.final.improvement


def compare_pairs(environments: Sequence[dict[Arm, Scores]]) -> tuple[Pair, ...]:
    """Every pair of arms, over environments that all have the arms of the first."""
    return tuple(
        Pair(x, y, *(compare(environments, x, y, measure) for measure in MEASURES))
        for x, y in combinations(environments[0], 2)
    )


def compare(environments: Sequence[dict[Arm, Scores]], x: Arm, y: Arm, measure: str) -> PairScores:
    both = [(scores[x][measure], scores[y][measure]) for scores in environments]
    of_x, of_y = ([np.array(list(by_seed.values())) for by_seed in each] for each in zip(*both))
    improvement = probability_of_improvement(of_x, of_y, [matched(*each) for each in both])
    if len(both) == 1:
        return PairScores(improvement, difference_of_means(of_x[0], of_y[0]))
    return PairScores(improvement, Interval(np.nan, np.nan, np.nan, 0))


def matched(x: dict[int, float], y: dict[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """Scores f64[P] of each on the seeds that both have."""
    seeds = sorted(x.keys() & y.keys())
    return np.array([x[seed] for seed in seeds]), np.array([y[seed] for seed in seeds])
