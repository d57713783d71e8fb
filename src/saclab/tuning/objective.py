"""What a trial is worth, from its runs' evaluations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from saclab.errors import require

Evaluations = Mapping[str, np.ndarray]
"""The columns of evaluations.csv."""
ObjectiveName = Literal["mean", "final", "steps", "seconds"]
PENALTY = 2.0
"""A run that does not reach the score counts as so many times its own length: PAR2, the custom of algorithm
configuration."""


class Kind(NamedTuple):
    title: str
    value: Callable[[Evaluations, float | None], float]
    to_score: bool = False
    """Whether it is the way to a score, to be short; otherwise it is a return, to be high."""


def until_score(column: str) -> Callable[[Evaluations, float | None], float]:
    def value(evaluations: Evaluations, score: float | None) -> float:
        assert score is not None
        reached = np.flatnonzero(evaluations["mean_return"] >= score)
        return float(evaluations[column][reached[0]] if reached.size else PENALTY * evaluations[column][-1])

    return value


KINDS: dict[ObjectiveName, Kind] = {
    "mean": Kind("mean evaluation return over training", lambda found, _: float(np.mean(found["mean_return"]))),
    "final": Kind("return of the last evaluation", lambda found, _: float(found["mean_return"][-1])),
    "steps": Kind("environment steps until an evaluation reaches", until_score("steps"), to_score=True),
    "seconds": Kind("seconds until an evaluation reaches", until_score("seconds"), to_score=True),
}


class Objective(NamedTuple):
    """What a tune looks for: a kind, and the score of those that need one."""

    name: ObjectiveName
    score: float | None = None

    @property
    def kind(self) -> Kind:
        return KINDS[self.name]

    @property
    def direction(self) -> Literal["minimize", "maximize"]:
        return "minimize" if self.kind.to_score else "maximize"

    @property
    def title(self) -> str:
        return self.kind.title if self.score is None else f"{self.kind.title} {self.score:g}"

    def value(self, runs: Sequence[Evaluations]) -> float:
        """A trial's value: the mean over its runs, each of which has been evaluated."""
        return float(np.mean([self.kind.value(evaluations, self.score) for evaluations in runs]))

    def reached(self, evaluations: Evaluations) -> bool:
        """Whether nothing that a run may still do changes its value."""
        return self.kind.to_score and bool((evaluations["mean_return"] >= self.score).any())

    def at_least(self, runs: Sequence[Evaluations | None], ended: Sequence[bool]) -> float:
        """Of a way to a score: what the trial's value will be at least, with what its runs have spent so far."""
        spent = []
        for evaluations, at_end in zip(runs, ended, strict=True):
            if evaluations is None or not len(evaluations["mean_return"]):
                spent.append(0.0)
            elif at_end or self.reached(evaluations):
                spent.append(self.kind.value(evaluations, self.score))
            else:
                spent.append(float(evaluations[self.name][-1]))
        return float(np.mean(spent))


def objective_of(name: str, score: float | None) -> Objective:
    """The objective of a name; raises SettingError if it is not known, or a score is missing or of no use."""
    require(name in KINDS, "objective", name, f"use one of {', '.join(KINDS)}")
    kind = KINDS[name]  # type: ignore[index]
    require(not kind.to_score or score is not None, "score", score, f"objective {name} needs one, such as --score 3000")
    require(kind.to_score or score is None, "score", score, f"objective {name} has none: use steps or seconds")
    require(score is None or np.isfinite(score), "score", score, "use a finite number")
    return Objective(name, score)  # type: ignore[arg-type]
