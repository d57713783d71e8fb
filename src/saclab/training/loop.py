"""The training loop, a generator of events. It does not print, does not handle signals, knows no command line."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path

from saclab.algorithm.types import Metrics
from saclab.config import Config
from saclab.environments.vector import EndedEpisode
from saclab.errors import NonFiniteError, TrainingFailed, UserError
from saclab.files import write_json
from saclab.trained_policy import save_policy
from saclab.training.captured import part, plain_numbers
from saclab.training.checkpoint import CheckpointError, load_newest_checkpoint, newest_first, save_checkpoint
from saclab.training.events import (
    EpisodeEnded,
    Evaluated,
    Event,
    Finished,
    Interrupted,
    Progress,
    Saved,
    Started,
    UpdatesLogged,
    Warned,
)
from saclab.training.failure import write_failure
from saclab.training.lock import locked
from saclab.training.machine import different_facts, machine_facts
from saclab.training.process import prepare_process
from saclab.training.requests import Requests
from saclab.training.run import Run, Stopped
from saclab.training.run_folder import FORMAT, Logs, append_line, is_finished, read_config

PROGRESS_SECONDS = 0.25
SANE_TEMPERATURES = (1e-5, 100.0)
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


def what_is_left(folder: Path, run: Run, error: NonFiniteError) -> str:
    """Where to look after a number that is not finite."""
    try:
        left = f"What led to it lies in {write_failure(folder, run, error)}"
    except OSError as problem:
        left = f"What led to it could not be written to {folder} ({problem.strerror})"
    kept = newest_first(folder / "checkpoints")
    return left + (f"; the last checkpoint, {kept[0].name}, is kept" if kept else "")


class Session:
    """One process's work on a run: the run, its logs and its clocks."""

    def __init__(self, run: Run, folder: Path, requests: Requests, checkpoint_minutes: float) -> None:
        self.run, self.folder, self.requests = run, folder, requests
        config = run.config
        self.checkpoint_seconds = 60 * checkpoint_minutes
        self.notes = [ratio_note(config)]
        self.warned_of_temperature = False
        new = not (folder / "config.json").exists()
        if not new:
            require_same_config(folder, config)
        if new:
            write_json(folder / "config.json", {"format": FORMAT, "config": config.to_dict(), **machine_facts()})
        positions = None if new else self._restore()
        self.resumed_at_step = self.run.counters.steps
        self.logs = Logs(folder, config.training.evaluation_episodes, positions)
        self._record_session()
        self.seconds_before = self.run.counters.seconds
        self.started = self.last_progress = self.last_save = time.monotonic()

    def events(self) -> Iterator[Event]:
        run = self.run
        yield Started(self.folder, self.resumed_at_step, tuple(self.notes))
        while True:
            if run.evaluation_due():
                try:
                    yield self._evaluate()
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
            if self.requests.save or now - self.last_save > self.checkpoint_seconds:
                yield self._save()
            if now - self.last_progress > PROGRESS_SECONDS:
                self.last_progress = now
                yield self._progress()
            for episode in run.step():
                yield from self._log_episode(episode)
            yield from self._log_updates()
        yield from self._finish(reason)

    def close(self) -> None:
        """Close the logs; what is still unwritten on a full disk belongs to steps after the last checkpoint."""
        with suppress(OSError):
            self.logs.close()

    def _seconds(self) -> float:
        """Wall-clock time of the run, earlier sessions counted in."""
        return round(self.seconds_before + time.monotonic() - self.started, 3)

    def _progress(self) -> Progress:
        counters = self.run.counters
        return Progress(counters.steps, counters.updates, counters.episodes, self.run.fraction_done(), self._seconds())

    def _log_episode(self, episode: EndedEpisode) -> Iterator[Event]:
        run, counters = self.run, self.run.counters
        number = run.count_episode(episode)
        average = counters.running_average if number else episode.total_reward
        assert average is not None
        self.logs.episode(
            number, counters.steps, counters.updates, episode.total_reward, average, episode.length,
            int(episode.terminated), self._seconds(),
        )  # fmt: skip
        if number:
            yield EpisodeEnded(number, counters.steps, counters.updates, episode.total_reward, average, episode.length)

    def _log_updates(self, last: bool = False) -> Iterator[Event]:
        """One line for each full window of updates; for what there is, if it is the last."""
        run, counters = self.run, self.run.counters
        full = len(run.window) >= run.config.training.log_interval
        if not (full or (last and run.window)):
            return
        values = run.window_array().mean(axis=0, dtype="float64")
        run.window = []
        means = dict(zip(Metrics._fields, values.tolist(), strict=True))
        self.logs.metrics({"updates": counters.updates, "steps": counters.steps, **means, "seconds": self._seconds()})
        yield UpdatesLogged(counters.steps, counters.updates, means)
        yield from self._watch_temperature(means["temperature"])

    def _watch_temperature(self, temperature: float) -> Iterator[Event]:
        """Warn once of a learned temperature that explodes or collapses."""
        low, high = SANE_TEMPERATURES
        if self.warned_of_temperature or self.run.config.algorithm.temperature == "fixed" or low < temperature < high:
            return
        self.warned_of_temperature = True
        advice = (
            "the policy cannot reach the target entropy: lower --target-entropy"
            if temperature >= high
            else "the policy stays above the target entropy without any bonus: raise --target-entropy"
        )
        yield Warned(
            f"the temperature is {temperature:.3g}, outside {low:g} to {high:g}: {advice}, or lower "
            "--temperature-learning-rate, or scale the environment's rewards"
        )

    def _evaluate(self) -> Evaluated:
        run, counters = self.run, self.run.counters
        episodes, best = run.evaluate(lambda: self.requests.stop != 0)
        self.logs.evaluation(
            counters.evaluations, counters.steps, counters.updates, counters.episodes, counters.last_return,
            *episodes.total_rewards.tolist(), *episodes.lengths.tolist(), self._seconds(),
        )  # fmt: skip
        if (bias := run.q_bias()) is not None:
            self.logs.q_bias(
                counters.evaluations, counters.steps, counters.updates, counters.episodes, *bias, self._seconds()
            )
        if best:
            self._write_best()
        return Evaluated(
            counters.evaluations, counters.steps, counters.updates, counters.episodes, episodes.total_rewards, best
        )

    def _write_best(self) -> None:
        run = self.run
        if run.best_actor is not None:
            facts = {"mean_return": run.counters.best_return, "episode": run.counters.best_at_episode}
            save_policy(self.folder / "best", run.config, run.spec, run.best_actor, facts)

    def _stop(self, untested: bool = False) -> Iterator[Event]:
        yield self._save(untested)
        yield Interrupted(self.run.counters.steps)

    def _save(self, untested: bool = False) -> Saved:
        self.requests.save = False
        began = time.monotonic()
        self.run.counters.seconds = self._seconds()
        checkpoint = self.run.capture()
        checkpoint.state["logs"] = self.logs.positions()
        checkpoint.state["facts"] = machine_facts()
        path = save_checkpoint(
            self.folder / "checkpoints", self.run.counters.steps, checkpoint, self.run.replay, untested
        )
        self.last_save = time.monotonic()
        return Saved(path, self.last_save - began)

    def _restore(self) -> dict[str, int] | None:
        """Continue from the newest checkpoint that is whole; the lengths of the logs at that time."""
        checkpoints = self.folder / "checkpoints"
        checkpoint = load_newest_checkpoint(checkpoints, self.run.replay, self.notes.append)
        if checkpoint is None:
            return None
        try:
            restarted = self.run.restore(checkpoint)
            positions = plain_numbers(part(checkpoint.state, "logs", dict), dict.fromkeys(checkpoint.state["logs"], 0))
        except CheckpointError as error:
            raise CheckpointError(
                f"cannot continue {self.folder}: {error}. If a checkpoint does not belong to this run or has been "
                f"changed, remove {checkpoints} to train from the start"
            ) from error
        if restarted:
            self.notes.append(
                f"the exact state of {self.run.config.environment} cannot be captured: environments {restarted} "
                "started a new episode, so this run is not bit for bit what it would have been"
            )
        self.notes += different_facts(checkpoint.state.get("facts"))
        self._write_best()
        return positions

    def _record_session(self) -> None:
        """One line per session in sessions.jsonl: where it began, on what, and what was noted."""
        entry = {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "from_step": self.resumed_at_step,
            "process": os.getpid(),
            "notes": self.notes[1:],
            **machine_facts(),
        }
        append_line(self.folder / "sessions.jsonl", entry)

    def _finish(self, reason: str) -> Iterator[Event]:
        counters = self.run.counters
        yield from self._log_updates(last=True)
        if counters.evaluated_at_update != counters.updates:
            try:
                yield self._evaluate()
            except Stopped:
                yield from self._stop(untested=True)
                return
        counters.seconds = self._seconds()
        yield self._save()
        assert counters.best_return is not None
        assert counters.last_return is not None
        result = {
            "reason": reason,
            "steps": counters.steps,
            "updates": counters.updates,
            "episodes": counters.episodes,
            "best_return": counters.best_return,
            "final_return": counters.last_return,
            "seconds": counters.seconds,
        }
        write_json(self.folder / "result.json", result)
        yield self._progress()
        yield Finished(
            reason, counters.steps, counters.updates, counters.episodes, counters.best_return, counters.last_return
        )


def ratio_note(config: Config) -> str:
    training = config.training
    note = (
        f"{training.updates_per_interval} update(s) per {training.update_interval} environment step(s): "
        f"update-to-data ratio {training.update_to_data_ratio:g}"
    )
    if training.parallel_environments > 1:
        each = training.parallel_environments * training.update_to_data_ratio
        note += (
            f", kept with {training.parallel_environments} environments: {each:g} update(s) on average "
            "each time all of them have been stepped"
        )
    return note


def require_same_config(folder: Path, config: Config) -> None:
    """Refuse a folder that holds a run with other settings."""
    differences = read_config(folder).differences(config)
    if differences:
        listed = "; ".join(f"{name} is {there!r} there, {here!r} here" for name, (there, here) in differences.items())
        raise UserError(
            f"{folder} already holds a run with other settings ({listed}): give this one a name of its own with "
            "--name, or another place with --runs"
        )
