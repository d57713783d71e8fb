"""What the paper "Soft Actor Critic and its variants" reports: its Table 2 and its curves of evaluation returns.

Each number is one training run (seed 44). The curves were read off the pictures of Figures 1(d) and 2(d) as medians
over windows of 100 or 200 episodes, and are good to about ±300 at best, worse where curves overlap. The numbers named
Averaged-SAC came from code that averaged no value: they are no evidence for Eq. 9 (see the variant averaged-entropy).
"""

from __future__ import annotations

import csv
from importlib import resources
from typing import NamedTuple

import numpy as np

SOURCE = "Soft Actor Critic and its variants, Table 2 and Figures 1(d) and 2(d); one seed"
CURVE_ACCURACY = "read off the pictures: medians over 100 or 200 episodes, ±300 at best"
AVERAGED_CAVEAT = (
    "The paper's Averaged-SAC numbers came from code that averaged the entropy term over unrelated minibatches, "
    "not the target values of Eq. 9."
)
UPDATES_PER_EPISODE = 200
STEPS_PER_EPISODE = 1000
"""Length of an episode that is not cut short, as all of HalfCheetah's."""

TABLE_2: dict[str, dict[str, float]] = {
    "HalfCheetah-v4": {"sac": 10182.9, "sac-alpha-tuning": 11348.2, "averaged-sac": 11141.6},
    "Humanoid-v4": {"sac": 5885.8, "sac-alpha-tuning": 6522.6, "averaged-sac": 7972.3},
}
"""Best evaluation return ("test reward"): environment -> `Variant.paper_name` -> mean return of 20 episodes."""


class PaperCurve(NamedTuple):
    """One curve of Figure 1(d) or 2(d)."""

    episode: np.ndarray
    """f64[n]: training episodes, increasing."""
    evaluation_return: np.ndarray
    """f64[n]: accurate to ±300 at best."""


def paper_curves(environment: str) -> dict[str, PaperCurve]:
    """`Variant.paper_name` -> the paper's curve; empty for an environment that is not in the paper."""
    text = (resources.files("saclab.report") / "data" / "paper_curves.csv").read_text(encoding="utf-8")
    points: dict[str, list[tuple[float, float]]] = {}
    for row in csv.DictReader(text.splitlines()):
        if row["env"] == environment:
            points.setdefault(row["variant"], []).append((float(row["episode"]), float(row["test_reward"])))
    return {name: PaperCurve(*np.array(sorted(values)).T) for name, values in points.items()}
