"""Run the cells of a grid in local worker processes: one process per run, one core each by default."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import IO, Literal

from saclab.comparison.grid import Cell
from saclab.training.machine import usable_cores
from saclab.training.requests import Requests

Status = Literal["waiting", "running", "finished", "interrupted", "failed"]
POLL_SECONDS = 0.25
ERROR_LINES = 30  # of a crashed worker's standard error, kept for the message


@dataclass
class RunStatus:
    """What is known of a run of the grid while it goes on."""

    cell: Cell
    status: Status = "waiting"
    fraction: float = 0.0
    updates: int = 0
    episodes: int = 0
    updates_per_second: float = 0.0
    seconds_left: float | None = None
    test_return: float | None = None
    message: str = ""
    """Why it failed."""
    warnings: list[str] = field(default_factory=list)
    """What the run said of itself that the user should know."""
    first_progress: tuple[float, float, int] | None = field(default=None, repr=False)
    """Clock, fraction and updates when this session's first update had been made: compilation is not in the rate."""

    def enter(self, message: dict[str, object]) -> None:
        """Take in one line of the worker."""
        match message:
            case {"event": "progress", "fraction": float(fraction), "updates": int(updates), "episodes": int(episodes)}:
                self.fraction, self.updates, self.episodes = fraction, updates, episodes
                self._measure_rate(time.monotonic())
            case {"event": "evaluated", "mean_return": float(mean)}:
                self.test_return = mean
            case {"event": "warned", "message": str(text)}:
                self.warnings.append(text)
            case {"event": "finished"}:
                self.status, self.fraction = "finished", 1.0
            case {"event": "interrupted"}:
                self.status = "interrupted"
            case {"event": "failed", "message": str(text)}:
                self.status, self.message = "failed", text

    def _measure_rate(self, now: float) -> None:
        if self.first_progress is None:
            if self.updates > 0:
                self.first_progress = (now, self.fraction, self.updates)
            return
        began, fraction, updates = self.first_progress
        if now > began and self.fraction > fraction:
            self.updates_per_second = (self.updates - updates) / (now - began)
            self.seconds_left = (1 - self.fraction) * (now - began) / (self.fraction - fraction)


def launch(
    cells: Sequence[Cell], workers: int, threads: int, requests: Requests, checkpoint_minutes: float = 10
) -> Iterator[list[RunStatus]]:
    """Train every unfinished cell, `workers` at a time; yields all statuses several times a second.

    A failed run does not stop the others. When `requests.stop` is set, every worker saves its run and stops; at the
    end no worker is left behind, however this generator ends.
    """
    statuses = [RunStatus(cell, "finished", 1.0) if cell.finished else RunStatus(cell) for cell in cells]
    waiting = [status for status in statuses if status.status == "waiting"]
    running: dict[int, Worker] = {}
    free_cores = core_groups(workers, threads)
    stopping = False
    with selectors.DefaultSelector() as selector:
        try:
            while running or (waiting and not requests.stop):
                while waiting and len(running) < workers and not requests.stop:
                    worker = Worker(waiting.pop(0), threads, free_cores.pop(0), checkpoint_minutes)
                    running[worker.output.fileno()] = worker
                    selector.register(worker.output, selectors.EVENT_READ)
                if requests.stop and not stopping:
                    stopping = True
                    for worker in running.values():
                        worker.process.send_signal(signal.SIGTERM)
                for key, _ in selector.select(POLL_SECONDS):
                    worker = running[key.fd]
                    if not worker.read():
                        selector.unregister(worker.output)
                        del running[key.fd]
                        free_cores.append(worker.cores)
                        worker.ended(stopping)
                yield statuses
        finally:
            for worker in running.values():
                worker.process.terminate()
            for worker in running.values():
                worker.process.wait()
    yield statuses


class Worker:
    """A process that trains one run."""

    def __init__(self, status: RunStatus, threads: int, cores: list[int], checkpoint_minutes: float) -> None:
        """Start it, out of reach of the terminal's Ctrl-C: the launcher tells it when to stop."""
        self.status, self.cores = status, cores
        status.status = "running"
        folder = status.cell.folder
        folder.mkdir(parents=True, exist_ok=True)
        self.log = (folder / "worker.log").open("w+")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "saclab.comparison.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            env=os.environ | thread_limits(threads),
            start_new_session=True,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        task = {
            "config": status.cell.config.to_dict(),
            "folder": str(folder),
            "checkpoint_minutes": checkpoint_minutes,
            "cores": cores,
        }
        with suppress(BrokenPipeError):  # it is dead already: `ended` will say how
            self.process.stdin.write(json.dumps(task).encode())
            self.process.stdin.close()
        self.output: IO[bytes] = self.process.stdout
        self.unread = b""

    def read(self) -> bool:
        """Take in what the worker has written; False once it has closed its output."""
        content = os.read(self.output.fileno(), 65536)
        *lines, self.unread = (self.unread + content).split(b"\n")
        for line in lines:
            self.status.enter(json.loads(line))
        return bool(content)

    def ended(self, stopping: bool) -> None:
        """Note how the process ended; a worker that said nothing of its end has failed.

        One that was told to stop before it could listen, while it was still importing, has lost nothing.
        """
        code = self.process.wait()
        self.output.close()
        self.log.seek(0)
        last_lines = [line for line in self.log.read().splitlines() if line.strip()][-ERROR_LINES:]
        self.log.close()
        if self.status.status == "running":
            if code == 0:
                self.status.status, self.status.fraction = "finished", 1.0
                return
            if stopping and code == -signal.SIGTERM:
                self.status.status = "interrupted"
                return
            self.status.status = "failed"
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
            self.status.message = f"worker ended with {how}" + (f": {last_lines[-1]}" if last_lines else "")


def core_groups(workers: int, threads: int) -> list[list[int]]:
    """The cores that each worker keeps to; empty lists leave them to the system.

    Only workers that fill the machine are held to their cores: the process that steps the environments and XLA's
    thread then share one, and its cache. Fewer would meet those of another grid on the same cores.
    """
    cores = usable_cores()
    if len(cores) != workers * threads or not hasattr(os, "sched_setaffinity"):
        return [[] for _ in range(workers)]
    return [cores[first : first + threads] for first in range(0, len(cores), threads)]


def thread_limits(threads: int) -> dict[str, str]:
    """Environment variables that hold XLA and NumPy to a number of threads; read when they are first imported."""
    names = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    return dict.fromkeys(names, str(threads))
