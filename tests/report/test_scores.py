"""From evaluation returns to scores, by hand."""

import math

import numpy as np
import pytest

from saclab.report.runs import read_comparison
from saclab.report.scores import aggregate, common_horizon, score_environment
from saclab.report.sentences import MORE_SEEDS, ONE_SEED, aggregate_sentences, environment_sentences
from saclab.report.text import number_text
from saclab.variants import VARIANTS, Variant

from .synthetic import write_run


def scores_of(folders):
    return score_environment(read_comparison(folders), "HalfCheetah-v4")


def test_scores_of_one_run_by_hand(tmp_path):
    returns = [100.0 * index for index in range(1, 21)]
    entry = scores_of([write_run(tmp_path, returns=returns)])
    (run,) = entry.arms[0].runs
    assert run.final == 1950.0  # the last two of twenty evaluations
    assert run.best == 2000.0
    assert run.area == pytest.approx(1050.0)
    assert run.evaluations == 20
    assert entry.threshold == 1950.0
    assert run.steps_to_threshold == 200_000  # the evaluation at 2000
    assert not entry.arms[0].final.exists
    assert entry.arms[0].paper_best == 10182.9


def test_pairs_use_equal_seeds_and_all_pairs(tmp_path):
    levels = {"sac": {0: 10.0, 1: 20.0, 2: 30.0}, "averaged": {1: 25.0, 2: 35.0, 3: 5.0}}
    folders = [
        write_run(tmp_path, variant, seed, returns=[level])
        for variant, by_seed in levels.items() for seed, level in by_seed.items()
    ]  # fmt: skip
    (pair,) = scores_of(folders).pairs
    assert (pair.x.name, pair.y.name) == ("sac", "averaged")
    assert pair.improvement.estimate == pytest.approx(4 / 9)  # sac above averaged: 10>5, 20>5, 30>25, 30>5
    assert pair.improvement.paired[:1] == (0.0,)
    assert pair.improvement.paired.runs == 2


def test_pairs_are_compared_by_final_return_and_by_area(tmp_path):
    """Three evaluations each, 10,000 steps apart: sac rises late, averaged early, and both end at the same levels."""
    curves = {"sac": (0.0, 0.0, 10.0), "averaged": (0.0, 10.0, 10.0)}
    folders = [
        write_run(tmp_path, variant, seed, returns=[value + 2 * seed for value in curve])
        for variant, curve in curves.items() for seed in (0, 1)
    ]  # fmt: skip
    (pair,) = scores_of(folders).pairs
    assert pair.final.improvement.estimate == 0.5
    assert pair.final.difference.estimate == 0.0
    assert pair.area.improvement.estimate == 0.0  # (0 + 5) / 2 = 2.5 and 4.5; (5 + 10) / 2 = 7.5 and 9.5
    half = 4.302652729911275 * 2**0.5  # t(0.975, ν = 2) · √(2/2 + 2/2), the variance of two seeds 2 apart being 2
    assert pair.area.difference == pytest.approx((-5.0, -5.0 - half, -5.0 + half, 2))


def test_unfinished_runs_cut_all_to_their_length(tmp_path):
    folders = [
        write_run(tmp_path, "sac", 0, returns=[1.0, 2.0, 3.0, 4.0]),
        write_run(tmp_path, "averaged", 0, returns=[5.0, 6.0], finished=False),
    ]
    entry = scores_of(folders)
    assert entry.horizon == 20_000
    assert [arm.runs[0].final for arm in entry.arms] == [2.0, 6.0]
    assert any("up to 20,000 environment steps" in sentence for sentence in environment_sentences(entry))


def test_a_run_that_stopped_by_rule_cuts_nobody(tmp_path):
    folders = [write_run(tmp_path, "sac", 0, returns=[1.0] * 4), write_run(tmp_path, "averaged", 0, returns=[5.0])]
    assert common_horizon(read_comparison(folders).runs) is None


def test_different_budgets_are_cut_to_the_shortest(tmp_path):
    folders = [
        write_run(tmp_path, "sac", 0, returns=[1.0] * 4),
        write_run(tmp_path, "averaged", 0, returns=[5.0] * 2, overrides={"max_updates": 4000}),
    ]
    assert common_horizon(read_comparison(folders, allow_mixed=True).runs) == 20_000


