"""A process that steps some environments of a run group and plays evaluation episodes; it makes no call into JAX.

It gets its task as a message on standard input, then single bytes (STEP) and messages (MESSAGE before each), and
answers each on what was its standard output. It ends when its input does.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import Any, NamedTuple

import msgspec
import numpy as np

from saclab.algorithm.learner import Learner
from saclab.batch.frames import Arrays, Message, receive, send
from saclab.batch.shared_buffers import SharedBuffers, Sizes
from saclab.config import Config
from saclab.environments.foreign import prints_apart
from saclab.environments.vector import TrainingEnvironments
from saclab.environments.watch import log
from saclab.errors import NonFiniteError, RunBroken, UserError, in_words, traceback_of
from saclab.replay import RowLayout
from saclab.signals import die_with
from saclab.training.captured import join_arrays, split_arrays
from saclab.training.evaluation import Evaluator
from saclab.training.learners import learner_of
from saclab.training.q_bias import critics_of, q_bias_at
from saclab.training.requests import Stopped
from saclab.training.saved_state import EnvironmentState

STEP, MESSAGE, DONE = b"s", b"m", b"."


class Share(NamedTuple):
    """The environments of one run that belong to this process."""

    run: int
    rows: slice
    """Their places in the shared buffers."""
    environments: TrainingEnvironments


class EnvironmentWorker:
    def __init__(self, task: dict[str, Any]) -> None:
        """Make the environments and start their first episodes."""
        self.layout = RowLayout(**task["layout"])
        self.buffers = SharedBuffers(Sizes(task["runs"], task["environments"], self.layout), task["buffers"])
        self.configs = {int(run): Config.from_dict(config) for run, config in task["configs"].items()}
        self.shares = []
        for share in task["shares"]:
            config = self.configs[share["run"]]
            environments = TrainingEnvironments(
                config.environment, config.environment_arguments, share["seeds"], config.algorithm.terms_of_reward,
                config.training.wrappers,
            )  # fmt: skip
            rows = slice(share["first"], share["first"] + len(share["seeds"]))
            self.shares.append(Share(share["run"], rows, environments))
            self.buffers.observation[rows] = environments.observation
        any_config = next(iter(self.configs.values()))
        self.evaluator = Evaluator(
            any_config.environment, any_config.environment_arguments, any_config.training.wrappers,
            any_config.algorithm.terms_of_reward,
        )  # fmt: skip

    def step(self) -> Message:
        """Step every active environment once; what went wrong in which run, and the numbers that belong to it."""
        failures: dict[str, Any] = {}
        arrays: Arrays = {}
        for share in self.shares:
            if not self.buffers.active[share.run]:
                continue
            try:
                self._step(share)
            except Exception as error:  # the environment is anybody's code: what it raises ends no other run
                failures[str(share.run)] = described(error)
                if isinstance(error, NonFiniteError):
                    arrays |= {f"{share.run}.{name}": array for name, array in error.arrays.items()}
        return failures, arrays

    def _step(self, share: Share) -> None:
        buffers, rows = self.buffers, share.rows
        transitions, ended = share.environments.step(buffers.action[rows])
        buffers.row[rows] = self.layout.pack(transitions)
        buffers.observation[rows] = share.environments.observation
        buffers.ended[rows] = False
        for episode in ended:
            place = rows.start + episode.environment
            buffers.ended[place], buffers.terminated[place] = True, episode.terminated
            buffers.total_reward[place], buffers.length[place] = episode.total_reward, episode.length

    def answer(self, header: dict[str, Any], arrays: Arrays) -> Message:
        """The answer to a message."""
        match header["do"]:
            case "evaluate":
                return self.evaluate(header["run"], header["seeds"], arrays["actor"])
            case "q_bias":
                return self.q_bias(header, arrays)
            case "capture":
                return self.capture(header["run"])
            case "restore":
                return self.restore(header, arrays)
        raise ValueError(header["do"])

    def evaluate(self, run: int, episode_seeds: list[int], actor: np.ndarray) -> Message:
        """One episode of the deterministic policy per seed."""
        policy = self._learner(run).policy

        def act(observation: np.ndarray) -> np.ndarray:
            if self.buffers.stop[0]:
                raise Stopped
            action: np.ndarray = policy.mode(actor, observation)
            return action

        try:
            episodes = self.evaluator.run(act, episode_seeds)
        except Stopped:
            return {"stopped": True}, {}
        except Exception as error:
            return {"failure": described(error)}, {}
        return {}, episodes._asdict()

    def q_bias(self, header: dict[str, Any], arrays: Arrays) -> Message:
        """How far one run's critics are from Monte-Carlo soft returns."""
        config, learner = self.configs[header["run"]], self._learner(header["run"])
        critics = critics_of(
            config, learner, arrays["actor"], arrays["critic"], arrays["log_alpha"], header["reward_scale"],
            header["reward_weights"],
        )  # fmt: skip
        try:
            environment, stop = self.evaluator.environments[0], self.buffers.stop
            bias = q_bias_at(config, critics, environment, header["evaluation"], lambda: bool(stop[0]))
        except Stopped:
            return {"stopped": True}, {}
        except Exception as error:
            return {"failure": described(error)}, {}
        return {"bias": list(bias)}, {}

    def capture(self, run: int) -> Message:
        """The exact states of one run's environments."""
        try:
            captured, rest = split_arrays(self._share(run).environments.capture())
        except Exception as error:
            return {"failure": described(error)}, {}
        return {"rest": msgspec.to_builtins(rest)}, captured

    def restore(self, header: dict[str, Any], arrays: Arrays) -> Message:
        """Continue the episodes; which environments started anew instead, or why the states do not fit."""
        share = self._share(header["run"])
        try:
            rest = msgspec.convert(header["rest"], list[EnvironmentState | None])
            states = join_arrays(arrays, rest, share.environments.observation)
            restarted = share.environments.restore(states, header["seeds"])
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            return {"misfit": str(error)}, {}
        except RunBroken as error:
            return {"failure": described(error)}, {}
        self.buffers.observation[share.rows] = share.environments.observation
        return {"restarted": restarted}, {}

    def close(self) -> None:
        """Close the environments; what goes wrong then harms no result."""
        for share in self.shares:
            share.environments.close()
        self.evaluator.close()

    def _share(self, run: int) -> Share:
        return next(share for share in self.shares if share.run == run)

    def _learner(self, run: int) -> Learner:
        return learner_of(self.configs[run].algorithm, self.layout)


