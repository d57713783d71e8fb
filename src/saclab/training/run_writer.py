"""What a process writes into a run's folder as the run goes on: logs, best policy, checkpoints, the result."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from saclab.environments.make import EnvironmentSpec
from saclab.environments.vector import EndedEpisode
from saclab.files import write_json
from saclab.records import FileRecord, Result, file_record, read_bytes
from saclab.trained_policy import load_policy, save_policy
from saclab.training.checkpoint import save_checkpoint
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.events import EpisodeEnded, Evaluated, Event, Finished, Progress, Saved, UpdatesLogged, Warned
from saclab.training.logs import Logs
from saclab.training.q_bias import QBias, nothing_known
from saclab.training.run_folder import append_line
from saclab.training.snapshot import EnvironmentStates, Snapshot, to_checkpoint
from saclab.training.starts import Beginning
from saclab.training.symptoms import SYMPTOMS


class RunWriter:
    """One session of one run, on whose folder the process has the lock."""

    def __init__(self, beginning: Beginning, spec: EnvironmentSpec, folder: Path, facts: dict[str, Any]) -> None:
        """Open the logs, cut back to the checkpoint, and enter this session.

        Args:
            beginning: the run, and where it goes on; the engine is built from the same one.
            spec: of its environment.
            folder: the run folder.
            facts: what may decide the result's last bits, from `machine_facts`.

        Raises:
            Damaged: if a log does not begin with what the checkpoint has recorded of it.
        """
        self.run, self.notes = beginning.start.run, beginning.notes
        self.spec, self.folder, self.facts = spec, folder, facts
        self.warned_of = set[str]()
        self.policy_was_read = False
        self.resumed_at_step = self.run.counters.steps
        self._write_best()
        config = self.run.config
        self.logs = Logs(folder, config.training.evaluation_episodes, beginning.logs, config.algorithm.terms_of_reward)
        self.config_file = file_record(read_bytes(folder / "config.json"))
        self._record_session()
        self.seconds_before, self.started = self.run.counters.seconds, time.monotonic()

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
        updates = counters.updates + run.updates_left  # after its last step's round, of which some may be left to make
        self.logs.episode(
            number, counters.steps, updates, episode.total_reward, average, episode.length, int(episode.terminated),
            self._seconds(),
        )  # fmt: skip
        if number:
            yield EpisodeEnded(number, counters.steps, updates, episode.total_reward, average, episode.length)

    def log_updates(self) -> Iterator[Event]:
        """One line for the window of updates, whose metrics have been delivered; a new window begins.

        Raises:
            NonFiniteError: if one of them is not finite.
        """
        counters = self.run.counters
        values = self.run.close_window().mean(axis=0, dtype="float64")
        means = dict(zip(self.run.metrics, values.tolist(), strict=True))
        self.logs.metrics({"updates": counters.updates, "steps": counters.steps, **means, "seconds": self._seconds()})
        yield UpdatesLogged(counters.steps, counters.updates, means)
        for name, look in SYMPTOMS.items():
            yield from self._warn_once(name, look(self.run.config.algorithm, means))

    def _warn_once(self, name: str, message: str) -> Iterator[Event]:
        """Say a message, if there is one, unless something of this name has been said in this session."""
        if message and name not in self.warned_of:
            self.warned_of.add(name)
            yield Warned(message)

    def log_evaluation(self, episodes: EvaluationEpisodes, best: bool, bias: QBias | None) -> Iterator[Event]:
        """Log an evaluation that the run has taken in, and beside it the terms of its return and the critics' bias."""
        counters = self.run.counters
        counted = counters.evaluations, counters.steps, counters.updates, counters.episodes
        returns, lengths = episodes.total_rewards.tolist(), episodes.lengths.tolist()
        self.logs.evaluation(*counted, counters.last_return, *returns, *lengths, self._seconds())
        if self.run.config.algorithm.terms_of_reward:
            *weights, _ = self.run.reward_weights()
            returns = episodes.term_returns.mean(axis=0).tolist()
            self.logs.reward_terms(*counted, *returns, *weights, self._seconds())
        if bias is not None:
            self.logs.q_bias(*counted, *bias, self._seconds())
        if best:
            self._write_best()
        yield Evaluated(*counted, episodes.total_rewards, best)
        if bias is not None and bias.pairs == 0:
            yield from self._warn_once("Q bias", nothing_known(self.run.config.algorithm.discount))

    def _write_best(self) -> None:
        run = self.run
        if run.best_actor is not None:
            facts = {"mean_return": run.counters.best_return, "episode": run.counters.best_at_episode}
            save_policy(self.folder / "best", run.config, self.spec, run.best_actor, facts)
            if not self.policy_was_read:
                load_policy(self.folder / "best")  # what could not be read at the end must not be trained for hours
                self.policy_was_read = True

    def save(self, snapshot: Snapshot, environments: EnvironmentStates) -> Saved:
        """Write a checkpoint.

        Raises:
            NonFiniteError: if the run is not worth continuing.
        """
        began, counters = time.monotonic(), self.run.counters
        counters.seconds = self._seconds()
        checkpoint = to_checkpoint(snapshot, environments, self._files(), self.facts)
        path = save_checkpoint(self.folder / "checkpoints", self.run.moment(), checkpoint, snapshot.replay)
        return Saved(path, time.monotonic() - began)

    def _files(self) -> dict[str, FileRecord]:
        """What the logs and config.json are now, so that later damage is seen."""
        return {"config.json": self.config_file, **self.logs.records()}

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
        """Write the result of the run, whose last updates are logged, whose policy is evaluated, and which is saved."""
        counters = self.run.counters
        assert counters.best_return is not None
        assert counters.last_return is not None
        result = Result(
            reason, counters.steps, counters.updates, counters.episodes, counters.best_return, counters.last_return,
            counters.seconds, self._files(),
        )  # fmt: skip
        write_json(self.folder / "result.json", result)
        yield self.progress()
        yield Finished(
            reason, counters.steps, counters.updates, counters.episodes, counters.best_return, counters.last_return
        )
