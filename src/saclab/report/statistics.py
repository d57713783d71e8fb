"""Statistics of a few runs: point estimates with intervals, never a bare maximum.

Interquartile mean, stratified bootstrap, probability of improvement and performance profiles follow Agarwal et al.,
"Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS 2021). Scores come as strata: one array
of runs for each environment. Everything here is a pure function of arrays; random draws come from a fixed seed, so
that the same runs give the same report.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

CONFIDENCE = 0.95
POWER = 0.8
RESAMPLES, BAND_RESAMPLES = 5000, 1000
SEED = 20210830
FEW_RUNS = 5
"""Below so many runs a percentile bootstrap is clearly too narrow (for 2 runs it covers about half)."""

Statistic = Callable[[np.ndarray, int], np.ndarray]
"""(values, axis of the runs) -> values without that axis."""


class Interval(NamedTuple):
    """An estimate over runs; low and high are NaN where no interval exists."""

    estimate: float
    low: float
    high: float
    runs: int

    @property
    def exists(self) -> bool:
        return not np.isnan(self.low)


class Band(NamedTuple):
    """A curve with a pointwise interval; low and high are NaN where no interval exists."""

    middle: np.ndarray
    """f64[T]."""
    low: np.ndarray
    """f64[T]."""
    high: np.ndarray
    """f64[T]."""
    runs: int


class Improvement(NamedTuple):
    """How probable it is that a run of X scores higher than a run of Y."""

    estimate: float
    low: float
    high: float
    runs_x: int
    """Runs of X in the environment that has the fewest."""
    runs_y: int
    paired: Interval
    """The same over runs of equal seed only; `runs` counts the pairs, NaN if there is none."""

    @property
    def exists(self) -> bool:
        """Whether there is an interval, without which the estimate says nothing."""
        return not np.isnan(self.low)

    @property
    def decided(self) -> bool:
        """Whether the interval excludes ½."""
        return self.low > 0.5 or self.high < 0.5


def interquartile_mean(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Mean of the middle half (25 % trimmed mean, Agarwal et al. 2021); equals the mean of fewer than 4 values."""
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def mean(values: np.ndarray, axis: int = 0) -> np.ndarray:
    return np.asarray(np.mean(values, axis=axis))


def median(values: np.ndarray, axis: int = 0) -> np.ndarray:
    return np.asarray(np.median(values, axis=axis))


def resample(strata: Sequence[np.ndarray], resamples: int = RESAMPLES, seed: int = SEED) -> list[np.ndarray]:
    """Draw runs with replacement within each stratum (Agarwal et al. 2021, Section 4.1).

    Args:
        strata: f64[R_e, ...] for each environment e; R_e may differ.
        resamples: bootstrap samples B.
        seed: of the draws.

    Returns:
        f64[B, R_e, ...] for each environment.
    """
    generator = np.random.default_rng(seed)
    return [values[generator.integers(0, len(values), (resamples, len(values)))] for values in strata]


