"""What one process writes into a run's folder as the run goes on: logs, tests, best policy, checkpoints, the result."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from saclab.config import Config
from saclab.environments.vector import EndedEpisode
from saclab.errors import RunBroken, UserError
from saclab.files import write_json
from saclab.machine import different_facts
from saclab.trained_policy import save_policy
from saclab.training.captured import part, plain_numbers
from saclab.training.checkpoint import FORMAT as CHECKPOINT_FORMAT
from saclab.training.checkpoint import Checkpoint, CheckpointError, newest_first, save_checkpoint
from saclab.training.course import Course
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.events import EpisodeEnded, Evaluated, Event, Finished, Progress, Saved, UpdatesLogged, Warned
from saclab.training.failure import write_failure
from saclab.training.q_bias import QBias
from saclab.training.run_folder import FORMAT, Logs, append_line, read_config

SANE_TEMPERATURES = (1e-5, 100.0)


class Journal:
    """Of one session of one run, on whose folder the process has the lock."""

    def __init__(self, run: Course, folder: Path, facts: dict[str, Any]) -> None:
        """Begin or find the folder; `restore` may follow, then `open`.

        Args:
            run: what is written about.
            folder: the run folder.
            facts: what may decide the result's last bits, from `machine_facts`.

        Raises:
            UserError: if the folder holds a run with other settings.
        """
        self.run, self.folder = run, folder
        self.facts = facts
        self.notes = [ratio_note(run.config)]
        self.warned_of_temperature = False
        self.positions: dict[str, int] | None = None
        self.begun_before = (folder / "config.json").exists()
        if self.begun_before:
            require_same_config(folder, run.config)
        else:
            write_json(folder / "config.json", {"format": FORMAT, "config": run.config.to_dict(), **self.facts})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue the run from a checkpoint of this folder, whose transitions are in the replay buffer.

        Raises:
            CheckpointError: if it is not one of this run.
        """
        try:
            restarted = self.run.restore(checkpoint)
            lengths = part(checkpoint.state, "logs", dict)
            self.positions = plain_numbers(lengths, dict.fromkeys(lengths, 0))
        except CheckpointError as error:
            raise CheckpointError(
                f"cannot continue {self.folder}: {error}. If a checkpoint does not belong to this run or has been "
                f"changed, remove {self.folder / 'checkpoints'} to train from the start"
            ) from error
        if restarted:
            self.notes.append(
                f"the exact state of {self.run.config.environment} cannot be captured: environments {restarted} "
                "started a new episode, so this run is not bit for bit what it would have been"
            )
        if checkpoint.format != CHECKPOINT_FORMAT:
            self.notes.append(
                f"the checkpoint has format {checkpoint.format}, of an earlier saclab: from here on the results differ "
                "in the last bits from what they would have been"
            )
        self.notes += different_facts(checkpoint.state.get("facts"), self.facts)
        self._write_best()

    def open(self) -> None:
        """Open the logs, cut back to the checkpoint, and enter this session."""
        self.resumed_at_step = self.run.counters.steps
        self.logs = Logs(self.folder, self.run.config.training.evaluation_episodes, self.positions)
        self._record_session()
        self.seconds_before = self.run.counters.seconds
        self.started = self.last_save = time.monotonic()

    def close(self) -> None:
        """Close the logs; what is still unwritten on a full disk belongs to steps after the last checkpoint."""
        with suppress(OSError):
            self.logs.close()

    def _seconds(self) -> float:
        """Wall-clock time of the run, earlier sessions counted in."""
        return round(self.seconds_before + time.monotonic() - self.started, 3)

    def progress(self) -> Progress:
        counters = self.run.counters
        return Progress(counters.steps, counters.updates, counters.episodes, self.run.fraction_done(), self._seconds())

    def log_episode(self, episode: EndedEpisode) -> Iterator[Event]:
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

    def log_updates(self, last: bool = False) -> Iterator[Event]:
        """One line for each full window of updates; for what there is, if it is the last."""
        run, counters = self.run, self.run.counters
        full = run.window_size >= run.config.training.log_interval
        if not (full or (last and run.window_size)):
            return
        values = run.window_array().mean(axis=0, dtype="float64")
        run.window = []
        means = dict(zip(run.metrics, values.tolist(), strict=True))
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

    def log_test(self, episodes: EvaluationEpisodes, best: bool, bias: QBias | None) -> Evaluated:
        """Enter a test that the run has taken in already, with the critics' bias after it where that is measured."""
        counters = self.run.counters
        self.logs.evaluation(
            counters.evaluations, counters.steps, counters.updates, counters.episodes, counters.last_return,
            *episodes.total_rewards.tolist(), *episodes.lengths.tolist(), self._seconds(),
        )  # fmt: skip
        if bias is not None:
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

    def save(self, untested: bool = False) -> Saved:
        """Write a checkpoint; `untested` if a test of the policy comes first when it is continued."""
        began = time.monotonic()
        self.run.counters.seconds = self._seconds()
        checkpoint = self.run.capture()
        checkpoint.state["logs"] = self.logs.positions()
        checkpoint.state["facts"] = self.facts
        path = save_checkpoint(
            self.folder / "checkpoints", self.run.counters.steps, checkpoint, self.run.replay, untested
        )
        self.last_save = time.monotonic()
        return Saved(path, self.last_save - began)

    def _record_session(self) -> None:
        """One line per session in sessions.jsonl: where it began, on what, and what was noted."""
        entry = {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "from_step": self.resumed_at_step,
            "process": os.getpid(),
            "notes": self.notes[1:],
            **self.facts,
        }
        append_line(self.folder / "sessions.jsonl", entry)

    def finish(self, reason: str) -> Iterator[Event]:
        """Save the run, whose last updates are logged and whose policy is tested, and write its result."""
        counters = self.run.counters
        counters.seconds = self._seconds()
        yield self.save()
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
        yield self.progress()
        yield Finished(
            reason, counters.steps, counters.updates, counters.episodes, counters.best_return, counters.last_return
        )


def what_is_left(folder: Path, run: Course, error: RunBroken) -> str:
    """Where to look after a run's bad end."""
    try:
        left = f"What led to it lies in {write_failure(folder, run, error)}"
    except OSError as problem:
        left = f"What led to it could not be written to {folder} ({problem.strerror})"
    kept = newest_first(folder / "checkpoints")
    return left + (f"; the last checkpoint, {kept[0].name}, is kept" if kept else "")


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
