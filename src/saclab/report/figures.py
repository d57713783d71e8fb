"""The figures of a report, as PNG and SVG: the paper's four panels, intervals, pairs, profiles, diagnostics.

Colours are Okabe and Ito's, safe for the colour-blind; every arm also has a marker of its own, so that the figures can
be read in grey. Broken lines are the paper's own curves and nothing else.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from saclab.report.arms import Arm, by_paper_name
from saclab.report.curves import AXES, PAPER_PANELS, ArmCurves, Curves, Quantity, diagnostics
from saclab.report.notices import all_notices, notices
from saclab.report.pairs import Pair
from saclab.report.paper import paper_curves
from saclab.report.runs import Comparison
from saclab.report.scores import AggregateScores, EnvironmentScores
from saclab.report.statistics import Band, Interval
from saclab.report.text import number_text, shown
from saclab.training.run_folder import safe_name

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DOTS_PER_INCH = 150
FEW_ARMS = 4  # so many can be told apart seed by seed
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "svg.hashsalt": "saclab",
    "text.parse_math": False,  # names from run folders are text: a dollar sign must not start a formula
}


def write_figures(
    comparison: Comparison,
    scores: Sequence[EnvironmentScores],
    aggregate: AggregateScores | None,
    curves: Curves,
    out: Path,
) -> list[Path]:
    """Write every figure as PNG and SVG into the folder `out`; returns the PNG files."""
    out.mkdir(parents=True, exist_ok=True)
    styles = {arm: index for index, arm in enumerate(comparison.arms)}
    written: list[Path] = []
    with matplotlib.rc_context(STYLE):
        for number, entry in enumerate(scores):
            name = file_name(entry.environment, number)
            runs = comparison.runs_of(entry.environment)
            figures = {
                "panels": draw_curves(curves, entry.environment, PAPER_PANELS, styles),
                "diagnostics": draw_curves(
                    curves, entry.environment, diagnostics(curves, entry.environment), styles
                ),
                "intervals": draw_scores(entry, styles),
                "improvement": draw_pairs(entry.pairs, shown(entry.environment)),
                "profiles": draw_profiles(
                    {arm.arm: arm.profile for arm in entry.arms if arm.profile},
                    entry.thresholds, "final evaluation return", shown(entry.environment), styles,
                ),
            }  # fmt: skip
            for kind, figure in figures.items():
                written += save(figure, out / f"{kind}-{name}", notices(runs))
        for kind, figure in draw_aggregate(aggregate, styles).items():
            written += save(figure, out / f"{kind}-all", all_notices(comparison))
    return written


def file_name(environment: str, number: int) -> str:
    """A safe file name for an environment; the number keeps apart names that are equal once made safe."""
    safe = safe_name(environment)[:60]
    return safe if safe == environment else f"{safe}-{number + 1}"


def save(figure: Figure | None, path: Path, said: Sequence[str]) -> list[Path]:
    """Write PNG and SVG with what every figure must say at its foot; nothing if there is no figure."""
    if figure is None:
        return []
    if said:
        figure.supxlabel(wrapped(" · ".join(said), 110), fontsize=8, color="#8a3b00", fontweight="bold")
    FigureCanvasAgg(figure)
    for suffix, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
        figure.savefig(path.with_name(f"{path.name}.{suffix}"), dpi=DOTS_PER_INCH, metadata=metadata)
        figure.set_layout_engine("none")  # the second file keeps the layout of the first, which is slow to find
    return [path.with_name(f"{path.name}.png")]


def new_figure(width: float, height: float, title: str = "") -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def marker_style(index: int, points: int = 1) -> dict[str, Any]:
    """Colour and marker of an arm; about eight markers per line, shifted so that arms do not cover each other."""
    every = max(1, points // 8)
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "markevery": (min(index * max(1, every // 4), max(0, points - 1)), every),
        "markeredgecolor": "white",
        "markeredgewidth": 0.6,
    }


def draw_curves(
    curves: Curves, environment: str, quantities: Sequence[Quantity], styles: dict[Arm, int]
) -> Figure | None:
    """One panel per quantity: each seed as a thin line, the interquartile mean with its 95 % band."""
    if not quantities:
        return None
    rows = -(-len(quantities) // 2)
    figure = new_figure(10, 1.2 + 2.9 * rows)
    panels = list(figure.subplots(rows, 2, squeeze=False).flat)
    handles: dict[str, Any] = {}
    for panel, quantity in zip(panels, quantities):
        for arm, index in styles.items():
            if of_arm := curves.get((environment, arm, quantity)):
                handles |= draw_arm(panel, of_arm, arm, quantity.axis, index, len(styles) > FEW_ARMS)
        if quantity.key == "evaluation_return":
            handles |= draw_paper(panel, environment, by_paper_name(styles))
        panel.set_title(quantity.title, loc="left", fontsize=10)
        panel.set_xlabel(AXES[quantity.axis])
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        if not panel.lines:
            panel.text(0.5, 0.5, "nothing logged so far", ha="center", va="center", transform=panel.transAxes)
    for panel in panels[len(quantities) :]:
        panel.axis("off")
    figure.legend(
        handles.values(), handles, loc="outside upper center", ncols=3, frameon=False, fontsize=8,
        title=shown(environment), title_fontproperties={"weight": "bold", "size": 11},
    )  # fmt: skip
    return figure


def draw_arm(panel: Any, curves: ArmCurves, arm: Arm, axis: str, index: int, crowded: bool) -> dict[str, Any]:
    """Draw one arm, its seeds and band fainter among many; returns its legend entry, with its number of seeds."""
    colour, band, ink = COLOURS[index % len(COLOURS)], curves.band, 0.4 if crowded else 1.0
    if len(curves.runs) > 1:
        for curve in curves.runs.values():
            panel.plot(curve.x[axis], curve.y, color=colour, linewidth=0.5, alpha=0.45 * ink)
        panel.fill_between(band.x[axis], band.low, band.high, color=colour, alpha=0.18 * ink, linewidth=0)
    (line,) = panel.plot(band.x[axis], band.middle, **marker_style(index, len(band.middle)))
    return {wrapped(f"{arm.title}, {seeds_text(band.runs)}", 40): line}


def draw_paper(panel: Any, environment: str, styles: dict[str, int]) -> dict[str, Any]:
    """The paper's own curves of evaluation returns: dashed, in the colour of the variant of that name, or grey."""
    handles, greys = {}, itertools.cycle(("--", ":", "-."))
    limit = panel.get_xlim()[1] if panel.lines else np.inf
    for name, curve in paper_curves(environment).items():
        colour, dashes = (COLOURS[styles[name] % len(COLOURS)], "--") if name in styles else ("#777777", next(greys))
        x, y = curve.episode[curve.episode <= limit], curve.evaluation_return[curve.episode <= limit]
        (line,) = panel.plot(x, y, color=colour, linewidth=1.1, linestyle=dashes)
        handles[f"paper: {name}, 1 seed, ±300"] = line
    return handles


