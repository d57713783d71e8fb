"""Reward schedules: what a reward term is weighed by at points of training, linear between them, constant outside.

    reward_linvel: 0.2@0.1 1@0.5                    by the share of the planned updates that are made
    reward_linvel: 0.2@return=500 1@return=3000     by the highest mean evaluation return so far

A weight of 1 leaves a term as the environment tells it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

from saclab.errors import require
from saclab.limits import LARGEST_FLOAT, SMALLEST_FLOAT

SETTING = "reward_schedule"
EXAMPLE = "'reward_linvel: 0.2@0.1 1@0.5'"
BY_RETURN = "return="


class Point(NamedTuple):
    place: float
    weight: float


class ScheduledTerm(NamedTuple):
    """The weights of one reward term over training."""

    name: str
    by_return: bool
    """Whether places are evaluation returns; otherwise they are shares of the planned updates, from 0 to 1."""
    points: tuple[Point, ...]
    """At least one, each further on than the one before."""

    def weight(self, share: float, best_return: float | None) -> float:
        """The weight at a moment of training.

        Args:
            share: of the planned updates that are made.
            best_return: the highest mean evaluation return so far; None before the first evaluation.
        """
        lowest = -math.inf if best_return is None else best_return
        place = lowest if self.by_return else share
        first, last = self.points[0], self.points[-1]
        if place <= first.place:
            return first.weight
        for before, after in pairwise(self.points):
            if place < after.place:
                part = (place - before.place) / (after.place - before.place)
                return before.weight + (after.weight - before.weight) * part
        return last.weight

    @property
    def text(self) -> str:
        """What `parse_term` reads, with numbers in one spelling."""
        kind = BY_RETURN if self.by_return else ""
        return f"{self.name}: " + " ".join(f"{brief(weight)}@{kind}{brief(place)}" for place, weight in self.points)


def brief(number: float) -> str:
    """A number's shortest text from which it is read back."""
    return str(int(number)) if number.is_integer() and abs(number) < 1e15 else repr(number)


def parse_schedule(texts: object) -> tuple[ScheduledTerm, ...]:
    """The terms of a schedule, one text each; raises SettingError for what is none."""
    readable = isinstance(texts, tuple | list) and all(isinstance(text, str) for text in texts)
    require(readable, SETTING, texts, f"give a list of texts, one for each term, such as {EXAMPLE}")
    assert isinstance(texts, Iterable)
    terms = tuple(parse_term(text) for text in texts)
    names = [term.name for term in terms]
    for name in names:
        require(names.count(name) == 1, SETTING, name, "give all points of a term at once, in one text")
    return terms


def parse_term(text: str) -> ScheduledTerm:
    """One term's weights; raises SettingError with what is wrong with the text."""
    name, _, points = text.rpartition(":")
    require(bool(name.strip() and points.split()), SETTING, text, f"write a term, a colon and its points: {EXAMPLE}")
    found = [parse_point(text, point) for point in points.split()]
    kinds = {by_return for by_return, _ in found}
    require(
        len(kinds) == 1,
        SETTING, text, "give all points of a term as shares of the updates (1@0.5), or all as returns (1@return=500)",
    )  # fmt: skip
    for (_, before), (_, after) in pairwise(found):
        require(
            before.place < after.place,
            SETTING, text, f"give its points in order, each further on than the one before: {brief(after.place)} is "
            f"not after {brief(before.place)}",
        )  # fmt: skip
    return ScheduledTerm(name.strip(), kinds.pop(), tuple(point for _, point in found))


def parse_point(text: str, point: str) -> tuple[bool, Point]:
    """Whether a point such as 0.2@0.5 or 0.2@return=500 goes by the return, and the point."""
    weight_text, _, place_text = point.partition("@")
    by_return = place_text.startswith(BY_RETURN)
    weight, place = as_number(weight_text), as_number(place_text.removeprefix(BY_RETURN))
    require(
        weight is not None and place is not None,
        SETTING, text, f"{point!r} is no weight and point: write finite numbers as in 0.2@0.5, for half of the "
        "updates, or 0.2@return=500",
    )  # fmt: skip
    assert weight is not None
    assert place is not None
    require(
        by_return or 0 <= place <= 1,
        SETTING, text, f"{point!r} is at {brief(place)} of the updates: use a share from 0 to 1, or write "
        f"@return={brief(place)} for an evaluation return",
    )  # fmt: skip
    return by_return, Point(place, weight)


def as_number(text: str) -> float | None:
    """A number that 32 bits can hold; None for other text."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if number == 0 or SMALLEST_FLOAT <= abs(number) <= LARGEST_FLOAT else None
