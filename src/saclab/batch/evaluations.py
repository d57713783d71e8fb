"""Evaluations shared out among the processes that step environments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saclab.batch.frames import Message
from saclab.batch.pool import error_of
from saclab.errors import RunBroken
from saclab.training.evaluation import EvaluationEpisodes

EPISODES_PER_JOB = 5  # stepped side by side; a fixed number, as results depend on it in the last bits


def evaluation_jobs(run: int, episode_seeds: Sequence[int], actor: np.ndarray) -> list[Message]:
    """Messages that ask for one episode of a run's policy f32[P] per seed."""
    return [
        ({"do": "evaluate", "run": run, "seeds": list(episode_seeds[first : first + EPISODES_PER_JOB])},
         {"actor": actor})
        for first in range(0, len(episode_seeds), EPISODES_PER_JOB)
    ]  # fmt: skip


def joined(replies: Sequence[Message]) -> EvaluationEpisodes | RunBroken:
    """The episodes of one run's evaluation, which came in parts, or what broke in the first of them that did."""
    for header, _ in replies:
        if "failure" in header:
            return error_of(header["failure"], {})
    parts = [arrays for _, arrays in replies]
    return EvaluationEpisodes(*(np.concatenate([part[name] for part in parts]) for name in EvaluationEpisodes._fields))
