"""The processes that step the environments of a run group, from the engine's side."""

from __future__ import annotations

import os
import selectors
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import msgspec
import numpy as np

from saclab.batch import frames
from saclab.batch.frames import Arrays, Message
from saclab.batch.shared_buffers import SharedBuffers, Sizes
from saclab.batch.worker import DONE, MESSAGE, STEP
from saclab.config import Config
from saclab.environments.make import EnvironmentSpec
from saclab.environments.vector import EndedEpisode
from saclab.environments.watch import log
from saclab.errors import NonFiniteError, RunBroken, TrainingFailed, UserError
from saclab.replay import layout_of
from saclab.signals import end_of, how_it_ended
from saclab.training import seeds
from saclab.training.captured import join_arrays, split_arrays
from saclab.training.engine import EnvironmentStateError
from saclab.training.requests import Stopped
from saclab.training.saved_state import EnvironmentState

POLL_SECONDS = 0.1
SECONDS_TO_CLOSE = 3.0  # all environments of a group


class EnvironmentWorkerDied(TrainingFailed):
    """A process that steps environments ended by itself."""


class EnvironmentPool:
    """Environments of all runs, spread evenly over processes; each run's seeds are those that it has alone."""

    def __init__(self, configs: Sequence[Config], spec: EnvironmentSpec, workers: int) -> None:
        """Start the processes and their environments' first episodes.

        Raises:
            UserError: if an environment cannot be made.
        """
        self.environments = configs[0].training.parallel_environments
        self.spec = spec
        self.buffers = SharedBuffers(Sizes(len(configs), self.environments, layout_of(spec, configs[0].algorithm)))
        self.buffers.active[:] = True
        self.workers: list[PoolWorker] = []
        try:
            parts = [part for part in np.array_split(np.arange(len(self.buffers.row)), workers) if len(part)]
            for part in parts:  # all of them start before the first is waited for
                self.workers.append(PoolWorker(self.buffers, part // self.environments))
            for worker, part in zip(self.workers, parts, strict=True):
                worker.make_environments(configs, int(part[0]), self.buffers)
            for worker in self.workers:
                reply, _ = worker.receive()
                if "user_error" in reply:
                    refused = UserError(reply["user_error"])
                    refused.traceback = reply["traceback"]
                    raise refused
                require_whole(reply)
        except BaseException:
            self.close()
            raise

    def step(self, action: np.ndarray) -> dict[int, RunBroken]:
        """Apply f32[N, A] in [-1, 1] in every active run; run -> what ended it.

        The transitions, observations and ended episodes are in the shared buffers then.

        Raises:
            EnvironmentWorkerDied: if a process is gone.
        """
        self.buffers.action[:] = action
        for worker in self.workers:
            worker.command(STEP)
        failures: dict[int, RunBroken] = {}
        for worker in self.workers:
            failures |= worker.step_failures()
        return failures

    def ended(self, run: int) -> list[EndedEpisode]:
        """The episodes of a run that ended in the last step."""
        buffers, first = self.buffers, run * self.environments
        return [
            EndedEpisode(index, float(buffers.total_reward[place]), int(buffers.length[place]),
                         bool(buffers.terminated[place]))
            for index, place in enumerate(range(first, first + self.environments)) if buffers.ended[place]
        ]  # fmt: skip

    def drop(self, run: int) -> None:
        """Step a run no more."""
        self.buffers.active[run] = False
        self.buffers.ended[self._places(run)] = False

    def observation(self, run: int) -> np.ndarray:
        """f32[E, O]."""
        current: np.ndarray = self.buffers.observation[self._places(run)].copy()
        return current

    def work_off(self, jobs: Sequence[Message], should_stop: Callable[[], bool]) -> list[Message]:
        """The workers' replies to these messages, each of which goes to whoever is free.

        Raises:
            Stopped: when `should_stop`; what the jobs have done so far counts for nothing.
            EnvironmentWorkerDied: if a process is gone.
        """
        replies: dict[int, Message] = {}
        waiting = list(enumerate(jobs))
        busy: dict[PoolWorker, int] = {}
        self.buffers.stop[0] = False
        with selectors.DefaultSelector() as selector:
            for worker in self.workers:
                selector.register(worker.answers, selectors.EVENT_READ, worker)
            while waiting or busy:
                for worker in self.workers:
                    if waiting and worker not in busy:
                        busy[worker], (header, arrays) = waiting.pop(0)
                        worker.send(header, arrays)
                for key, _ in selector.select(POLL_SECONDS):
                    replies[busy.pop(key.data)] = key.data.receive()
                if should_stop():
                    self.buffers.stop[0] = True
                    waiting = []
        if self.buffers.stop[0] or any("stopped" in header for header, _ in replies.values()):
            raise Stopped
        return [replies[index] for index in range(len(jobs))]

    def capture(self, run: int) -> list[dict[str, Any] | None]:
        """What `TrainingEnvironments.capture` gives of a run's environments."""
        states: list[dict[str, Any] | None] = []
        for worker in self._owners(run):
            worker.send({"do": "capture", "run": run}, {})
            reply, arrays = worker.receive()
            require_whole(reply)
            rest = msgspec.convert(reply["rest"], list[EnvironmentState | None])
            states += join_arrays(arrays, rest, self._example(len(rest)))
        return states

    def restore(self, run: int, states: list[dict[str, Any] | None], new_seeds: list[int]) -> list[int]:
        """Continue a run's episodes, as `TrainingEnvironments.restore` does.

        Raises:
            EnvironmentStateError: for states that do not fit.
        """
        restarted: list[int] = []
        first = 0
        for worker in self._owners(run):
            part = slice(first, first + worker.count(run))
            arrays, rest = split_arrays(states[part])
            worker.send(
                {"do": "restore", "run": run, "rest": msgspec.to_builtins(rest), "seeds": new_seeds[part]}, arrays
            )
            reply, _ = worker.receive()
            if "misfit" in reply:
                raise EnvironmentStateError(run, reply["misfit"])
            require_whole(reply)
            restarted += [first + index for index in reply["restarted"]]
            first = part.stop
        return restarted

    def close(self) -> None:
        """End the processes, which close their environments."""
        for worker in self.workers:
            worker.hang_up()
        deadline = time.monotonic() + SECONDS_TO_CLOSE
        for worker in self.workers:
            worker.end(deadline)
        self.buffers.close()

    def _owners(self, run: int) -> list[PoolWorker]:
        return [worker for worker in self.workers if worker.count(run)]

    def _places(self, run: int) -> slice:
        return slice(run * self.environments, (run + 1) * self.environments)

    def _example(self, environments: int) -> np.ndarray:
        return np.zeros((environments, self.spec.observation_size), np.float32)


class PoolWorker:
    """One of the processes, with the pipes to it."""

    def __init__(self, buffers: SharedBuffers, runs: np.ndarray) -> None:
        """Start it.

        Args:
            buffers: the shared memory.
            runs: i64[n], ascending: the run of each of its environments.
        """
        self.runs = runs
        self.errors = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115 - open as long as the process
        told, self.warnings = os.pipe()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "saclab.batch.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env=os.environ | {"JAX_PLATFORMS": "cpu", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            pass_fds=[buffers.file_descriptor, self.warnings],
            start_new_session=True,
        )
        os.close(self.warnings)  # the process has it
        threading.Thread(target=pass_on_warnings, args=(told,), daemon=True).start()
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.commands, self.answers = self.process.stdin.fileno(), self.process.stdout.fileno()

    def make_environments(self, configs: Sequence[Config], first: int, buffers: SharedBuffers) -> None:
        """Tell it what to make, from place `first` of the shared buffers on; its first answer says if it could."""
        environments = configs[0].training.parallel_environments
        shares: list[dict[str, Any]] = []
        for run in dict.fromkeys(self.runs.tolist()):
            all_seeds = seeds.integers(configs[run].seed, "environments", environments)
            start = first - run * environments if not shares else 0
            own_seeds = all_seeds[start : start + self.count(run)]
            shares.append({"run": run, "first": run * environments + start, "seeds": own_seeds})
        task = {
            "engine": os.getpid(),
            "runs": buffers.sizes.runs,
            "environments": buffers.sizes.environments,
            "layout": buffers.sizes.layout._asdict(),
            "buffers": buffers.file_descriptor,
            "configs": {run: config.to_dict() for run, config in enumerate(configs)},
            "shares": shares,
            "warnings": self.warnings,
        }
        with self.alive():
            frames.send(self.commands, task)

    def count(self, run: int) -> int:
        """Environments of a run that it steps."""
        return int((self.runs == run).sum())

    def command(self, byte: bytes) -> None:
        with self.alive():
            os.write(self.commands, byte)

    def send(self, header: dict[str, Any], arrays: Arrays) -> None:
        self.command(MESSAGE)
        with self.alive():
            frames.send(self.commands, header, arrays)

    def receive(self) -> Message:
        with self.alive():
            return frames.receive(self.answers)

    def step_failures(self) -> dict[int, RunBroken]:
        """Wait for its step; run -> what ended it."""
        with self.alive():
            if (answer := os.read(self.answers, 1)) == DONE:
                return {}
            if not answer:
                raise EOFError
        failures, arrays = self.receive()
        return {
            int(run): error_of(entry, {name: arrays[name] for name in arrays if name.startswith(f"{run}.")})
            for run, entry in failures.items()
        }

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Turn a broken pipe into what is known of the process's end."""
        try:
            yield
        except (EOFError, BrokenPipeError) as error:
            code = self.process.wait()
            how = how_it_ended(code, end_of(self.errors))
            raise EnvironmentWorkerDied(
                f"the process that steps the environments of runs {sorted(set(self.runs.tolist()))} of the group ended "
                f"with {how}. Nothing that was saved is lost: start the same command again to continue the group from "
                "its last checkpoint"
            ) from error

    def hang_up(self) -> None:
        """Let it end by itself, once it has done what it is at."""
        with suppress(OSError):
            assert self.process.stdin is not None
            self.process.stdin.close()

    def end(self, deadline: float) -> None:
        """Wait for its end until a moment of the monotonic clock, and no longer."""
        try:
            self.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.errors.close()


def pass_on_warnings(told: int) -> None:
    """Log what a process says of its environments beside its answers, until it ends."""
    with os.fdopen(told, errors="replace") as lines:
        for line in lines:
            log.warning(line.rstrip("\n"), extra={"stalled": True})


def require_whole(reply: dict[str, Any]) -> None:
    """Raise the error that a worker has described in place of an answer."""
    if "failure" in reply:
        raise error_of(reply["failure"], {})


def error_of(entry: dict[str, str], arrays: Arrays) -> RunBroken:
    """The error that a worker has described."""
    if "not_finite" in entry:
        return NonFiniteError(entry["not_finite"], {name.partition(".")[2]: array for name, array in arrays.items()})
    return RunBroken(entry["broken"], arrays, entry["traceback"])
