"""The training loop of a batch: that of a run alone, for many; each run keeps its own folder."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from saclab.batch.batch import Batch
from saclab.batch.member import Member
from saclab.config import Config, require_same_structure
from saclab.errors import NonFiniteError, RunBroken, TrainingFailed
from saclab.machine import machine_facts, usable_cores
from saclab.replay import ReplayBuffer
from saclab.training.checkpoint import read_checkpoint
from saclab.training.common_checkpoint import common_checkpoints
from saclab.training.events import Event, Failed, Interrupted, Started
from saclab.training.journal import Journal, require_same_config, what_is_left
from saclab.training.lock import locked
from saclab.training.loop import EVALUATE_FIRST, PROGRESS_SECONDS
from saclab.training.process import device_name, prepare_process
from saclab.training.requests import Requests, Stopped
from saclab.training.run_folder import is_finished

Told = Iterator[tuple[int, Event]]


def train_batch(
    configs: Sequence[Config],
    folders: Sequence[Path],
    requests: Requests | None = None,
    checkpoint_minutes: float = 10,
    slots: int = 0,
    workers: int | None = None,
) -> Told:
    """Train runs of the same structure together, from the start or from their last common checkpoint.

    A run that finishes, or that meets a number that is not finite, leaves the others as they are.

    Args:
        configs: what to train; `config.structure` says what they must have in common.
        folders: the run folders; made if they do not exist.
        requests: asks the batch to stop or save.
        checkpoint_minutes: wall-clock time between checkpoints; it does not change the result.
        slots: room of the compiled program, if more than runs: results depend on it in the last bits.
        workers: processes that step the environments; None for one per core.

    Yields:
        The place of a run in `configs`, and what it tells.

    Raises:
        UserError: if the runs do not have the same structure, or a folder holds another configuration or is in use.
        TrainingFailed: if no checkpoint can be written or read, or a process that steps environments has died.
    """
    require_same_structure(configs)
    unfinished = []
    for index, (config, folder) in enumerate(zip(configs, folders, strict=True)):
        if is_finished(folder):
            require_same_config(folder, config)
        else:
            unfinished.append(index)
    if not unfinished:
        return
    prepare_process()
    chosen = [configs[index] for index in unfinished]
    batch = Batch(chosen, slots, workers or len(usable_cores()))  # before a folder is touched, as for a run alone
    with closing(batch), writing(folders), ExitStack() as stack:
        mine = [folders[index] for index in unfinished]
        for folder in mine:
            stack.enter_context(locked(folder))
        session = stack.enter_context(
            closing(BatchSession(batch, mine, requests or Requests(), checkpoint_minutes))
        )  # fmt: skip
        for slot, event in session.events():
            yield unfinished[slot], event


@contextmanager
def writing(folders: Sequence[Path]) -> Iterator[None]:
    """Turn what goes wrong with the run folders into a TrainingFailed that says the way on."""
    try:
        yield
    except OSError as error:
        where = error.filename or f"{folders[0]}, …"
        raise TrainingFailed(
            f"cannot write to {where}: {error.strerror or error}; what was saved is kept: make room, or give this "
            "process leave to write there, then start the same command again"
        ) from error


class BatchSession:
    """One process's work on a batch: the runs, their journals and its clocks."""

    def __init__(self, batch: Batch, folders: Sequence[Path], requests: Requests, checkpoint_minutes: float) -> None:
        self.batch, self.requests = batch, requests
        self.checkpoint_seconds = 60 * checkpoint_minutes
        facts = machine_facts(device_name(), batch.program.slots)
        self.journals = [Journal(member, folder, facts) for member, folder in zip(batch.members, folders, strict=True)]
        self._restore()
        batch.begin()
        for journal in self.journals:
            journal.open()
        self.last_save = self.last_progress = time.monotonic()

    def events(self) -> Told:
        """Until every run has finished or failed, or a request to stop."""
        batch = self.batch
        for member, journal in self._going_on():
            yield member.slot, Started(journal.folder, journal.resumed_at_step, tuple(journal.notes))
        while True:
            try:
                yield from self._test([member for member in batch.active if member.evaluation_due()])
                if self.requests.stop:
                    yield from self._stop()
                    return
                yield from self._finish([member for member in batch.active if member.finish_reason()])
            except Stopped:
                yield from self._stop()
                return
            if not batch.active:
                return
            yield from self._by_the_clock()
            yield from self._step()

    def close(self) -> None:
        for journal in self.journals:
            journal.close()

    def _going_on(self) -> list[tuple[Member, Journal]]:
        return [(member, self.journals[member.slot]) for member in self.batch.active]

    def _restore(self) -> None:
        """Continue from the newest step of which every run has a whole checkpoint."""
        buffer = ReplayBuffer(self.batch.config.training.replay_capacity, self.batch.layout)
        found = common_checkpoints(
            [journal.folder for journal in self.journals], buffer, [journal.notes.append for journal in self.journals]
        )
        for member, journal, path in zip(self.batch.members, self.journals, found, strict=False):
            member.replay = buffer
            journal.restore(read_checkpoint(path, buffer))
            self.batch.take_transitions(member, buffer)

    def _step(self) -> Told:
        broken: list[tuple[int, Event]] = []
        ended = self.batch.step(lambda member, error: broken.append(self._fail(member, error)))
        yield from broken
        for slot, episodes in ended.items():
            for episode in episodes:
                for event in self.journals[slot].log_episode(episode):
                    yield slot, event
        for member in self.batch.active:
            yield from self._log_updates(member)

    def _log_updates(self, member: Member, last: bool = False) -> Told:
        try:
            for event in self.journals[member.slot].log_updates(last):
                yield member.slot, event
        except NonFiniteError as error:
            yield self._fail(member, error)

    def _fail(self, member: Member, error: RunBroken) -> tuple[int, Event]:
        """Leave a run behind, with what is known of its end in its folder."""
        try:
            member.window_array()  # an update may have broken first, and the environment only met what came of it
        except NonFiniteError as first:
            error = first
        message = f"{error}. {what_is_left(self.journals[member.slot].folder, member, error)}"
        self.batch.leave(member)
        return member.slot, Failed(message)

    def _test(self, members: Sequence[Member]) -> Told:
        """Test these runs' policies.

        Raises:
            Stopped: on a request to stop; each of them is as before then, and will be tested first.
        """
        if not members:
            return
        try:
            tests = self.batch.test(members, lambda: self.requests.stop != 0)
        except Stopped:
            for member in members:
                member.counters.evaluation_slots = EVALUATE_FIRST
            raise
        tested = []
        for member in members:
            match tests[member.slot]:
                case RunBroken() as error:
                    yield self._fail(member, error)
                case episodes:
                    tested.append((member, episodes, member.enter_test(episodes)))
        biases = self.batch.q_bias([member for member, _, _ in tested])
        for member, episodes, best in tested:
            match biases.get(member.slot):
                case RunBroken() as error:
                    yield self._fail(member, error)
                case bias:
                    yield member.slot, self.journals[member.slot].log_test(episodes, best, bias)

    def _finish(self, members: Sequence[Member]) -> Told:
        reasons = {member.slot: str(member.finish_reason()) for member in members}
        for member in members:
            yield from self._log_updates(member, last=True)
        members = [member for member in members if member.active]
        yield from self._test([m for m in members if m.counters.evaluated_at_update != m.counters.updates])
        for member in members:
            if not member.active:
                continue
            try:
                for event in self.journals[member.slot].finish(reasons[member.slot]):
                    yield member.slot, event
                self.batch.leave(member)
            except NonFiniteError as error:
                yield self._fail(member, error)

    def _by_the_clock(self) -> Told:
        now = time.monotonic()
        if self.requests.save or now - self.last_save > self.checkpoint_seconds:
            yield from self._save()
        if now - self.last_progress > PROGRESS_SECONDS:
            self.last_progress = now
            for member, journal in self._going_on():
                yield member.slot, journal.progress()

    def _save(self) -> Told:
        """A checkpoint of every run, all of the same step."""
        self.requests.save = False
        for member, journal in self._going_on():
            try:
                yield member.slot, journal.save(member.counters.evaluation_slots == EVALUATE_FIRST)
            except NonFiniteError as error:
                yield self._fail(member, error)
        self.last_save = time.monotonic()

    def _stop(self) -> Told:
        yield from self._save()
        for member in self.batch.active:
            yield member.slot, Interrupted(member.counters.steps)
