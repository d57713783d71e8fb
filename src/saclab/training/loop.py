"""The training loop, a generator of events. It does not print, does not handle signals, knows no command line."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from saclab.config import Config
from saclab.errors import NonFiniteError, RunBroken, TrainingFailed
from saclab.files import absolute
from saclab.limits import require_minutes
from saclab.machine import machine_facts
from saclab.training.engine import NOTHING_HAPPENED, Engine, EngineBuilder
from saclab.training.events import Event, Failed, Interrupted, Started
from saclab.training.failure import tell_of_closing, tracebacks_in, write_failure_report
from saclab.training.local_engine import LocalBuilder
from saclab.training.lock import locked
from saclab.training.process import device_name, prepare_process
from saclab.training.requests import Requests, Stopped
from saclab.training.run_folder import is_finished
from saclab.training.run_writer import RunWriter
from saclab.training.snapshot import Snapshot
from saclab.training.starts import build, find_beginnings, require_same_config

PROGRESS_SECONDS = 0.25
Told = Iterator[tuple[int, Event]]
"""The place of a run, and what it tells."""


def train(
    config: Config, folder: Path, requests: Requests | None = None, checkpoint_minutes: float = 10
) -> Generator[Event]:
    """Train, from the start or from the folder's newest checkpoint, until the protocol's end or a request to stop.

    Args:
        config: what to train.
        folder: the run folder; made if it does not exist.
        requests: asks the run to stop or save.
        checkpoint_minutes: wall-clock time between checkpoints; it does not change the result.

    Raises:
        UserError: if the folder holds another configuration, or is in use by another process.
        TrainingFailed: if a number is not finite or no checkpoint can be written or read; what was saved is kept.
    """
    folder = absolute(folder)
    if not unfinished([config], [folder]):
        return
    prepare_process()
    with tracebacks_in([folder]):
        builder = LocalBuilder(config)
    with closing(train_runs(builder, [folder], requests, checkpoint_minutes)) as told:
        for _, event in told:
            if isinstance(event, Failed):
                raise (NonFiniteError if event.not_finite else RunBroken)(event.message, traceback=event.traceback)
            yield event


def unfinished(configs: Sequence[Config], folders: Sequence[Path]) -> list[int]:
    """The places of the runs that are not at their end; raises UserError if one that is has other settings."""
    places = []
    for place, (config, folder) in enumerate(zip(configs, folders, strict=True)):
        if is_finished(folder):
            require_same_config(folder, config)
        else:
            places.append(place)
    return places


def train_runs(
    builder: EngineBuilder, folders: Sequence[Path], requests: Requests | None, checkpoint_minutes: float
) -> Generator[tuple[int, Event]]:
    """Train the runs of an engine, from the start or from their newest common checkpoint.

    Args:
        builder: of the engine.
        folders: the run folders; made if they do not exist.
        requests: asks all runs to stop or save.
        checkpoint_minutes: wall-clock time between checkpoints.

    Yields:
        The place of a run, and what it tells.
    """
    require_minutes(checkpoint_minutes)
    with writing_to(folders), tracebacks_in(folders), ExitStack() as stack:
        for folder in folders:
            stack.enter_context(locked(folder))
        facts = machine_facts(device_name(), builder.slots)
        beginnings = find_beginnings(builder, folders, facts)
        engine = build(builder, beginnings, folders)
        stack.callback(lambda: tell_of_closing(engine.close(), folders))
        writers = [
            stack.enter_context(closing(RunWriter(beginning, builder.spec, folder, facts)))
            for beginning, folder in zip(beginnings, folders, strict=True)
        ]
        del beginnings  # the engine has taken what is large in them
        yield from Session(engine, writers, requests or Requests(), checkpoint_minutes).events()


@contextmanager
def writing_to(folders: Sequence[Path]) -> Iterator[None]:
    """Turn what goes wrong with the run folders into a TrainingFailed that says the way on."""
    try:
        yield
    except OSError as error:
        alone = len(folders) == 1
        raise TrainingFailed(
            f"cannot write to {folders[0] if alone else error.filename or f'{folders[0]}, …'}: "
            f"{error.strerror or error}; what was saved is kept: make room, or give this "
            "process leave to write there, then start the same command again"
            + (f" or: saclab resume {folders[0]}" if alone else "")
        ) from error


class Session:
    """One process's work on the runs of an engine: their writers and its clocks."""

    def __init__(
        self, engine: Engine, writers: Sequence[RunWriter], requests: Requests, checkpoint_minutes: float
    ) -> None:
        self.engine, self.writers, self.requests = engine, writers, requests
        self.checkpoint_seconds = 60 * checkpoint_minutes
        self.active = list(range(len(engine.runs)))
        """The runs that go on."""
        self.last_save = self.last_progress = time.monotonic()

    def events(self) -> Told:
        """Train until every run has finished or failed, or until a request to stop."""
        for run in self.active:
            writer = self.writers[run]
            yield run, Started(writer.folder, writer.resumed_at_step, tuple(writer.notes))
        runs = self.engine.runs
        in_round = self._in_round()
        while True:
            try:
                if not in_round and (due := [run for run in self.active if runs[run].evaluation_due()]):
                    yield from self._evaluate(due)
                if self.requests.stop:
                    yield from self._stop()
                    return
                # before a save that comes by the clock: the last checkpoint is the one after the last evaluation
                if not in_round and (ending := self._ending()):
                    yield from self._finish(ending)
            except Stopped:
                yield from self._stop()
                return
            if not self.active:
                return
            if self._save_is_due():
                yield from self._save()
            if self._progress_is_due():
                self.last_progress = time.monotonic()
                for run in self.active:
                    yield run, self.writers[run].progress()
            yield from self._step(in_round)
            in_round = self._in_round()
            if not in_round:
                for run in [run for run in self.active if runs[run].window_is_full()]:
                    yield from self._log_updates(run)

    def _save_is_due(self) -> bool:
        return self.requests.save or time.monotonic() - self.last_save > self.checkpoint_seconds

    def _progress_is_due(self) -> bool:
        return time.monotonic() - self.last_progress > PROGRESS_SECONDS

    def _asked_to_stop(self) -> bool:
        return self.requests.stop != 0

    def _should_pause(self) -> bool:
        """Whether there is something to do within a round of updates, which may take hours."""
        return self._asked_to_stop() or self._save_is_due() or self._progress_is_due()

    def _in_round(self) -> bool:
        """Whether updates are left to make before the next step; the runs of an engine are equally far."""
        return bool(self.active) and self.engine.runs[self.active[0]].updates_left > 0

    def _ending(self) -> dict[int, str]:
        """The runs that are at their end, with the reason."""
        return {run: reason for run in self.active if (reason := self.engine.runs[run].finish_reason())}

    def _step(self, in_round: bool) -> Told:
        """A step with its round of updates, or the rest of a round that is under way."""
        if in_round:
            self.engine.make_updates(self._should_pause)
            result = NOTHING_HAPPENED
        else:
            result = self.engine.step(self._should_pause)
        for run, (error, snapshot) in result.broken.items():
            yield self._fail(run, error, snapshot)
        for run, episodes in result.ended.items():
            for episode in episodes:
                for event in self.writers[run].log_episode(episode):
                    yield run, event

    def _log_updates(self, run: int) -> Told:
        self.engine.deliver_metrics()
        try:
            for event in self.writers[run].log_updates():
                yield run, event
        except NonFiniteError as error:
            yield self._fail(run, error, self.engine.snapshot(run))

    def _fail(self, run: int, error: RunBroken, snapshot: Snapshot) -> tuple[int, Event]:
        """Leave a run behind, with what is known of its end in its folder."""
        try:
            snapshot.run.window_array()  # an update may have broken first, and the environment only met what came of it
        except NonFiniteError as first:
            error = first
        message = f"{error}. {write_failure_report(self.writers[run].folder, snapshot, error)}"
        self._drop(run)
        return run, Failed(message, isinstance(error, NonFiniteError), error.traceback)

    def _drop(self, run: int) -> None:
        self.active.remove(run)
        self.engine.drop(run)

    def _evaluate(self, runs: Sequence[int]) -> Told:
        """Evaluate these runs' policies.

        Raises:
            Stopped: on a request to stop; each of them is as before then, and will be evaluated first.
        """
        engine = self.engine
        try:
            found = engine.evaluate(runs, self._asked_to_stop)
            whole = [run for run in runs if not isinstance(found[run], RunBroken)]
            biases = engine.measure_q_bias(whole, self._asked_to_stop)
        except Stopped:
            for run in runs:
                engine.runs[run].postpone_evaluation()
            raise
        for run in runs:
            match found[run], biases.get(run):
                case (RunBroken() as error, _) | (_, RunBroken() as error):
                    yield self._fail(run, error, engine.snapshot(run))
                case episodes, bias:
                    best = engine.runs[run].enter_evaluation(episodes, engine.actor(run))
                    for event in self.writers[run].log_evaluation(episodes, best, bias):
                        yield run, event

    def _finish(self, reasons: dict[int, str]) -> Told:
        """Log, evaluate and save these runs for the last time; raises Stopped as `_evaluate` does."""
        states = self.engine.runs
        for run in reasons:
            if states[run].window_size:
                yield from self._log_updates(run)
        counters = {run: states[run].counters for run in reasons if run in self.active}
        if changed := [run for run, own in counters.items() if own.evaluated_at_update != own.updates]:
            yield from self._evaluate(changed)
        for run in counters:
            if run in self.active:
                yield from self._save_run(run)
            if run in self.active:
                for event in self.writers[run].finish(reasons[run]):
                    yield run, event
                self._drop(run)

    def _save(self) -> Told:
        """A checkpoint of every run, all of the same step."""
        self.requests.save = False
        for run in tuple(self.active):
            yield from self._save_run(run)
        self.last_save = time.monotonic()

    def _save_run(self, run: int) -> Told:
        snapshot = self.engine.snapshot(run)
        try:
            environments = self.engine.capture_environments(run)
            self.engine.actor(run)  # waits for the updates: from here on, only writing can take long
            with self.requests.while_saving():
                saved = self.writers[run].save(snapshot, environments)
            yield run, saved
        except RunBroken as error:
            yield self._fail(run, error, snapshot)

    def _stop(self) -> Told:
        yield from self._save()
        for run in self.active:
            yield run, Interrupted(self.engine.runs[run].counters.steps)
