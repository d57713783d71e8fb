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
from saclab.grid.tasks import make_statuses, make_tasks
from saclab.training.lock import locked
from saclab.training.requests import Requests
from saclab.tuning.open_trial import OpenTrial
from saclab.tuning.plan import PLAN, TunePlan, is_recorded, trial_name
from saclab.tuning.study import WAY, WHY, drawn_settings, ended_trials, is_complete, open_study, trials_under_way

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial, Trial

FAILURES = 5
"""Trials that fail before any has succeeded; then the cause is not their settings."""


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
    ended_before: set[int] = field(default_factory=set)
    """Numbers of the trials that had ended when this session began."""
    hindered: dict[int, str] = field(default_factory=dict)
    """Trials that something from outside has stopped, and what; the same command goes on with them."""

    def begin(self) -> None:
        """Take up the trials that a stop has left, then begin new ones while there is room."""
        for trial in trials_under_way(self.study):
            self._enter(trial)
        self.ended = ended_trials(self.study)
        self.ended_before = {trial.number for trial in self.ended}
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
        return bool(self.open) or self._begins_more()

    def _begins_more(self) -> bool:
        """Whether trials are still to be begun; none is where something from outside hinders them."""
        begun = sum(trial.state.name != "WAITING" for trial in self.study.trials)
        return begun < self.trials and not self.hindered

    def _has_room(self) -> bool:
        """Whether a new trial's first run could begin now: it should know of as many others as it can."""
        if not self._begins_more() or self.grid.waiting:
            return False
        places = self.grid.pool.places
        if places is None:
            return all(task.started for task in self.grid.running)
        return self.grid.busy < places

    def _enter(self, trial: Trial) -> None:
        """Let a trial's runs be trained; settings that cannot work together are told and left."""
        settings = drawn_settings(self.study, self.plan, trial)
        try:
            cells = self.plan.cells(self.folder, trial_name(trial.number), settings)
        except UserError as error:
            self._tell(trial, None, str(error))
            return
        opened = OpenTrial(trial, make_statuses(cells))
        self.open.append(opened)
        tasks = make_tasks(opened.runs, self.batch)
        self.grid.note(tasks)
        self.grid.waiting += tasks

    def _judge(self, trial: OpenTrial, stopping: bool) -> None:
        """Give a trial up, end runs that have nothing more to show, or tell its value."""
        objective, news = self.plan.objective, trial.look()
        if stopping and not trial.is_whole(objective):
            return
        if objective.kind.to_score and news:
            self.grid.give_up([run for place, run in enumerate(trial.runs) if trial.reached(place, objective)])
        if not trial.given_up and (why := trial.broken or self._hopeless(trial, news)):
            trial.given_up = why
        if trial.given_up or trial.hindrance(objective):
            self.grid.give_up(trial.runs)
        if trial.at_rest:
            self._end(trial)

    def _hopeless(self, trial: OpenTrial, news: bool) -> str:
        judged = news and self.plan.pruning and not trial.unreadable
        return trial.hopeless(self.plan, self.study) if judged else ""

    def _end(self, trial: OpenTrial) -> None:
        """Tell what came of a trial whose runs are at rest."""
        self.open.remove(trial)
        number, whole = trial.trial.number, trial.is_whole(self.plan.objective)
        if not trial.given_up and not whole:
            self.hindered[number] = trial.hindrance(self.plan.objective)
            return
        if self.plan.objective.kind.to_score and not trial.given_up:
            at_score = sum(trial.reached(place, self.plan.objective) for place in range(len(trial.runs)))
            trial.trial.set_user_attr(WAY, at_score)
        self._tell(trial.trial, None if trial.given_up else trial.value(self.plan.objective), trial.given_up)
        self._clear(number)

    def _tell(self, trial: Trial, value: float | None, why: str) -> None:
        """Tell the study what a trial is worth, or why it was given up; raises TrainingFailed if all are."""
        if value is None:
            trial.set_user_attr(WHY, why)
        self.study.tell(trial.number, value, None if value is not None else pruned())
        self.ended = ended_trials(self.study)
        if len(self.ended) >= FAILURES and not any(map(is_complete, self.ended)):
            raise TrainingFailed(
                f"none of the first {len(self.ended)} trials came to its end; the last one: {why}: change what is "
                "searched or what holds for every trial, in another folder (--out)"
            )

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
