"""A trial whose runs are trained: what is known of it, and whether it is any good."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from saclab.errors import UserError
from saclab.grid.tasks import RunStatus
from saclab.training.run_folder import read_evaluations
from saclab.tuning.objective import Evaluations, Objective
from saclab.tuning.plan import TunePlan
from saclab.tuning.study import best_trial

if TYPE_CHECKING:
    import optuna
    from optuna.trial import Trial


@dataclass
class OpenTrial:
    """A trial whose runs are trained."""

    trial: Trial
    runs: list[RunStatus]
    evaluations: list[Evaluations | None] = field(init=False)
    """Of each run, once it has any."""
    read: list[tuple[int, bool]] = field(init=False)
    """Of each run, how many evaluations there were when they were read last, and whether it had ended."""
    given_up: str = ""
    """Why, if it was."""
    unreadable: str = ""
    """Why its evaluations cannot be read, if that is so."""

    def __post_init__(self) -> None:
        self.evaluations = [None] * len(self.runs)
        self.read = [(0, False)] * len(self.runs)

    @property
    def at_rest(self) -> bool:
        return all(run.status in ("finished", "interrupted", "failed") for run in self.runs)

    @property
    def broken(self) -> str:
        """Why a run of it failed, by something in the run itself; empty if none has."""
        return next((run.message for run in self.runs if run.status == "failed" and run.broken), "")

    def hindrance(self, objective: Objective) -> str:
        """What has stopped a run from outside; empty if nothing has."""
        stopped = (
            run.message if run.status == "failed" else "a run of it was told to stop"
            for place, run in enumerate(self.runs)
            if (run.status == "failed" and not run.broken)
            or (run.status == "interrupted" and not self.reached(place, objective))
        )
        return self.unreadable or next(stopped, "")

    def look(self) -> bool:
        """Read the evaluations of the runs that have news; whether there were any."""
        news = False
        for place, run in enumerate(self.runs):
            state = run.evaluations, run.status == "finished"
            if state != self.read[place]:
                self.read[place], news = state, True
                try:
                    self.evaluations[place] = read_evaluations(run.cell.folder, run.cell.config)
                except UserError as error:
                    self.unreadable = str(error)
        return news

    def reached(self, place: int, objective: Objective) -> bool:
        """Whether a run is at its score, so that nothing more changes its value."""
        found = self.evaluations[place]
        return found is not None and objective.reached(found)

    def is_whole(self, objective: Objective) -> bool:
        """Whether all runs are at their end, or at their score."""
        return not self.unreadable and all(
            (run.status == "finished" and self.evaluations[place] is not None) or self.reached(place, objective)
            for place, run in enumerate(self.runs)
        )

    def value(self, objective: Objective) -> float:
        """What a whole trial is worth."""
        return objective.value([found for found in self.evaluations if found is not None])

    def hopeless(self, plan: TunePlan, study: optuna.Study) -> str:
        """Why the trial is to be given up by its evaluations; empty if it is not.

        Every evaluation is judged by itself, so that the answer is the same however many have come since the last look.
        """
        if not plan.objective.kind.to_score:
            return self._too_low(plan.objective, study)
        best = best_trial(study, plan)
        return "" if best is None else self._too_slow(plan.objective, best.value or 0.0)

    def _too_slow(self, objective: Objective, best: float) -> str:
        """Whether more has been spent on the way to the score than the best trial needed, which got there."""
        runs, ended = list(self.evaluations), [run.status == "finished" for run in self.runs]
        if self.is_whole(objective) and runs[-1] is not None:  # as it was while there was something to wait for
            runs[-1], ended[-1] = objective.before_score(runs[-1]), False
        return f"it needs more than the best so far, {best:.4g}" if objective.at_least(runs, ended) > best else ""

    def _too_low(self, objective: Objective, study: optuna.Study) -> str:
        """Whether it is below the median of the others at an evaluation, once all its runs have made it."""
        columns = [found["mean_return"] for found in self.evaluations if found is not None]
        if len(columns) < len(self.runs):
            return ""
        reported = len(study.trials[self.trial.number].intermediate_values)
        low = reported > 0 and self.trial.should_prune()  # a kill may have come between a report and its verdict
        for count in range(reported + 1, min(map(len, columns)) + 1):
            if low:
                break
            self.trial.report(objective.value([{"mean_return": column[:count]} for column in columns]), count)
            low = self.trial.should_prune()
        return "it was below the median of the trials before it" if low else ""