def wrapped(text: str, width: int = 32, on_hyphens: bool = False) -> str:
    return "\n".join(textwrap.wrap(text, width, break_on_hyphens=on_hyphens))


def seeds_text(count: int) -> str:
    return "1 seed, no interval" if count == 1 else f"{count} seeds"


def draw_interval(panel: Any, row: int, interval: Interval, index: int) -> None:
    """A point with its interval on one row, its numbers above it."""
    if interval.runs == 0 or not np.isfinite(interval.estimate):
        return
    style = {key: value for key, value in marker_style(index).items() if key != "markevery"}
    if interval.exists and np.isfinite([interval.low, interval.high]).all():
        panel.plot([interval.low, interval.high], [row, row], color=style["color"], linewidth=5, alpha=0.35)
    panel.plot([interval.estimate], [row], linestyle="none", **style | {"markersize": 8})
    panel.annotate(number_text(interval.estimate), (interval.estimate, row), xytext=(0, 8),
                   textcoords="offset points", ha="center", fontsize=8)  # fmt: skip


def draw_scores(entry: EnvironmentScores, styles: dict[Arm, int]) -> Figure | None:
    """Final, best and mean evaluation return of every arm: interquartile mean with its 95 % interval, and every run."""
    arms = [arm for arm in entry.arms if arm.runs]
    if not arms:
        return None
    figure = new_figure(11, 1.6 + 0.55 * len(arms), shown(entry.environment))
    panels = figure.subplots(1, 3, sharey=True)
    titles = {
        "final": "final evaluation return",
        "best": "best evaluation return (flatters)",
        "area": "mean over training",
    }
    for panel, (field, title) in zip(panels, titles.items()):
        for row, arm in enumerate(arms):
            draw_interval(panel, row, getattr(arm, field), styles[arm.arm])
            values = arm.values(field)
            panel.plot(values, np.full(len(values), row), "|", color="#555555", markersize=9, alpha=0.7)
            if field == "best" and arm.paper_best is not None:
                panel.plot([arm.paper_best], [row], linestyle="none", marker="D", color="none", markeredgecolor="black")
        panel.set_title(title, loc="left", fontsize=10)
        panel.margins(x=0.12)
    set_arm_rows(panels[0], [f"{wrapped(arm.arm.title)}\n{seeds_text(len(arm.runs))}" for arm in arms])
    paper = " · ◇: the paper's Table 2, 1 seed" if any(arm.paper_best is not None for arm in arms) else ""
    panels[1].set_xlabel(f"point: interquartile mean · bar: 95 % interval · tick: single run{paper}", fontsize=8)
    return figure


