"""The loop of a tune: ask for a trial, train its runs, give it up or tell what it is worth."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saclab.errors import TrainingFailed, UserError
from saclab.files import write_json
from saclab.grid.launch import Grid
from saclab.grid.pool import WorkerPool
from saclab.grid.tasks import RunStatus, make_statuses, make_tasks
from saclab.training.lock import locked
from saclab.training.requests import Requests
from saclab.training.run_folder import read_run
from saclab.tuning.objective import Evaluations
from saclab.tuning.plan import PLAN, TunePlan, is_recorded, trial_name
from saclab.tuning.study import WHY, best_trial, drawn_settings, ended_trials, open_study, trials_under_way

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial, Trial

FAILURES = 5
"""Trials that fail before any has succeeded; then the cause is not their settings."""


@dataclass
class OpenTrial:
    """A trial whose runs are trained."""

    trial: Trial
    settings: dict[str, Any]
    runs: list[RunStatus]
    evaluations: list[Evaluations | None] = field(init=False)
    """Of each run, once it has any."""
    read: list[tuple[int, bool]] = field(init=False)
    """Of each run, how many evaluations there were when they were read last, and whether it had ended."""
    given_up: str = ""
    """Why, if it was."""

    def __post_init__(self) -> None:
        self.evaluations = [None] * len(self.runs)
        self.read = [(0, False)] * len(self.runs)

    @property
    def at_rest(self) -> bool:
        return all(run.status in ("finished", "interrupted", "failed") for run in self.runs)

    @property
    def failure(self) -> str:
        """Why a run of it failed, if one has."""
        return next((run.message for run in self.runs if run.status == "failed"), "")

    def look(self) -> bool:
        """Read the evaluations of the runs that have news; whether there were any."""
        news = False
        for place, run in enumerate(self.runs):
            state = run.evaluations, run.status == "finished"
            if state != self.read[place]:
                self.read[place], news = state, True
                self.evaluations[place] = read_run(run.cell.folder).evaluations
        return news


@dataclass
class Tune:
    """A tune that goes on: its study, and the trials whose runs are trained."""

    plan: TunePlan
    folder: Path
    study: optuna.Study
    grid: Grid
    trials: int
    """How many there are to be, those before a stop counted in."""
    batch: int
    open: list[OpenTrial] = field(default_factory=list)
    ended: list[FrozenTrial] = field(default_factory=list)
    ended_before: int = 0
    """Trials that had ended when this session began."""

    def begin(self) -> None:
        """Take up the trials that a stop has left, then begin new ones while there is room."""
        for trial in trials_under_way(self.study):
            self._enter(trial)
        self.ended = ended_trials(self.study)
        self.ended_before = len(self.ended)
        for ended in self.ended:
            self._clear(ended.number)

    def step(self, stopping: bool) -> None:
        """Begin what there is room for, hear what the runs say, and judge their trials."""
        if stopping:
            self.grid.stop()
        else:
            while self._has_room():
                self._enter(self.study.ask())
            self.grid.start()
        self.grid.listen()
        for trial in tuple(self.open):
            self._judge(trial, stopping)

    def goes_on(self, stopping: bool) -> bool:
        if stopping:
            return bool(self.grid.running)
        return bool(self.open) or self._left()

    def _left(self) -> bool:
        """Whether trials are still to be begun."""
        return sum(trial.state.name != "WAITING" for trial in self.study.trials) < self.trials

    def _has_room(self) -> bool:
        """Whether a new trial's first run could begin now: it should know of as many others as it can."""
        if not self._left() or self.grid.waiting:
            return False
        places = self.grid.pool.places
        if places is None:
            return all(task.started for task in self.grid.running)
        return self.grid.busy < places

    def _enter(self, trial: Trial) -> None:
        """Let a trial's runs be trained; settings that cannot work together are told and left."""
        settings = drawn_settings(self.study, self.plan, trial)
        try:
            cells = self.plan.cells(self.folder, trial.number, settings)
        except UserError as error:
            self._tell(trial, None, str(error))
            return
        opened = OpenTrial(trial, settings, make_statuses(cells))
        self.open.append(opened)
        self.grid.waiting += make_tasks(opened.runs, self.batch)

    def _judge(self, trial: OpenTrial, stopping: bool) -> None:
        """Give a trial up, end runs that have nothing more to show, or tell its value."""
        if (trial.look() or trial.failure) and not stopping:
            self._end_early(trial)
        if not trial.at_rest:
            return
        if trial.given_up:
            self._close(trial, None, trial.given_up)
        elif all(run.status == "finished" or self._reached(trial, place) for place, run in enumerate(trial.runs)):
            self._close(trial, self.plan.objective.value([found for found in trial.evaluations if found is not None]))
        else:  # somebody has stopped a run: it goes on when the command is given again
            self.open.remove(trial)

    def _reached(self, trial: OpenTrial, place: int) -> bool:
        found = trial.evaluations[place]
        return found is not None and self.plan.objective.reached(found)

    def _end_early(self, trial: OpenTrial) -> None:
        """Stop what can change nothing any more: a run at its score, a trial that is no good."""
        if self.plan.objective.kind.to_score:
            self.grid.give_up([run for place, run in enumerate(trial.runs) if self._reached(trial, place)])
        if not trial.given_up and (why := trial.failure or self._hopeless(trial)):
            trial.given_up = why
            self.grid.give_up(trial.runs)

    def _hopeless(self, trial: OpenTrial) -> str:
        """Why a trial is given up by its evaluations; empty if it is not."""
        objective = self.plan.objective
        if not self.plan.pruning or trial.at_rest:
            return ""
        if objective.kind.to_score:
            best = best_trial(self.study)
            least = objective.at_least(trial.evaluations, [run.status == "finished" for run in trial.runs])
            if best is None or best.value is None or least <= best.value:
                return ""
            return f"it needs more than the best so far, {best.value:.4g}"
        columns = [found["mean_return"] for found in trial.evaluations if found is not None]
        if len(columns) < len(trial.runs):
            return ""
        reported = self.study.trials[trial.trial.number].intermediate_values
        for count in range(len(reported) + 1, min(map(len, columns)) + 1):
            trial.trial.report(objective.value([{"mean_return": column[:count]} for column in columns]), count)
        return "it was below the median of the trials before it" if trial.trial.should_prune() else ""

    def _close(self, trial: OpenTrial, value: float | None, why: str = "") -> None:
        self.open.remove(trial)
        self._tell(trial.trial, value, why)
        self._clear(trial.trial.number)

    def _tell(self, trial: Trial, value: float | None, why: str) -> None:
        """Tell the study what a trial is worth, or why it was given up; raises TrainingFailed if all are."""
        if value is None:
            trial.set_user_attr(WHY, why)
        self.study.tell(trial.number, value, None if value is not None else pruned())
        self.ended = ended_trials(self.study)
        if len(self.ended) >= FAILURES and best_trial(self.study) is None:
            raise TrainingFailed(f"none of the first {len(self.ended)} trials came to its end; the last one: {why}")

    def _clear(self, number: int) -> None:
        """Remove the checkpoints of an ended trial's runs: nothing goes on from them, and they are large."""
        for checkpoints in self.folder.glob(f"runs/*/{trial_name(number)}/*/seed-*/checkpoints"):
            shutil.rmtree(checkpoints, ignore_errors=True)


