"""The pictures of a tune: what mattered, how the search went, every trial as a line, each setting by itself."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np

from saclab.report.text import shown
from saclab.tuning.plan import TunePlan
from saclab.tuning.space import Choice, Range, value_text, values_of
from saclab.tuning.study import ended_trials, is_complete

if TYPE_CHECKING:
    import optuna
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from optuna.trial import FrozenTrial

matplotlib.use("agg")

COLOURS = "viridis_r"
DARK, LIGHT = "#0072b2", "#bbbbb6"
COLUMNS = 4  # of the pictures of single settings


def figures(study: optuna.Study, plan: TunePlan) -> Iterator[tuple[str, bytes]]:
    """Captions and PNG pictures of those that the trials so far allow."""
    complete = [trial for trial in ended_trials(study) if is_complete(trial)]
    if not complete:
        return
    yield f"The way of the search: {plan.objective.title}", history(complete, plan)
    if importance := importances(study):
        yield "Importance of each setting (PED-ANOVA over the trials with a value)", bars(importance)
    yield "Parallel coordinates: each trial with a value is a line, the best ones dark", coordinates(complete, plan)
    yield "Each setting by itself", slices(complete, plan)
    if any(trial.intermediate_values for trial in study.trials):
        yield "What the trials had reached at each evaluation; those given up are grey", courses(study)


def importances(study: optuna.Study) -> dict[str, float]:
    """Setting -> its share of what decided the values, the largest first; empty if there are too few trials."""
    import optuna

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what Optuna calls experimental
        try:
            return optuna.importance.get_param_importances(study)
        except (ValueError, RuntimeError, ZeroDivisionError):
            return {}


def history(trials: Sequence[FrozenTrial], plan: TunePlan) -> bytes:
    """Each trial's value, and the best so far."""
    numbers, values = [trial.number for trial in trials], np.array([trial.value for trial in trials], float)
    best = (np.minimum if plan.objective.kind.to_score else np.maximum).accumulate(values)
    figure, axes = new_figure(6, 3.2)
    axes.step(numbers, best, where="post", color=DARK, label="best so far")
    axes.plot(numbers, values, "o", color="#d55e00", markersize=4, label="trial")
    axes.set(xlabel="trial", ylabel="value")
    axes.legend(frameon=False)
    return picture(figure)


def bars(importance: dict[str, float]) -> bytes:
    names = list(importance)[::-1]
    figure, axes = new_figure(6, 0.7 + 0.3 * len(names))
    axes.barh([shown(name) for name in names], [importance[name] for name in names], color=DARK)
    axes.set(xlabel="share", xlim=(0, 1))
    return picture(figure)


def coordinates(trials: Sequence[FrozenTrial], plan: TunePlan) -> bytes:
    """A line for each trial through an axis for each setting and one for the value."""
    scales = [place_of(dimension) for dimension in plan.space.values()]
    values = np.array([trial.value for trial in trials], float)
    low, high = float(values.min()), float(values.max())
    lines = [
        [scale(settings[name]) for name, scale in zip(plan.space, scales)]
        for settings in (values_of(plan.space, trial.params) for trial in trials)
    ]
    figure, axes = new_figure(1.4 * len(plan.space) + 2, 4.2)
    colours = matplotlib.colormaps[COLOURS]
    order = np.argsort(values)[:: 1 if not plan.objective.kind.to_score else -1]
    for place in order:  # the best on top
        height = (values[place] - low) / ((high - low) or 1)
        goodness = 1 - height if plan.objective.kind.to_score else height
        axes.plot([*lines[place], height], color=colours(goodness), alpha=0.35 + 0.6 * goodness, linewidth=1.4)
    for column, dimension in enumerate(plan.space.values()):
        axes.axvline(column, color=LIGHT, linewidth=1, zorder=0)
        for value in marks(dimension):
            axes.annotate(value_text(value), (column, place_of(dimension)(value)), fontsize=8, ha="center",
                          bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8})  # fmt: skip
    for height, value in ((0, low), (1, high)):
        axes.annotate(f"{value:.4g}", (len(plan.space), height), fontsize=8, ha="center",
                      bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8})  # fmt: skip
    axes.axvline(len(plan.space), color="#555555", linewidth=1, zorder=0)
    names = [shown(name).replace("_", "\n") for name in plan.space]
    axes.set_xticks(range(len(plan.space) + 1), [*names, "value"], fontsize=8)
    axes.set(yticks=[], ylim=(-0.06, 1.06))
    axes.spines[["left", "bottom"]].set_visible(False)
    return picture(figure)


def place_of(dimension: Range | Choice) -> Callable[[Any], float]:
    """What puts a setting's values between 0 and 1."""
    match dimension:
        case Choice(choices):
            return lambda value: choices.index(value) / (len(choices) - 1)
        case Range(low, high, log):
            scaled = math.log if log else float
            return lambda value: (scaled(value) - scaled(low)) / (scaled(high) - scaled(low))


def marks(dimension: Range | Choice) -> Sequence[Any]:
    """The values that an axis names."""
    match dimension:
        case Choice(choices):
            return choices
        case Range(low, high, log):
            return low, math.sqrt(low * high) if log else (low + high) / 2, high


def slices(trials: Sequence[FrozenTrial], plan: TunePlan) -> bytes:
    """The trials' values against each setting."""
    import matplotlib.pyplot as plt

    rows = math.ceil(len(plan.space) / COLUMNS)
    figure, grid = plt.subplots(
        rows, COLUMNS, figsize=(12, 2.6 * rows), layout="constrained", squeeze=False, sharey=True
    )
    for axes in grid.flat[len(plan.space) :]:
        axes.set_visible(False)
    for axes, (name, dimension) in zip(grid.flat, plan.space.items()):
        settings = [values_of(plan.space, trial.params)[name] for trial in trials]
        if isinstance(dimension, Choice):
            axes.set_xticks(range(len(dimension.choices)), list(map(value_text, dimension.choices)), fontsize=8)
            axes.set_xlim(-0.5, len(dimension.choices) - 0.5)
            settings = list(map(dimension.choices.index, settings))
        else:
            axes.set_xscale("log" if dimension.log else "linear")
            axes.set_xticks(marks(dimension), list(map(value_text, marks(dimension))), fontsize=8)
            axes.set_xticks([], minor=True)
        axes.plot(settings, [trial.value for trial in trials], "o", color=DARK, markersize=4, alpha=0.7)
        axes.set_title(shown(name), fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    return picture(figure)


def courses(study: optuna.Study) -> bytes:
    figure, axes = new_figure(6, 3.2)
    for trial in study.trials:
        steps, values = list(trial.intermediate_values), list(trial.intermediate_values.values())
        axes.plot(steps, values, color=DARK if is_complete(trial) else LIGHT, linewidth=1)
    axes.set(xlabel="evaluation", ylabel="value so far")
    return picture(figure)


def new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(width, height), layout="constrained")
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def picture(figure: Figure) -> bytes:
    """A figure as a PNG; it is closed."""
    import matplotlib.pyplot as plt

    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    plt.close(figure)
    return content.getvalue()
