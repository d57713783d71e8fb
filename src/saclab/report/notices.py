"""What every figure and table of some runs must say: scaled down, unfinished, of another task than the paper's, …"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from saclab.report.arms import own_training
from saclab.report.paper import TABLE_2
from saclab.report.runs import Comparison
from saclab.report.text import count_text, shown
from saclab.settings import TrainingSettings
from saclab.training.run_folder import RunRecord


def scale_notice(run: RunRecord) -> str | None:
    """How far a run falls short of its protocol with its variant's own training; None if it does not.

    Quick always falls short.
    """
    config = run.config
    if config.protocol == "quick":
        return "quick protocol, far shorter than the paper's: too short to judge a variant by"
    full = own_training(config)
    if full is None:
        return None
    cuts = []
    if most_updates(config.training) < most_updates(full):
        cuts.append(f"{most_updates(config.training):,.0f} of {most_updates(full):,.0f} updates")
    if (config.training.max_episodes or np.inf) < (full.max_episodes or np.inf):
        cuts.append(f"at most {config.training.max_episodes:,} episodes")
    return f"scaled down: {', '.join(cuts)} of the {config.protocol} protocol" if cuts else None


def most_updates(settings: TrainingSettings) -> float:
    """Updates that the limits on updates and steps allow; infinite if neither is set."""
    by_steps = np.inf if settings.max_steps is None else settings.updates_due(settings.max_steps)
    return min(by_steps, np.inf if settings.max_updates is None else settings.max_updates)


def notices(runs: Sequence[RunRecord]) -> tuple[str, ...]:
    """What every figure of these runs must say: scaled down, unfinished, without an evaluation yet."""
    scaled = Counter(notice for run in runs if (notice := scale_notice(run)))
    unfinished = sum(run.result is None for run in runs)
    unevaluated = sum(evaluations(run) == 0 for run in runs)
    sentences = [notice[0].upper() + notice[1:] for notice in scaled]
    if unfinished:
        sentences.append(f"{unfinished} of {len(runs)} runs unfinished")
    if unevaluated:
        sentences.append(f"{unevaluated} of {len(runs)} runs without an evaluation so far")
    if any(of_another_task(run) for run in runs):
        sentences.append("Arguments or wrappers change the environment: the paper's numbers are of another task")
    return tuple(sentences)


def of_another_task(run: RunRecord) -> bool:
    """Whether the paper has numbers of this environment, but the run has changed it."""
    config = run.config
    return config.environment in TABLE_2 and bool(config.environment_arguments or config.training.wrappers)


def all_notices(comparison: Comparison) -> tuple[str, ...]:
    """The notices of every environment, each with its name if there are several, and of what is left out."""
    several, left_out = len(comparison.environments) > 1, len(comparison.left_out)
    told = [
        f"{shown(environment)}: {notice}" if several else notice
        for environment in comparison.environments
        for notice in notices(comparison.runs_of(environment))
    ]
    if left_out:
        told.append(f"{count_text(left_out, 'folder')} left out; the report's page lists why")
    return tuple(told)


def evaluations(run: RunRecord) -> int:
    """How many evaluations the run has made."""
    return len(run.evaluations.get("mean_return", ()))