@pytest.mark.parametrize("row", [{"updates_per_interval": 20}, {"random_steps": 5_000}, {"update_interval": 1}])
def test_equal_updates_of_unequal_ratios_are_unequal_budgets(tmp_path, monkeypatch, row):
    """1.2e6 updates at 1:5 are 6e6 steps, at 20:5 3e5: a run that went further is cut where the other ended."""
    monkeypatch.setitem(VARIANTS, "redq", Variant("REDQ", "", row))
    folders = [
        write_run(tmp_path, "sac", 0, returns=[1.0, 2.0, 3.0, 4.0]),
        write_run(tmp_path, "redq", 0, returns=[5.0, 6.0]),
    ]
    entry = scores_of(folders)
    assert entry.horizon == 20_000
    assert [arm.runs[0].best for arm in entry.arms] == [2.0, 6.0]


def test_equal_steps_of_unequal_ratios_cut_nobody(tmp_path, monkeypatch):
    monkeypatch.setitem(VARIANTS, "redq", Variant("REDQ", "", {"updates_per_interval": 20}))
    folders = [write_run(tmp_path, variant, protocol="standard", returns=[1.0] * count)
               for variant, count in (("sac", 4), ("redq", 2))]  # fmt: skip
    assert common_horizon(read_comparison(folders).runs) is None


def test_without_evaluations_there_is_nothing_to_compare(tmp_path):
    entry = scores_of([write_run(tmp_path, "sac", seed, evaluations=0, finished=False) for seed in (0, 1)])
    assert entry.arms[0].runs == ()
    assert environment_sentences(entry) == ["No run has an evaluation so far, so there is nothing to compare."]


def test_a_run_with_returns_that_are_not_numbers_is_left_out(tmp_path):
    folders = [write_run(tmp_path, "sac", 0, returns=[1.0, math.nan], finished=False),
               write_run(tmp_path, "sac", 1, returns=[2.0])]  # fmt: skip
    assert [run.seed for run in scores_of(folders).arms[0].runs] == [1]


def test_few_seeds_are_warned_of(tmp_path):
    folders = [write_run(tmp_path, variant, seed, returns=[level + seed])
               for variant, level in (("sac", 10.0), ("averaged", 10.5)) for seed in (0, 1)]  # fmt: skip
    text = " ".join(environment_sentences(scores_of(folders)))
    assert "fewer than 5 seeds" in text
    assert "2 seeds cannot tell averaged and sac apart (P = 0.75 " in text


@pytest.mark.parametrize("variants", [("sac", "averaged"), ("sac", "sac-auto", "averaged", "averaged-auto")])
def test_one_seed_each_allows_no_conclusion_and_says_how_to_get_one(tmp_path, variants):
    folders = [write_run(tmp_path, variant, returns=[1000.0 + len(variant)]) for variant in variants]
    first, second = environment_sentences(scores_of(folders))
    assert first == ONE_SEED
    assert "no conclusion" in first
    assert "--seeds 5" in first
    levels = "; ".join(f"{variant} {number_text(1000 + len(variant))}" for variant in variants)
    assert second == f"Final evaluation return (one seed, no interval): {levels}."


def test_variants_of_one_seed_among_others_take_one_sentence(tmp_path):
    folders = [write_run(tmp_path, variant) for variant in ("sac", "sac-auto", "averaged", "averaged-auto")]
    folders += [write_run(tmp_path, variant, 1) for variant in ("sac", "averaged")]
    known, unknown, *_ = environment_sentences(scores_of(folders))
    assert "2 seeds cannot tell" in known
    assert unknown == f"With one seed only, nothing can be said about sac-auto, averaged-auto. {MORE_SEEDS}"


def test_aggregate_normalises_each_environment(tmp_path):
    folders = [
        write_run(tmp_path, variant, seed, environment, returns=[scale * (level + seed)])
        for environment, scale in (("HalfCheetah-v4", 1000.0), ("Humanoid-v4", 1.0))
        for variant, level in (("sac", 0.0), ("averaged", 2.0)) for seed in (0, 1, 2)
    ]  # fmt: skip
    comparison = read_comparison(folders)
    together = aggregate([score_environment(comparison, name) for name in comparison.environments])
    sac, averaged = together.arms
    # levels 0, 1, 2 and 2, 3, 4 of 4 in both environments
    assert sac.interquartile_mean.estimate == pytest.approx(0.25)
    assert averaged.interquartile_mean.estimate == pytest.approx(0.75)
    assert sac.interquartile_mean.runs == 6
    (pair,) = together.pairs
    assert pair.improvement.estimate == pytest.approx(0.5 / 9)
    assert np.isfinite(pair.improvement.low)
    assert aggregate_sentences(together)[0].endswith(", 3 seeds or more in each environment.")
    assert aggregate([score_environment(comparison, "Humanoid-v4")]) is None


def test_numbers_in_words():
    assert [number_text(value) for value in (-1234.5, 12.34, 0.123, math.inf)] == [
        "−1,234",
        "12.3",
        "0.12",
        "not reached",
    ]