def set_arm_rows(panel: Any, names: Sequence[str]) -> None:
    panel.set_yticks(range(len(names)), list(names))
    panel.set_ylim(len(names) - 0.5, -0.6)


def draw_pairs(pairs: Sequence[Pair], title: str) -> Figure | None:
    """The matrix of P(row beats column) by final return, with intervals; bold where the interval excludes ½.

    Pairs without an interval are left out: their number says nothing.
    """
    pairs = [pair for pair in pairs if pair.improvement.exists]
    if not pairs:
        return None
    arms = list(dict.fromkeys(arm for pair in pairs for arm in (pair.x, pair.y)))
    place = {arm: index for index, arm in enumerate(arms)}
    matrix = np.full((len(arms), len(arms)), np.nan)
    size = 2.2 + 1.05 * len(arms)
    figure = new_figure(size + 1.6, size, f"{title}: probability that the row's run ends higher than the column's")
    panel = figure.subplots()
    for pair in pairs:
        p, low, high = pair.improvement[:3]
        row, column = place[pair.x], place[pair.y]
        for i, j, estimate, bounds in ((row, column, p, (low, high)), (column, row, 1 - p, (1 - high, 1 - low))):
            matrix[i, j] = estimate
            text = f"{estimate:.2f}\n[{bounds[0]:.2f}, {bounds[1]:.2f}]"
            panel.text(
                j,
                i,
                text,
                ha="center",
                va="center",
                fontsize=9,
                fontweight="bold" if pair.improvement.decided else "normal",
            )
    panel.imshow(matrix, cmap=matplotlib.colormaps["PuOr"], vmin=-0.3, vmax=1.3)
    names = [wrapped(arm.title, 19, on_hyphens=True) for arm in arms]
    panel.set_xticks(range(len(arms)), names)
    panel.set_yticks(range(len(arms)), names)
    panel.grid(False)
    figure.suptitle(wrapped(figure.get_suptitle(), int(10 * size)), fontsize=10, fontweight="bold")
    return figure


def draw_profiles(
    profiles: dict[Arm, Band], thresholds: np.ndarray, axis: str, title: str, styles: dict[Arm, int]
) -> Figure | None:
    """Share of runs above each score; a curve further up and right is better."""
    if not profiles:
        return None
    figure = new_figure(9, 4, title)
    panel = figure.subplots()
    for arm, profile in profiles.items():
        colour = COLOURS[styles[arm] % len(COLOURS)]
        panel.fill_between(thresholds, profile.low, profile.high, color=colour, alpha=0.15, linewidth=0, step="mid")
        panel.plot(thresholds, profile.middle, drawstyle="steps-mid", **marker_style(styles[arm], len(thresholds)),
                   label=wrapped(f"{arm.title}, {seeds_text(profile.runs)}"))  # fmt: skip
    panel.set_xlabel(axis)
    panel.set_ylabel("share of runs that score above")
    panel.set_ylim(-0.03, 1.03)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return figure


def draw_aggregate(aggregate: AggregateScores | None, styles: dict[Arm, int]) -> dict[str, Figure | None]:
    """The same for all environments together."""
    if aggregate is None:
        return {}
    title = "All environments, normalised within this report"
    figure = new_figure(7, 1.6 + 0.55 * len(aggregate.arms), title)
    panel = figure.subplots()
    for row, entry in enumerate(aggregate.arms):
        draw_interval(panel, row, entry.interquartile_mean, styles[entry.arm])
    set_arm_rows(
        panel, [f"{wrapped(entry.arm.title)}\n{entry.interquartile_mean.runs} runs" for entry in aggregate.arms]
    )
    panel.set_xlabel("interquartile mean of normalised final evaluation returns")
    profiles = {entry.arm: entry.profile for entry in aggregate.arms}
    return {
        "intervals": figure,
        "improvement": draw_pairs(aggregate.pairs, "All environments"),
        "profiles": draw_profiles(profiles, aggregate.thresholds, "normalised final evaluation return", title, styles),
    }
