"""The summary of a report in sentences: verdicts, the levels they rest on, what to beware of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saclab.report.pairs import Pair
from saclab.report.scores import AggregateScores, ArmScores, EnvironmentScores
from saclab.report.statistics import FEW_RUNS, Improvement, runs_needed
from saclab.report.text import count_text, interval_text, number_text, shown

MORE_SEEDS = "More seeds can change that: compare again with --seeds 5; finished runs are kept."
ONE_SEED = f"One seed of each variant allows no conclusion about which is better. {MORE_SEEDS}"
ONE_SEED_SOMEWHERE = f"One seed in an environment allows no conclusion over all of them. {MORE_SEEDS}"
MANY_ARMS = 5
"""Number of arms from which on they are ranked, an arm that beats others takes one sentence, and so do all pairs that
cannot be told apart."""


def summary_sentences(
    scores: Sequence[EnvironmentScores], together: AggregateScores | None
) -> list[tuple[str, list[str]]]:
    """The answer first: for each environment, then for all of them together, a title and sentences."""
    found = [(shown(entry.environment), environment_sentences(entry)) for entry in scores]
    return found if together is None else [*found, ("All environments together", aggregate_sentences(together))]


def environment_sentences(scores: EnvironmentScores) -> list[str]:
    """The summary of an environment: first the verdicts, then the levels they rest on, then what to beware of."""
    evaluated = [arm for arm in scores.arms if arm.runs]
    if not evaluated:
        return ["No run has an evaluation so far, so there is nothing to compare."]
    sentences = pair_sentences(scores.pairs)
    seeds = [len(arm.runs) for arm in evaluated]
    sentences.append(levels_sentence(evaluated, one_seed=max(seeds) == 1))
    if any(1 < count < FEW_RUNS for count in seeds):
        sentences.append(
            f"With fewer than {FEW_RUNS} seeds the bootstrap intervals of returns are too narrow: read them as hints."
        )
    if scores.horizon is not None:
        sentences.append(
            f"All runs are scored up to {scores.horizon:,.0f} environment steps only, where the shortest one stands."
        )
    return sentences


def levels_sentence(arms: Sequence[ArmScores], one_seed: bool) -> str:
    """The final return of each arm; many arms stand in the order of theirs."""
    many = len(arms) >= MANY_ARMS
    if many:
        arms = sorted(arms, key=lambda arm: -arm.final.estimate)
    notes = ["highest first"] * many + ["one seed, no interval"] * one_seed
    level = "Final evaluation return" + f" ({', '.join(notes)})" * bool(notes)
    texts = (number_text(arm.final.estimate) if one_seed else interval_text(arm.final) for arm in arms)
    return f"{level}: {'; '.join(f'{arm.arm.name} {text}' for arm, text in zip(arms, texts))}."


def aggregate_sentences(together: AggregateScores) -> list[str]:
    """The summary of all environments together."""
    levels = "; ".join(f"{entry.arm.name} {interval_text(entry.interquartile_mean)}" for entry in together.arms)
    return [
        *pair_sentences(together.pairs, several_environments=True),
        f"Normalised final evaluation return: {levels.replace(' seeds', ' runs')}.",
    ]


def pair_sentences(pairs: Sequence[Pair], several_environments: bool = False) -> list[str]:
    """Decided pairs first, then undecided ones; those that no interval exists for in one sentence."""

    def sentence(pair: Pair) -> str:
        return pair_sentence(pair.x.name, pair.y.name, pair.improvement, several_environments)

    known = [pair for pair in pairs if pair.improvement.exists]
    decided = [pair for pair in known if pair.improvement.decided]
    undecided = [pair for pair in known if not pair.improvement.decided]
    runs = {pair.x: pair.improvement.runs_x for pair in pairs} | {pair.y: pair.improvement.runs_y for pair in pairs}
    many = len(runs) >= MANY_ARMS
    sentences = winner_sentences(decided) if many else [sentence(pair) for pair in decided]
    if many and len(undecided) > 1:
        sentences.append(undecided_sentence(undecided, len(known)))
    else:
        sentences += [sentence(pair) for pair in undecided]
    alone = [arm.name for arm, count in runs.items() if count < 2]
    if alone and len(alone) == len(runs):
        return [ONE_SEED_SOMEWHERE if several_environments else ONE_SEED]
    if alone:
        sentences.append(f"With one seed only, nothing can be said about {', '.join(alone)}. {MORE_SEEDS}")
    return sentences


def winner_sentences(pairs: Sequence[Pair]) -> list[str]:
    """What is to be said of decided pairs: one sentence for each arm that beats others, most of them first."""
    beaten: dict[str, dict[str, float]] = {}
    for pair in pairs:
        p = pair.improvement.estimate
        winner, loser = (pair.x.name, pair.y.name) if p > 0.5 else (pair.y.name, pair.x.name)
        beaten.setdefault(winner, {})[loser] = max(p, 1 - p)
    sentences = []
    for winner, losers in sorted(beaten.items(), key=lambda entry: -len(entry[1])):
        lowest, highest = min(losers.values()), max(losers.values())
        chance = f"{lowest:.2f}" if f"{lowest:.2f}" == f"{highest:.2f}" else f"{lowest:.2f} to {highest:.2f}"
        sentences.append(f"{winner} beats {', '.join(losers)}: P = {chance}; the intervals stand in the table.")
    return sentences


def undecided_sentence(pairs: Sequence[Pair], of: int) -> str:
    """What is to be said of pairs that cannot be told apart: their number, and the one that comes nearest."""
    nearest = max(pairs, key=lambda pair: abs(pair.improvement.estimate - 0.5))
    x, y, (p, low, high, *_) = nearest.x.name, nearest.y.name, nearest.improvement
    if p < 0.5:
        x, y, p, low, high = y, x, 1 - p, 1 - high, 1 - low
    return (
        f"{len(pairs)} of the {count_text(of, 'pair')} cannot be told apart with these seeds; the nearest to a verdict "
        f"is {x} above {y} (P = {p:.2f} [{low:.2f}, {high:.2f}])."
    )


def pair_sentence(x: str, y: str, improvement: Improvement, several_environments: bool = False) -> str:
    """What the runs say about the variants named `x` and `y`, in one plain sentence.

    Over several environments it tells the seeds of the one with the fewest, and not how many are needed.
    """
    p, low, high, runs_x, runs_y, _ = improvement
    same = runs_x == runs_y
    seeds = f"{runs_x} seed{'s' * (runs_x != 1)}" if same else f"{runs_x} and {runs_y} seeds"
    if np.isnan(low):
        which = f"one seed of {x if runs_x < runs_y else y}" if not same else "one seed each"
        return f"{x} and {y}: with {which} no interval exists, so nothing can be said about which is better."
    if p < 0.5:
        x, y, p, low, high = y, x, 1 - p, 1 - high, 1 - low
        seeds = seeds if same else f"{runs_y} and {runs_x} seeds"
    seeds += " or more in each environment" * several_environments
    if low > 0.5:
        return f"{x} beats {y}: P = {p:.2f} [{low:.2f}, {high:.2f}], {seeds}."
    needed = max(runs_needed(p), max(runs_x, runs_y) + 1)
    if several_environments:
        outlook = "more seeds might"
    elif needed > 1000:
        outlook = "even a thousand would not"
    else:
        outlook = f"about {needed:.0f} would, if the difference is as it looks"
    return f"{seeds} cannot tell {x} and {y} apart (P = {p:.2f} [{low:.2f}, {high:.2f}]); {outlook}."