def described(error: Exception) -> dict[str, str]:
    """What the engine is told of an error in a run's environment."""
    if isinstance(error, NonFiniteError):
        return {"not_finite": str(error)}
    known = isinstance(error, RunBroken | UserError)
    return {
        "broken": str(error) if known else in_words(error),
        "traceback": error.traceback if isinstance(error, RunBroken) else traceback_of(error),
    }


def main() -> None:
    """Answer until the input ends."""
    with prints_apart() as answers:
        answer_all(os.dup(0), answers)


def answer_all(commands: int, answers: int) -> None:
    task = receive(commands)[0]
    die_with(task["engine"])
    log.addHandler(logging.StreamHandler(os.fdopen(task["warnings"], "w")))
    try:
        worker = EnvironmentWorker(task)
    except UserError as error:
        send(answers, {"user_error": str(error), "traceback": error.traceback})
        return
    except RunBroken as error:
        send(answers, {"failure": described(error)})
        return
    send(answers, {})
    while command := os.read(commands, 1):
        if command == STEP:
            failures, arrays = worker.step()
            os.write(answers, MESSAGE if failures else DONE)
            if failures:
                send(answers, failures, arrays)
        else:
            send(answers, *worker.answer(*receive(commands)))
    worker.close()


if __name__ == "__main__":
    try:
        main()
    except (EOFError, BrokenPipeError):
        sys.exit(0)  # the engine is gone