def percentiles(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The interval between order statistics of f64[B, ...] over axis 0, rounded outwards; infinities are welcome."""
    ordered, last, tail = np.sort(samples, axis=0), len(samples) - 1, (1 - CONFIDENCE) / 2
    return ordered[int(np.floor(tail * last))], ordered[int(np.ceil((1 - tail) * last))]


def bootstrap_interval(strata: Sequence[np.ndarray], statistic: Statistic = interquartile_mean) -> Interval:
    """A statistic of all runs f64[R_e] of all environments, with its stratified percentile bootstrap interval.

    A stratum of one run has no spread to resample: then no interval exists. Without any run all is NaN.
    """
    runs = sum(len(values) for values in strata)
    if runs == 0:
        return Interval(np.nan, np.nan, np.nan, 0)
    estimate = float(statistic(np.concatenate(list(strata)), 0))
    if min(len(values) for values in strata) < 2:
        return Interval(estimate, np.nan, np.nan, runs)
    low, high = percentiles(statistic(np.concatenate(resample(strata), axis=1), 1))
    return Interval(estimate, float(low), float(high), runs)


def bootstrap_band(strata: Sequence[np.ndarray], statistic: Statistic = interquartile_mean) -> Band:
    """A statistic of curves f64[R_e, T] at each point, whole runs resampled within each environment."""
    values = np.concatenate(list(strata))
    middle = statistic(values, 0)
    if min(len(stratum) for stratum in strata) < 2:
        nothing = np.full(middle.shape, np.nan)
        return Band(middle, nothing, nothing, len(values))
    low, high = percentiles(statistic(np.concatenate(resample(strata, BAND_RESAMPLES), axis=1), 1))
    return Band(middle, low, high, len(values))


def performance_profile(strata: Sequence[np.ndarray], thresholds: np.ndarray) -> Band:
    """Share of all runs that score above each threshold f64[T] (Agarwal et al. 2021, Section 4.3)."""
    above = [(values[:, None] > thresholds).astype(float) for values in strata]
    return bootstrap_band(above, mean)


def win_share(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """P(X > Y) + P(X = Y) / 2 over all pairs of f64[..., R_x] and f64[..., R_y]: Mann and Whitney's U / (R_x R_y)."""
    difference = x[..., :, None] - y[..., None, :]
    return np.asarray(np.mean((difference > 0) + (difference == 0) / 2, axis=(-2, -1)))


def probability_of_improvement(
    x: Sequence[np.ndarray], y: Sequence[np.ndarray], pairs: Sequence[tuple[np.ndarray, np.ndarray]] = ()
) -> Improvement:
    """P(X > Y), averaged over environments (Agarwal et al. 2021, Section 4.3), with a 95 % interval.

    The interval is the stratified bootstrap's, at each end never narrower than Newcombe's score interval: a bootstrap
    of few runs is too narrow, and it vanishes altogether when every run of X scores above every run of Y. It includes ½
    unless a permutation test rejects as well: with three runs each nothing can be significant.

    Args:
        x: scores f64[R_e] for each environment.
        y: scores f64[S_e] for the same environments.
        pairs: for each environment the scores of X and of Y, f64[P_e] each, of the seeds that both have.
    """
    shares = np.array([win_share(a, b) for a, b in zip(x, y, strict=True)])
    estimate = float(np.mean(shares))
    fewest_x, fewest_y = min(map(len, x)), min(map(len, y))
    paired = paired_improvement(pairs)
    if min(fewest_x, fewest_y) < 2:
        return Improvement(estimate, np.nan, np.nan, fewest_x, fewest_y, paired)
    drawn = zip(resample(x), resample(y, seed=SEED + 1), strict=True)
    drawn_low, drawn_high = percentiles(np.mean([win_share(a, b) for a, b in drawn], axis=0))
    score = np.array([newcombe_interval(p, len(a), len(b)) for p, a, b in zip(shares, x, y, strict=True)])
    score_low, score_high = average_of_intervals(shares, score[:, 0], score[:, 1])
    undecided = 0.5 if permutation_p_value(x, y) > 1 - CONFIDENCE else estimate
    low, high = min(float(drawn_low), score_low, undecided), max(float(drawn_high), score_high, undecided)
    return Improvement(estimate, low, high, fewest_x, fewest_y, paired)


def permutation_p_value(x: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> float:
    """Two-sided p-value of the mean win share over environments, runs shuffled between X and Y within each.

    The observed order counts as one of the shuffles, so that the test keeps its level.
    """
    generator = np.random.default_rng(SEED)

    def shuffled(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        both = generator.permuted(np.tile(np.concatenate([a, b]), (RESAMPLES, 1)), axis=1)
        return win_share(both[:, : len(a)], both[:, len(a) :])

    strata = list(zip(x, y, strict=True))
    observed = abs(np.mean([win_share(a, b) for a, b in strata]) - 0.5)
    chance = np.abs(np.mean([shuffled(a, b) for a, b in strata], axis=0) - 0.5)
    return float((1 + np.sum(chance >= observed - 1e-12)) / (1 + RESAMPLES))


def newcombe_interval(share: float, runs_x: int, runs_y: int) -> tuple[float, float]:
    """Score interval of P(X > Y) for few runs: Newcombe, Statistics in Medicine 25 (2006), part 2, method 5.

    Solves |share − p| = z · sd(p), with Hanley and McNeil's variance under p. Never empty, also at 0 and 1.
    """
    z, pooled = float(stats.norm.ppf((1 + CONFIDENCE) / 2)), (runs_x + runs_y) / 2 - 1

    def excess(p: float) -> float:
        variance = p * (1 - p) / (runs_x * runs_y) * (1 + pooled * ((1 - p) / (2 - p) + p / (1 + p)))
        return (share - p) ** 2 - z**2 * variance

    tiny = 1e-9
    low = 0.0 if share <= tiny else float(optimize.brentq(excess, 0.0, share - tiny))
    high = 1.0 if share >= 1 - tiny else float(optimize.brentq(excess, share + tiny, 1.0))
    return low, high


def average_of_intervals(estimates: np.ndarray, lows: np.ndarray, highs: np.ndarray) -> tuple[float, float]:
    """Interval of the mean of independent estimates, all f64[E], from theirs: Zou and Donner's MOVER (2008)."""
    middle, count = np.mean(estimates), len(estimates)
    return (
        float(middle - np.sqrt(np.sum((estimates - lows) ** 2)) / count),
        float(middle + np.sqrt(np.sum((highs - estimates) ** 2)) / count),
    )


def paired_improvement(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Interval:
    """Share of equal seeds on which X scores higher, ties half, with Wilson's score interval (1927)."""
    wins = np.concatenate([np.sign(a - b) / 2 + 0.5 for a, b in pairs]) if pairs else np.zeros(0)
    count = len(wins)
    if count == 0:
        return Interval(np.nan, np.nan, np.nan, 0)
    share = float(np.mean(wins))
    if count == 1:
        return Interval(share, np.nan, np.nan, 1)
    z2 = float(stats.norm.ppf((1 + CONFIDENCE) / 2)) ** 2
    centre = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = np.sqrt(z2 * (share * (1 - share) / count + z2 / (4 * count**2))) / (1 + z2 / count)
    return Interval(share, float(max(0, centre - half)), float(min(1, centre + half)), count)


def difference_of_means(x: np.ndarray, y: np.ndarray) -> Interval:
    """Mean of f64[R] minus mean of f64[S], with Welch's 95 % interval; `runs` counts those of the smaller sample.

    Welch, Biometrika 34 (1947): the variances need not be equal. With one run of either there is no interval.
    """
    fewest = min(len(x), len(y))
    if fewest == 0:
        return Interval(np.nan, np.nan, np.nan, 0)
    estimate = float(np.mean(x) - np.mean(y))
    if fewest < 2:
        return Interval(estimate, np.nan, np.nan, fewest)
    if np.var(x) == np.var(y) == 0:  # no spread at all: scipy divides by it
        return Interval(estimate, estimate, estimate, fewest)
    low, high = stats.ttest_ind(x, y, equal_var=False).confidence_interval(CONFIDENCE)
    return Interval(estimate, float(low), float(high), fewest)


def runs_needed(probability: float) -> float:
    """Runs of each variant that would show `probability` ≠ ½ with a power of 80 %; infinite at ½.

    Noether, Journal of the American Statistical Association 82 (1987), equal group sizes.
    """
    if probability == 0.5:
        return np.inf
    z = stats.norm.ppf((1 + CONFIDENCE) / 2) + stats.norm.ppf(POWER)
    return float(np.ceil(z**2 / (6 * (probability - 0.5) ** 2)))


def area_under_curve(steps: np.ndarray, returns: np.ndarray) -> float:
    """Area under f64[n] evaluation returns, divided by the steps f64[n] they span: the mean return over training."""
    span = steps[-1] - steps[0]
    return float(np.trapezoid(returns, steps) / span) if span > 0 else float(np.mean(returns))


def steps_to_threshold(steps: np.ndarray, returns: np.ndarray, threshold: float) -> float:
    """Environment steps at the first evaluation of at least `threshold`; infinite if there is none."""
    reached = returns >= threshold
    return float(steps[np.argmax(reached)]) if reached.any() else np.inf


def normalise(scores: np.ndarray, low: float, high: float) -> np.ndarray:
    """Scores on a scale where `low` is 0 and `high` is 1; ½ everywhere if the two are equal."""
    return (scores - low) / (high - low) if high > low else np.full(scores.shape, 0.5)
