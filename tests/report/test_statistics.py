"""The statistics against closed forms, numbers worked out by hand, and rliable's own."""

import math

import numpy as np
import pytest
from scipy import stats

from saclab.report import statistics
from saclab.report.sentences import pair_sentence
from saclab.report.statistics import (
    Improvement,
    Interval,
    area_under_curve,
    bootstrap_band,
    bootstrap_interval,
    difference_of_means,
    interquartile_mean,
    mean,
    median,
    newcombe_interval,
    normalise,
    paired_improvement,
    performance_profile,
    permutation_p_value,
    probability_of_improvement,
    runs_needed,
    steps_to_threshold,
    win_share,
)

# What rliable 1.2.0 (arch 7.2.0, pandas 2.3.3, NumPy 2.4.6) gave for these scores, runs × environments:
# metrics.aggregate_iqm, aggregate_mean, probability_of_improvement; library.score_distributions; and
# library.get_interval_estimates with 50000 (iqm, mean) and 5000 (improvement) resamples, create_performance_profile
# with 20000, after np.random.seed(0).
X = np.array([
    [1.0, 1.09, 0.918], [0.733, 0.864, 0.703], [1.018, 1.402, 0.852], [0.814, 1.147, 1.107],
    [1.032, 0.721, 0.991], [1.209, 0.597, 0.863], [0.43, 0.613, 0.447], [0.929, 0.62, 1.081],
])  # fmt: skip
Y = np.array([
    [1.0, 0.725, -0.207], [0.585, 0.781, 0.845], [0.188, 0.609, 0.409],
    [0.476, 1.224, 0.477], [0.787, 1.154, 0.567], [0.755, 0.844, 0.826],
])  # fmt: skip
RLIABLE = {
    "iqm x": 0.8945833333333333,
    "iqm y": 0.6956,
    "mean x": 0.8825416666666667,
    "improvement": 0.6979166666666666,
    "iqm interval": (0.77941458, 1.00008333),
    "mean interval": (0.78720833, 0.97783333),
    "improvement interval": (0.54861111, 0.84027778),
    "thresholds": [0.5, 0.8, 1.0, 1.2],
    "profile": [0.91666667, 0.66666667, 0.33333333, 0.08333333],
    "profile low": [0.79166667, 0.5, 0.16666667, 0.0],
    "profile high": [1.0, 0.83333333, 0.54166667, 0.20833333],
}


def strata(scores):
    return list(scores.T)


def test_point_estimates_equal_rliable():
    assert bootstrap_interval(strata(X)).estimate == pytest.approx(RLIABLE["iqm x"], rel=1e-12)
    assert bootstrap_interval(strata(Y)).estimate == pytest.approx(RLIABLE["iqm y"], rel=1e-12)
    assert bootstrap_interval(strata(X), mean).estimate == pytest.approx(RLIABLE["mean x"], rel=1e-12)
    improvement = probability_of_improvement(strata(X), strata(Y))
    assert improvement.estimate == pytest.approx(RLIABLE["improvement"], rel=1e-12)


def test_intervals_equal_rliable_up_to_resampling_noise():
    for statistic, name in ((interquartile_mean, "iqm interval"), (mean, "mean interval")):
        assert bootstrap_interval(strata(X), statistic)[1:3] == pytest.approx(RLIABLE[name], abs=0.012)


def test_interval_of_improvement_is_a_little_wider_than_rliables():
    improvement = probability_of_improvement(strata(X), strata(Y))
    low, high = RLIABLE["improvement interval"]
    assert low - 0.1 < improvement.low <= low + 0.012
    assert high - 0.012 <= improvement.high < high + 0.1


def test_bootstrap_of_improvement_equals_rliable():
    drawn = zip(statistics.resample(strata(X)), statistics.resample(strata(Y), seed=1))
    bounds = statistics.percentiles(np.mean([win_share(a, b) for a, b in drawn], axis=0))
    assert bounds == pytest.approx(RLIABLE["improvement interval"], abs=0.015)


def test_profile_equals_rliable():
    profile = performance_profile(strata(X), np.array(RLIABLE["thresholds"]))
    assert profile.middle == pytest.approx(RLIABLE["profile"])
    assert profile.low == pytest.approx(RLIABLE["profile low"], abs=0.045)
    assert profile.high == pytest.approx(RLIABLE["profile high"], abs=0.045)
    assert profile.runs == 24


