"""What the page's script draws, as JSON: short numbers, and every distinct x axis only once."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from saclab.report.arms import Arm, by_paper_name
from saclab.report.curves import AXES, PAPER_PANELS, Curves, Quantity, diagnostics
from saclab.report.paper import STEPS_PER_EPISODE, UPDATES_PER_EPISODE, paper_curves
from saclab.report.runs import Comparison
from saclab.report.scores import AggregateScores, EnvironmentScores
from saclab.report.statistics import Band, Interval
from saclab.report.text import shown

SCORE_PANELS = {
    "final": "final evaluation return",
    "best": "best evaluation return (flatters)",
    "area": "mean evaluation return over training",
}


class AxisPool:
    """Distinct x axes; curves hold their numbers. Most runs of an environment share theirs."""

    def __init__(self) -> None:
        self.axes: list[list[float | None]] = []
        self.places: dict[bytes, int] = {}

    def place(self, values: np.ndarray) -> int:
        rounded = np.array([float(f"{value:.6g}") for value in values])
        key = rounded.tobytes()
        if key not in self.places:
            self.places[key] = len(self.axes)
            self.axes.append(numbers(rounded, 6))
        return self.places[key]

    def places_of(self, x: dict[str, np.ndarray]) -> dict[str, int]:
        return {axis: self.place(values) for axis, values in x.items()}


def numbers(values: np.ndarray, digits: int = 5) -> list[float | None]:
    """JSON numbers of few digits; null where there is none (JSON has no NaN)."""
    short = (float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values)
    return [int(value) if value is not None and value.is_integer() else value for value in short]


def page_data(
    comparison: Comparison, scores: Sequence[EnvironmentScores], together: AggregateScores | None, curves: Curves
) -> str:
    """The JSON text, safe inside a script element."""
    places = {arm: index for index, arm in enumerate(comparison.arms)}
    pool = AxisPool()
    content = {
        "axes": AXES,
        "axis": "episodes" if all(run.config.protocol == "paper" for run in comparison.runs) else "steps",
        "arms": [{"title": arm.title} for arm in comparison.arms],
        "environments": [environment_data(entry, curves, places, pool) for entry in scores],
        "together": together_data(together, places),
        "pool": pool.axes,
    }
    return script_safe(json.dumps(content, separators=(",", ":"), allow_nan=False))


def script_safe(text: str) -> str:
    """JSON that no HTML parser can take for the end of a script or the start of a comment."""
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def environment_data(
    entry: EnvironmentScores, curves: Curves, places: dict[Arm, int], pool: AxisPool
) -> dict[str, Any]:
    name = entry.environment
    panels = [panel_data(quantity, "curves", name, curves, places, pool) for quantity in PAPER_PANELS]
    panels += [
        panel_data(quantity, "diagnostics", name, curves, places, pool) for quantity in diagnostics(curves, name)
    ]
    return {
        "name": shown(name),
        "panels": panels,
        "intervals": [
            {
                "title": title,
                "rows": [
                    {**interval_data(getattr(arm, field)), "arm": places[arm.arm], "runs": numbers(arm.values(field)),
                     "paper": arm.paper_best if field == "best" else None}
                    for arm in entry.arms if arm.runs
                ],
            }
            for field, title in SCORE_PANELS.items()
        ],
        "profile": profile_data(
            SCORE_PANELS["final"], entry.thresholds, {arm.arm: arm.profile for arm in entry.arms if arm.profile}, places
        ),
    }  # fmt: skip


def panel_data(
    quantity: Quantity, group: str, environment: str, curves: Curves, places: dict[Arm, int], pool: AxisPool
) -> dict[str, Any]:
    """One quantity in one environment: each arm with its band and its runs."""
    arms = []
    for arm, place in places.items():
        if of_arm := curves.get((environment, arm, quantity)):
            band = of_arm.band
            runs = [{"seed": seed, "x": pool.places_of(curve.x), "y": numbers(curve.y)}
                    for seed, curve in of_arm.runs.items()]  # fmt: skip
            arms.append({"arm": place, "x": pool.places_of(band.x), "runs": runs, **band_data(band)})
    return {
        "group": group,
        "title": quantity.title,
        "meaning": quantity.meaning,
        "arms": arms,
        "paper": paper_data(environment, places, pool) if quantity.key == "evaluation_return" else [],
    }


def paper_data(environment: str, places: dict[Arm, int], pool: AxisPool) -> list[dict[str, Any]]:
    """The paper's curves. Only HalfCheetah's episodes all have one length, so only there steps are known as well."""
    by_name = by_paper_name(places)
    lines = []
    for name, curve in paper_curves(environment).items():
        x = {"episodes": curve.episode}
        if environment.startswith("HalfCheetah-"):
            x |= {"steps": curve.episode * STEPS_PER_EPISODE, "updates": curve.episode * UPDATES_PER_EPISODE}
        lines.append({
            "title": f"paper: {name}", "arm": by_name.get(name), "x": pool.places_of(x),
            "y": numbers(curve.evaluation_return),
        })  # fmt: skip
    return lines


def band_data(band: Any) -> dict[str, Any]:
    """Middle, and low and high if an interval exists, of a Band or SeedBand."""
    exists = bool(np.isfinite(band.low).any())
    low, high = (numbers(band.low), numbers(band.high)) if exists else (None, None)
    return {"middle": numbers(band.middle), "low": low, "high": high}


def interval_data(interval: Interval) -> dict[str, Any]:
    estimate, low, high = numbers(np.array(interval[:3]))
    return {"estimate": estimate, "low": low, "high": high, "count": interval.runs}


def profile_data(
    title: str, thresholds: np.ndarray, profiles: dict[Arm, Band], places: dict[Arm, int]
) -> dict[str, Any]:
    lines = [{"arm": places[arm], "count": band.runs, **band_data(band)} for arm, band in profiles.items()]
    return {"title": title, "x": numbers(thresholds), "arms": lines}


def together_data(together: AggregateScores | None, places: dict[Arm, int]) -> dict[str, Any] | None:
    """All environments together; null if there is only one."""
    if together is None:
        return None
    rows = [{**interval_data(entry.interquartile_mean), "arm": places[entry.arm], "runs": [], "paper": None}
            for entry in together.arms]  # fmt: skip
    profiles = {entry.arm: entry.profile for entry in together.arms}
    title = "normalised final evaluation return"
    return {
        "intervals": [{"title": title, "rows": rows}],
        "profile": profile_data(title, together.thresholds, profiles, places),
    }
