"""Words and numbers of a report, as short printable text."""

from __future__ import annotations

import numpy as np

from saclab.report.statistics import Interval


def shown(text: object, limit: int = 80) -> str:
    """Text from a run folder as one short printable line: no control characters, nothing that cannot be encoded."""
    printable = "".join(character if character.isprintable() else " " for character in str(text))
    return printable if len(printable) <= limit else printable[: limit - 1] + "…"


def count_text(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def interval_text(interval: Interval) -> str:
    """An estimate, its interval and its number of runs in words."""
    if interval.runs == 0:
        return "no evaluation yet"
    seeds = count_text(interval.runs, "seed")
    if not interval.exists:
        return f"{number_text(interval.estimate)} (no interval: {seeds})"
    return f"{number_text(interval.estimate)} [{number_text(interval.low)}, {number_text(interval.high)}], {seeds}"


def number_text(value: float) -> str:
    """Three or more significant digits; an infinity is a threshold that was not reached."""
    if np.isinf(value):
        return "not reached"
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2
    return f"{value:,.{digits}f}".replace("-", "−")
