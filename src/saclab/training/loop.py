"""The training loop, a generator of events. It does not print, does not handle signals, knows no command line."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from saclab.config import Config
from saclab.errors import NonFiniteError, TrainingFailed
from saclab.machine import machine_facts
from saclab.training.checkpoint import load_newest_checkpoint
from saclab.training.events import Evaluated, Event, Interrupted, Saved, Started
from saclab.training.journal import Journal, require_same_config, what_is_left
from saclab.training.lock import locked
from saclab.training.process import device_name, prepare_process
from saclab.training.requests import Requests, Stopped
from saclab.training.run import Run
from saclab.training.run_folder import is_finished

PROGRESS_SECONDS = 0.25
EVALUATE_FIRST = -1  # for `evaluation_slots`: a test is due before the next step


def train(
    config: Config, folder: Path, requests: Requests | None = None, checkpoint_minutes: float = 10
) -> Iterator[Event]:
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
    if is_finished(folder):
        require_same_config(folder, config)
        return
    prepare_process()
    with closing(Run(config)) as run:  # before the folder is touched: bad input leaves nothing behind
        try:
            with locked(folder), closing(Session(run, folder, requests or Requests(), checkpoint_minutes)) as session:
                yield from session.events()
        except NonFiniteError as error:
            raise NonFiniteError(f"{error}. {what_is_left(folder, run, error)}") from error
        except OSError as error:
            raise TrainingFailed(
                f"cannot write to {folder}: {error.strerror or error}; what was saved is kept: make room, or give this "
                f"process leave to write there, then start the same command again or: saclab resume {folder}"
            ) from error


class Session:
    """One process's work on a run that is alone: the run, its journal and its clocks."""

    def __init__(self, run: Run, folder: Path, requests: Requests, checkpoint_minutes: float) -> None:
        self.run, self.requests = run, requests
        self.checkpoint_seconds = 60 * checkpoint_minutes
        self.journal = Journal(run, folder, machine_facts(device=device_name()))
        if self.journal.begun_before:
            checkpoint = load_newest_checkpoint(folder / "checkpoints", run.replay, self.journal.notes.append)
            if checkpoint is not None:
                self.journal.restore(checkpoint)
        self.journal.open()
        self.last_progress = time.monotonic()

    def events(self) -> Iterator[Event]:
        run, journal = self.run, self.journal
        yield Started(journal.folder, journal.resumed_at_step, tuple(journal.notes))
        while True:
            if run.evaluation_due():
                try:
                    yield self._test()
                except Stopped:
                    run.counters.evaluation_slots = EVALUATE_FIRST
                    yield from self._stop(untested=True)
                    return
            if self.requests.stop:
                yield from self._stop()
                return
            if (reason := run.finish_reason()) is not None:
                break  # before a save that comes by the clock: the last checkpoint is the one after the last test
            now = time.monotonic()
            if self.requests.save or now - journal.last_save > self.checkpoint_seconds:
                yield self._save()
            if now - self.last_progress > PROGRESS_SECONDS:
                self.last_progress = now
                yield journal.progress()
            for episode in run.step():
                yield from journal.log_episode(episode)
            yield from journal.log_updates()
        yield from self._finish(reason)

    def close(self) -> None:
        self.journal.close()

    def _test(self) -> Evaluated:
        episodes, best = self.run.evaluate(lambda: self.requests.stop != 0)
        return self.journal.log_test(episodes, best, self.run.q_bias())

    def _save(self, untested: bool = False) -> Saved:
        self.requests.save = False
        return self.journal.save(untested)

    def _stop(self, untested: bool = False) -> Iterator[Event]:
        yield self._save(untested)
        yield Interrupted(self.run.counters.steps)

    def _finish(self, reason: str) -> Iterator[Event]:
        counters = self.run.counters
        yield from self.journal.log_updates(last=True)
        if counters.evaluated_at_update != counters.updates:
            try:
                yield self._test()
            except Stopped:
                yield from self._stop(untested=True)
                return
        yield from self.journal.finish(reason)
