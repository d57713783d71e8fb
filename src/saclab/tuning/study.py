"""Optuna's study in a folder, so that a tune killed at any instant goes on as if nothing had happened."""

from __future__ import annotations

import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from saclab.errors import UserError, in_words
from saclab.extras import required
from saclab.tuning.plan import TunePlan
from saclab.tuning.space import plain, suggested_value

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial, Trial

JOURNAL = "trials.jsonl"
NAME = "saclab"
WAY = "runs at the score"
"""Under this name the study keeps how many of a trial's runs have reached the score, where there is one."""
WHY = "why"
"""Under this name the study keeps why a trial was given up."""
TRIALS_BEFORE_PRUNING, EVALUATIONS_BEFORE_PRUNING = 5, 2
"""Trials of which all evaluations are known, and evaluations of a trial, before one is given up."""


class HeldAlready:
    """Optuna's lock on the journal: the folder's own lock is held, and the system lets go of that one after a kill."""

    def acquire(self) -> bool:
        return True

    def release(self) -> None:
        pass


def open_study(folder: Path, plan: TunePlan) -> optuna.Study:
    """The study of a folder, which this process has locked; made if there is none yet.

    The first trial of a new one is the variant's own settings, if they lie in the space.

    Raises:
        UserError: if Optuna is not installed, or the journal cannot be read.
    """
    module = required("optuna", "tune", "saclab tune")
    module.logging.set_verbosity(module.logging.WARNING)
    path = folder / JOURNAL
    try:
        mend_end(path)
        backend = module.storages.journal.JournalFileBackend(str(path), HeldAlready())
        study: optuna.Study = module.create_study(
            storage=module.storages.JournalStorage(backend), study_name=NAME, load_if_exists=True,
            direction=plan.objective.direction, pruner=pruner_of(plan, module),
        )  # fmt: skip
    except (ValueError, KeyError, TypeError, AssertionError, OSError) as error:
        raise UserError(f"{path} is damaged, or no journal of Optuna's: {in_words(error)}") from error
    if not study.trials and not plan.own_outside:
        study.enqueue_trial({name: plain(value) for name, value in plan.own_values.items()})
    return study


def mend_end(path: Path) -> None:
    """Cut off a last line that a crash has left without its end; Optuna would append to it."""
    with suppress(FileNotFoundError), path.open("r+b") as file:
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)


def pruner_of(plan: TunePlan, module: Any) -> Any:
    """What gives trials up by their returns; a way to a score has a rule of its own."""
    if not plan.pruning or plan.objective.kind.to_score:
        return module.pruners.NopPruner()
    return module.pruners.MedianPruner(TRIALS_BEFORE_PRUNING, EVALUATIONS_BEFORE_PRUNING)


def trials_under_way(study: optuna.Study) -> list[Trial]:
    """The trials that were begun and have no value yet."""
    from optuna.trial import Trial

    return [Trial(study, frozen._trial_id) for frozen in study.trials if frozen.state.name == "RUNNING"]


def drawn_settings(study: optuna.Study, plan: TunePlan, trial: Trial) -> dict[str, Any]:
    """The settings of a trial: those that it has already, the others drawn."""
    seed_sampler(study, plan, trial.number)
    settings, _together = {}, trial.relative_params  # what is drawn of all settings at once, by this seed
    for place, (name, dimension) in enumerate(plan.space.items(), start=1):
        seed_sampler(study, plan, trial.number, place)
        settings[name] = suggested_value(trial, name, dimension)
    return settings


def seed_sampler(study: optuna.Study, plan: TunePlan, trial: int, place: int = 0) -> None:
    """Let what is drawn next depend on the trial's number, the setting's place and the other trials so far only.

    So a tune that was killed between two draws goes on with those that it would have made. Trials under way count as
    well, by their settings: with several workers none is drawn next to them (the constant liar).
    """
    import optuna

    seed = np.random.SeedSequence((plan.search_seed, trial, place)).generate_state(1)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what Optuna calls experimental
        study.sampler = optuna.samplers.TPESampler(seed=int(seed), multivariate=True, constant_liar=True)


def ended_trials(study: optuna.Study) -> list[FrozenTrial]:
    """The trials that have a value or were given up, in their order."""
    return [trial for trial in study.trials if trial.state.is_finished()]


def best_trial(study: optuna.Study, plan: TunePlan) -> FrozenTrial | None:
    """The trial with the best value among those that were measured: with all runs at the score, where there is one."""
    measured = [trial for trial in study.trials if is_complete(trial) and reached_score(trial, plan)]
    best = min if plan.objective.kind.to_score else max
    return best(measured, key=lambda trial: trial.value or 0.0, default=None)


def is_complete(trial: FrozenTrial) -> bool:
    """Whether a trial came to its end, and has a value."""
    return trial.state.name == "COMPLETE"


def reached_score(trial: FrozenTrial, plan: TunePlan) -> bool:
    """Whether all runs of a trial have reached the score; where there is none, that is so."""
    return not plan.objective.kind.to_score or trial.user_attrs.get(WAY) == len(plan.seeds)


def value_in_words(trial: FrozenTrial, plan: TunePlan) -> str:
    """A trial's value, and whether it is one that was never measured: a run that did not get to the score is set."""
    if reached_score(trial, plan):
        return f"{trial.value:.4g}"
    return f"{trial.value:.4g}, with {trial.user_attrs.get(WAY, 0)} of {len(plan.seeds)} runs at the score"
