"""`saclab.tune`: a search for better settings of a variant."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from saclab.errors import require
from saclab.extras import required
from saclab.files import absolute
from saclab.grid.resources import Resources, chosen_resources
from saclab.limits import require_minutes
from saclab.signals import requests_from_signals
from saclab.training.run_folder import safe_name
from saclab.tuning.objective import ObjectiveName
from saclab.tuning.page import judging_commands, own_trial, write_page
from saclab.tuning.plan import TunePlan, is_recorded, make_plan
from saclab.tuning.space import read_space, values_of
from saclab.tuning.study import best_trial
from saclab.tuning.tuner import Tune, search

Show = Callable[[Iterable[Tune]], Tune]
"""What consumes the states of a tune and returns the last one."""


class Tuned(NamedTuple):
    best: dict[str, Any] | None
    """The settings of the best trial; None if none has come to its end, or to the score where there is one."""
    value: float | None
    """What the best trial is worth, by the objective; the best of many noisy ones, so it flatters."""
    own_value: float | None
    """What the variant's own settings are worth; None if they do not lie in the space, or were not tried yet."""
    trials: int
    """How many have ended."""
    commands: list[list[str]]
    """The words of commands that judge the best settings against the variant's own, with seeds that no trial had; none
    if the variant's own are the best."""
    page: Path | None
    hindered: dict[int, str] = {}  # noqa: RUF012 - a NamedTuple's default, which nobody changes
    """Trials that something from outside has stopped, and what; the same call goes on with them."""
    interrupted: int = 0
    """The signal that stopped the tune, or 0."""


def tune(
    environment: str,
    variant: str = "sac-auto",
    protocol: str = "standard",
    trials: int = 50,
    *,
    seeds: int | Sequence[int] = 1,
    objective: ObjectiveName = "mean",
    score: float | None = None,
    space: Mapping[str, Any] | Path | str | None = None,
    pruning: bool = True,
    search_seed: int = 0,
    out: Path | str | None = None,
    environment_arguments: Mapping[str, Any] | None = None,
    resources: Resources | None = None,
    checkpoint_minutes: float = 10,
    show: Show | None = None,
    **overrides: Any,
) -> Tuned:
    """Search for better settings of a variant with Optuna (TPE), then write the page; needs the extra `tune`.

    The same call goes on after a stop or a kill, with the runs of the trials that were under way.

    Args:
        environment: Gymnasium id.
        variant: a key of `saclab.variants.VARIANTS`.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        trials: how many, those of earlier calls counted in; the first has the variant's own settings, if they lie in
            the space.
        seeds: how many runs a trial has, or their seeds; its worth is their mean.
        objective: evaluation return to be high, its "mean" over training or the "final" one; or "steps" or "seconds"
            to be low, until an evaluation reaches `score`.
        score: of the last two objectives.
        space: changes of the default space, or a TOML file with them, as `saclab.tuning.space.changed_space` has them.
        pruning: give up trials that are below the median of those before them, or slower to the score than the best.
        search_seed: what the trials' settings are drawn from.
        out: the tune's folder; None for tune/<environment>/<variant>.
        environment_arguments: keyword arguments of every environment.
        resources: what trains the runs, of `saclab.grid.resources.chosen_resources`; None for a run on each core.
        checkpoint_minutes: wall-clock time between checkpoints.
        show: consumes the states of the tune and returns the last one, such as `saclab.cli.display.show_tune`.
        **overrides: any setting of AlgorithmSettings or TrainingSettings, for every trial.

    Raises:
        UserError: for a name or value that cannot work, or a missing extra; nothing has been started then.
        TrainingFailed: if the first trials all fail.
    """
    changes = read_space(Path(space)) if isinstance(space, Path | str) else space or {}
    plan = make_plan(
        environment, variant, protocol, seeds, objective, score, changes, overrides, environment_arguments or {},
        search_seed, pruning,
    )  # fmt: skip
    folder = absolute(out or Path("tune") / safe_name(environment) / variant)
    return tuned(plan, trials, folder, resources or chosen_resources(), checkpoint_minutes, show or last_state)


def tuned(
    plan: TunePlan, trials: int, folder: Path, resources: Resources, checkpoint_minutes: float, show: Show
) -> Tuned:
    """What comes of a plan, in a folder; the arguments, and what is raised, are those of `tune`."""
    required("optuna", "tune", "saclab tune")
    require(trials >= 1, "trials", trials, "use at least 1")
    require_minutes(checkpoint_minutes)
    is_recorded(folder, plan)
    resources.require_startable(plan.extremes(folder))
    with requests_from_signals() as requests:
        state = show(search(plan, folder, trials, resources.pool(checkpoint_minutes), requests, resources.batch))
    best, own = best_trial(state.study, plan), own_trial(state.study, plan)
    settings = None if best is None else values_of(plan.space, best.params)
    better = best is not None and (own is None or own.number != best.number)
    return Tuned(
        settings,
        None if best is None else best.value,
        None if own is None else own.value,
        len(state.ended),
        judging_commands(plan, settings, best.number, folder) if better and best is not None and settings else [],
        write_page(state.study, plan, folder),
        state.hindered,
        requests.stop,
    )


def last_state(stream: Iterable[Tune]) -> Tune:
    """Let a tune run without showing it; its last state."""
    *_, state = stream
    return state