def test_interquartile_mean_by_hand():
    assert interquartile_mean(np.arange(1.0, 9.0)) == 4.5  # of 3, 4, 5, 6
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 1000.0])) == 1.5
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0  # too few to trim: the mean


def test_interval_of_two_runs_spans_them():
    assert bootstrap_interval([np.array([2.0, 8.0])]) == Interval(5.0, 2.0, 8.0, 2)


def test_interval_of_the_mean_approaches_the_normal_one():
    values = np.random.default_rng(3).normal(5, 2, 400)
    interval = bootstrap_interval([values], mean)
    half = 1.96 * values.std() / math.sqrt(400)
    assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=0.05)


def test_strata_are_resampled_apart():
    far_apart = [np.array([0.0, 0.0]), np.array([100.0, 100.0])]
    assert bootstrap_interval(far_apart, mean) == Interval(50.0, 50.0, 50.0, 4)


def test_one_run_has_no_interval():
    interval = bootstrap_interval([np.array([3.0])])
    assert interval.estimate == 3.0
    assert not interval.exists
    assert math.isnan(interval.low)
    assert math.isnan(bootstrap_interval([]).estimate)
    assert np.isnan(bootstrap_band([np.ones((1, 4))]).low).all()


def test_infinite_scores_keep_their_interval():
    interval = bootstrap_interval([np.array([1.0, 2.0, np.inf])], median)
    assert (interval.estimate, interval.low, interval.high) == (2.0, 1.0, np.inf)


def test_same_input_same_interval():
    values = [np.random.default_rng(1).normal(size=6)]
    assert bootstrap_interval(values) == bootstrap_interval(values)


def test_win_share_is_mann_whitney_with_ties_as_half():
    x, y = np.array([1.0, 2.0, 3.0]), np.array([2.0, 0.0])
    u = stats.mannwhitneyu(x, y, alternative="greater").statistic
    assert win_share(x, y) == u / 6 == pytest.approx(4.5 / 6)


@pytest.mark.parametrize(("share", "m", "n"), [(0.8, 5, 5), (0.5, 4, 7), (0.96, 5, 5)])
def test_newcombe_bounds_solve_their_equation(share, m, n):
    for bound in newcombe_interval(share, m, n):
        spread = (m + n) / 2 - 1
        variance = bound * (1 - bound) / (m * n) * (1 + spread * ((1 - bound) / (2 - bound) + bound / (1 + bound)))
        assert (share - bound) ** 2 == pytest.approx(stats.norm.ppf(0.975) ** 2 * variance, rel=1e-6)


def test_newcombe_is_symmetric_and_never_empty():
    low, high = newcombe_interval(0.7, 6, 6)
    assert newcombe_interval(1 - 0.7, 6, 6) == pytest.approx((1 - high, 1 - low))
    low, high = newcombe_interval(1.0, 5, 5)
    assert 0.5 < low < 0.8
    assert high == 1.0


def test_permutation_test_equals_the_exact_one():
    x, y = np.array([5.0, 6.0, 7.0, 8.0]), np.array([1.0, 2.0, 3.0, 4.0])
    assert permutation_p_value([x], [y]) == pytest.approx(2 / 70, abs=0.008)
    assert permutation_p_value([x[:3]], [y[:3]]) == pytest.approx(2 / 20, abs=0.015)


@pytest.mark.parametrize(("runs", "decided"), [(2, False), (3, False), (4, True), (10, True)])
def test_complete_separation_is_decided_from_four_runs_on(runs, decided):
    x, y = np.arange(100.0, 100.0 + runs), np.arange(float(runs))
    improvement = probability_of_improvement([x], [y])
    assert improvement.estimate == 1.0
    assert improvement.low < 1.0
    assert improvement.decided is decided
    sentence = pair_sentence("averaged", "sac", improvement)
    assert ("beats" in sentence) is decided
    assert f"{runs} seeds" in sentence


def test_equal_variants_are_seldom_told_apart():
    generator = np.random.default_rng(5)
    wrong = sum(
        probability_of_improvement([generator.normal(size=5)], [generator.normal(size=5)]).decided for _ in range(120)
    )
    assert wrong <= 12  # 5 % of 120 is 6