def pruned() -> Any:
    from optuna.trial import TrialState

    return TrialState.PRUNED


def search(
    plan: TunePlan,
    folder: Path,
    trials: int,
    pool: AbstractContextManager[WorkerPool],
    requests: Requests,
    batch: int = 0,
) -> Iterator[Tune]:
    """Search until there are so many trials, or a request to stop; yields its state several times a second.

    A trial that a stop or a kill has left under way goes on with its runs, from their checkpoints. With one worker, and
    a worth that is not a time, the trials are those of a tune that was never stopped.

    Args:
        plan: what to search for.
        folder: of the tune; made if it does not exist.
        trials: how many, those of earlier sessions counted in.
        pool: where the runs are trained.
        requests: asks the tune to stop.
        batch: how many runs of a trial are trained as one run group; 0 for each alone.

    Raises:
        UserError: if the folder holds another tune, or another process works on it.
        TrainingFailed: if the first trials all fail.
    """
    with locked(folder):
        if not is_recorded(folder, plan):
            write_json(folder / PLAN, plan.to_plain())
        study = open_study(folder, plan)
        with pool as workers:
            state = Tune(plan, folder, study, Grid(workers, [], batch), trials, batch)
            state.begin()
            while state.goes_on(bool(requests.stop)):
                state.step(bool(requests.stop))
                yield state
        yield state
