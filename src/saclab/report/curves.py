"""The curves of a run, what they mean, and how those of several seeds become one line with a band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saclab.algorithm.metrics import METRICS
from saclab.report.arms import Arm
from saclab.report.runs import Comparison
from saclab.report.statistics import bootstrap_band
from saclab.report.text import shown
from saclab.training.logs import REMAINDER, plain_words
from saclab.training.run_folder import RunRecord

AXES = {
    "episodes": "training episodes",
    "steps": "environment steps",
    "updates": "updates",
    "seconds": "wall-clock time, hours",
}


class Quantity(NamedTuple):
    """Something that is drawn over training."""

    key: str
    title: str
    table: str
    """Field of RunRecord that holds it."""
    column: str
    axis: str
    """Key of AXES that it is drawn over in the figures."""
    meaning: str


PAPER_PANELS = (
    Quantity("policy_loss", "policy loss", "metrics", "actor_loss", "updates",
             "α log π − Q of the policy's own actions (Eq. 5); about the negative of the critic's value"),
    Quantity("training_return", "training return", "episodes", "return", "episodes",
             "return of each training episode, with the policy's noise"),
    Quantity("running_average", "training return, running average", "episodes", "running_average", "episodes",
             "0.8 old + 0.2 new"),
    Quantity("evaluation_return", "evaluation return", "evaluations", "mean_return", "episodes",
             "mean return of the deterministic policy"),
)  # fmt: skip
"""The panels of the paper's Figures 1 and 2."""

DIAGNOSTICS = (
    Quantity("temperature", "temperature α", "metrics", "temperature", "updates", "the weight of the entropy"),
    Quantity("entropy", "policy entropy", "metrics", "entropy", "updates", "nats, of actions in [−1, 1]"),
    Quantity("q_mean", "mean Q", "metrics", "q_mean", "updates", "the critics' estimate on replayed actions"),
    Quantity("q_spread", "Q spread", "metrics", "q_spread", "updates", "standard deviation between the critics"),
    Quantity("snapshot_spread", "snapshot spread", "metrics", "snapshot_spread", "updates",
             "standard deviation between the K target snapshots' values; 0 for K = 1: "
             "how much there is to average (Eq. 9)"),
    Quantity("q_bias", "Q bias", "q_bias", "mean_bias", "updates",
             "(Q − Monte-Carlo soft return) / |mean return|; above 0 the critics overestimate"),
    Quantity("q_bias_spread", "Q bias, spread", "q_bias", "bias_spread", "updates",
             "standard deviation of the Q bias over states"),
)  # fmt: skip
"""What has a title of its own; whatever else a variant reports comes behind it under its name."""

COUNTERS = ("updates", "steps", "episodes", "seconds")
"""Columns of metrics.jsonl that are no metric."""

OF_RETURN = "mean return of this reward term in an evaluation, as the environment tells it: they add up to the return"
OF_WEIGHT = "what the critics' reward weighs the term by from the evaluation on"
ROUNDING = 1e-6
"""Share of the largest term's return below which another is rounding."""

POINTS = 200
"""At most so many points per curve: beyond it one sees only noise."""
ALL_POINTS = 50_000
"""At most so many points per quantity over all runs of a report, so that the page stays small."""


class Series(NamedTuple):
    """One quantity of one run; the arrays have equal lengths."""

    x: dict[str, np.ndarray]
    """Key of AXES -> values; hours for seconds."""
    y: np.ndarray


class SeedBand(NamedTuple):
    """One quantity of several seeds, as far as all of them go."""

    x: dict[str, np.ndarray]
    """Mean over the seeds."""
    middle: np.ndarray
    """Interquartile mean over the seeds."""
    low: np.ndarray
    """NaN with one seed: there is no interval."""
    high: np.ndarray
    runs: int


class ArmCurves(NamedTuple):
    """One quantity of one arm in one environment."""

    runs: dict[int, Series]
    """Seed -> its curve, without those that have no value yet."""
    band: SeedBand


Curves = dict[tuple[str, Arm, Quantity], ArmCurves]
"""(environment, arm, quantity) -> curves; missing where nothing was logged."""