def test_paired_is_wilson_over_equal_seeds():
    pairs = [(np.array([2.0, 3.0, 4.0, 1.0, 9.0]), np.array([1.0, 2.0, 3.0, 5.0, 8.0]))]
    paired = paired_improvement(pairs)
    wilson = stats.binomtest(4, 5).proportion_ci(method="wilson")
    assert paired[:3] == pytest.approx((0.8, wilson.low, wilson.high))
    assert paired.runs == 5
    assert paired_improvement([]).runs == 0
    assert not paired_improvement([(np.array([1.0]), np.array([0.0]))]).exists


def test_runs_needed_is_noether():
    # (1.95996 + 0.84162)² / (6 · 0.2²) = 32.7; for P = 1 it is 5.2
    assert runs_needed(0.7) == runs_needed(0.3) == 33
    assert runs_needed(1.0) == 6
    assert runs_needed(0.5) == math.inf


def improvement(p, low, high, x=5, y=5):
    return Improvement(p, low, high, x, y, Interval(math.nan, math.nan, math.nan, 0))


def test_difference_of_means_by_hand():
    """Means 6 and 2, variances 4 and 1, of 4 runs each: s = √(4/4 + 1/4), ν = 1.25² / (1/3 + (1/4)²/3) by Welch."""
    x = np.array([6 - 3**0.5, 6 - 3**0.5, 6 + 3**0.5, 6 + 3**0.5])
    y = 2 + (x - 6) / 2
    freedom = 1.25**2 / ((1 + 0.25**2) / 3)
    half = stats.t.ppf(0.975, freedom) * 1.25**0.5
    assert half == pytest.approx(2.68 * 1.118, rel=0.01)
    assert difference_of_means(x, y) == pytest.approx((4.0, 4 - half, 4 + half, 4))
    assert difference_of_means(y, x)[:3] == pytest.approx((-4.0, -4 - half, -4 + half))


def test_difference_of_means_without_a_spread_or_a_second_run():
    assert difference_of_means(np.array([3.0, 3.0]), np.array([1.0, 1.0, 1.0])) == Interval(2.0, 2.0, 2.0, 2)
    alone = difference_of_means(np.array([3.0]), np.array([1.0, 2.0]))
    assert alone.estimate == 1.5
    assert not alone.exists
    assert difference_of_means(np.array([]), np.array([1.0])).runs == 0


def test_sentences():
    assert pair_sentence("averaged", "sac", improvement(0.83, 0.61, 0.97)) == (
        "averaged beats sac: P = 0.83 [0.61, 0.97], 5 seeds."
    )
    assert pair_sentence("sac", "averaged", improvement(0.17, 0.03, 0.39, 4, 5)) == (
        "averaged beats sac: P = 0.83 [0.61, 0.97], 5 and 4 seeds."
    )
    undecided = pair_sentence("averaged", "sac", improvement(0.7, 0.4, 0.9))
    assert undecided.startswith("5 seeds cannot tell averaged and sac apart (P = 0.70 [0.40, 0.90]); about 33 would")
    assert "even a thousand would not" in pair_sentence("a", "b", improvement(0.5, 0.2, 0.8))
    several = pair_sentence("averaged", "sac", improvement(0.7, 0.4, 0.9, 2, 3), several_environments=True)
    assert several.startswith("2 and 3 seeds or more in each environment cannot tell averaged and sac apart (P = 0.70 ")
    assert several.endswith("; more seeds might.")
    alone = pair_sentence("a", "b", improvement(1.0, math.nan, math.nan, 1, 1))
    assert "no interval exists" in alone
    assert "beats" not in alone
    assert "one seed of a" in pair_sentence("a", "b", improvement(1.0, math.nan, math.nan, 1, 3))


def test_area_threshold_normalise_by_hand():
    steps, returns = np.array([0.0, 10.0, 30.0]), np.array([0.0, 4.0, 8.0])
    assert area_under_curve(steps, returns) == pytest.approx((20 + 120) / 30)
    assert area_under_curve(steps[:1], returns[1:2]) == 4.0
    assert steps_to_threshold(steps, returns, 4.0) == 10.0
    assert steps_to_threshold(steps, returns, 9.0) == math.inf
    assert normalise(np.array([2.0, 6.0]), 2.0, 4.0).tolist() == [0.0, 2.0]
    assert normalise(np.array([2.0]), 2.0, 2.0).tolist() == [0.5]


def test_bands_resample_whole_runs():
    curves = np.stack([np.zeros(4), np.ones(4)])
    band = bootstrap_band([curves])
    assert band.middle.tolist() == [0.5] * 4
    assert band.low.tolist() == [0.0] * 4
    assert band.high.tolist() == [1.0] * 4