def gather_curves(comparison: Comparison) -> Curves:
    """All quantities of all runs, thinned to what a figure can show; rows of equal runs stay aligned.

    A diagnostic that is 0 throughout an environment is none: the loss of a temperature that is fixed, the spread of a
    single snapshot.
    """
    points = max(20, min(POINTS, ALL_POINTS // len(comparison.runs)))
    gathered: Curves = {}
    for environment in comparison.environments:
        runs_here = comparison.runs_of(environment)
        for quantity in PAPER_PANELS + reward_terms(runs_here) + DIAGNOSTICS + other_metrics(runs_here):
            whole = {(arm, run.config.seed): curve
                     for arm in comparison.arms_of(environment)
                     for run in comparison.groups[environment, arm]
                     if (curve := series(run, quantity))}  # fmt: skip
            if quantity not in PAPER_PANELS and not any(curve.y.any() for curve in whole.values()):
                continue
            block = -(-max((len(curve.y) for curve in whole.values()), default=1) // points)
            for arm in comparison.arms_of(environment):
                runs = {seed: thin(curve, block) for (owner, seed), curve in whole.items() if owner == arm}
                if runs:
                    gathered[environment, arm, quantity] = ArmCurves(runs, band(list(runs.values())))
    return gathered


def reward_terms(runs: Sequence[RunRecord]) -> tuple[Quantity, ...]:
    """The return of each reward term of these runs, then its weight wherever a weight is not 1.

    A remainder that is nothing but rounding is none.
    """
    tables = [named_terms(run) for run in runs]
    logged = {name: None for table in tables for name in table}
    values = {name: np.concatenate([table[name] for table in tables if name in table]) for name in logged}
    largest = {name: np.abs(column).max(initial=0) for name, column in values.items() if name.startswith("return of ")}
    returns = [name for name, size in largest.items() if size > ROUNDING * max(largest.values())]
    weights = [name for name, column in values.items() if name.startswith("weight of ") and (column != 1).any()]
    return tuple(
        Quantity(f"term {name}", shown(name, 50), "reward_terms", name, "updates", meaning)
        for names, meaning in ((returns, OF_RETURN), (weights, OF_WEIGHT))
        for name in names
    )


def named_terms(run: RunRecord) -> dict[str, np.ndarray]:
    """A run's log of reward terms with 'return of <term>' for columns, where the log may have a number for the term."""
    terms = run.config.algorithm.terms_of_reward
    names = dict(zip(plain_words(terms), terms, strict=True)) | {REMAINDER: "the remainder"}

    def named(column: str) -> str:
        kind, _, word = column.partition("_")
        return f"{kind} of {names.get(word, word)}" if kind in ("return", "weight") else column

    return {named(column): values for column, values in run.reward_terms.items()}


def other_metrics(runs: Sequence[RunRecord]) -> tuple[Quantity, ...]:
    """What runs have logged beside the quantities that have a title of their own; first what this version knows."""
    titled = {quantity.column for quantity in PAPER_PANELS + DIAGNOSTICS if quantity.table == "metrics"}
    logged = {name: None for run in runs for name, values in run.metrics.items() if values.ndim == 1}
    names = [name for name in METRICS if name in logged] + [name for name in logged if name not in METRICS]
    return tuple(
        Quantity(f"metric {name}", shown(name, 40), "metrics", name, "updates", METRICS.get(name, ""))
        for name in names if name not in titled and name not in COUNTERS
    )  # fmt: skip


def diagnostics(curves: Curves, environment: str) -> tuple[Quantity, ...]:
    """What the runs of an environment have beside the paper's panels."""
    found = {quantity: None for name, _, quantity in curves if name == environment}
    return tuple(quantity for quantity in found if quantity not in PAPER_PANELS)


def series(run: RunRecord, quantity: Quantity) -> Series | None:
    """The quantity over all axes of a run; None if the run has no finite value of it yet."""
    of_terms = quantity.table == "reward_terms"
    table: dict[str, np.ndarray] = named_terms(run) if of_terms else getattr(run, quantity.table)
    if len(table.get(quantity.column, ())) == 0:
        return None
    y = np.asarray(table[quantity.column], np.float64)
    x = {"updates": table["updates"], "steps": table["steps"], "seconds": table["seconds"] / 3600}
    x["episodes"] = episode_numbers(run, quantity.table)
    finite = np.isfinite(y)
    if not finite.any():
        return None
    return Series({axis: values[finite] for axis, values in x.items()}, y[finite])


def episode_numbers(run: RunRecord, table: str) -> np.ndarray:
    """Training episodes ended at each row of a table; between the ends of episodes by interpolation."""
    rows: dict[str, np.ndarray] = getattr(run, table)
    if table == "episodes":
        return rows["episode"]
    if "episodes" in rows:
        return rows["episodes"]
    ends = run.episodes
    if len(ends.get("episode", ())) == 0:
        return np.zeros(len(rows["updates"]))
    first = ends["episode"][0] - 1
    return np.asarray(np.interp(rows["updates"], [0, *ends["updates"]], [first, *ends["episode"]]))


def thin(curve: Series, block: int) -> Series:
    """Each point the mean of `block` rows in a row; the last may have fewer."""
    if block <= 1:
        return curve
    starts = np.arange(0, len(curve.y), block)
    counts = np.diff([*starts, len(curve.y)])

    def means(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.add.reduceat(values, starts) / counts)

    return Series({axis: means(values) for axis, values in curve.x.items()}, means(curve.y))


def band(curves: Sequence[Series]) -> SeedBand:
    """Row by row over at least one seed, up to where the shortest ends: beyond, survivors would speak for all."""
    length = min(len(curve.y) for curve in curves)
    x = {axis: np.mean([curve.x[axis][:length] for curve in curves], axis=0) for axis in AXES}
    values = bootstrap_band([np.stack([curve.y[:length] for curve in curves])])
    return SeedBand(x, values.middle, values.low, values.high, values.runs)
