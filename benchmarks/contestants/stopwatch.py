"""What every contestant is told and measures: the same job, the same clock. Standard library only."""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version


@dataclass(frozen=True)
class Job:
    """One training: plain SAC with the paper's networks and Table 1, evaluations on the way."""

    environment: str
    update_interval: int
    """Environment steps per update."""
    warm_updates: int
    """Updates before the clock starts: compilation and first touches of memory are not in the rate."""
    timed_updates: int
    evaluation_interval_steps: int
    evaluation_episodes: int
    folder: str
    """The contestant may write here."""
    began: float
    """`time.time()` when the process was started."""
    random_steps: int = 1_000
    replay_capacity: int = 200_000
    settings: tuple[tuple[str, str | float], ...] = ()
    """More of saclab's own settings."""

    @property
    def steps(self) -> int:
        """Environment steps of the whole job."""
        return self.random_steps + self.update_interval * (self.warm_updates + self.timed_updates)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_command_line() -> Job:
        return Job(**json.loads(sys.argv[1]))


class Stopwatch:
    """Told of the updates made so far, as often as convenient; times the window of the job."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.first_update: float | None = None
        self.start: tuple[float, float, int] | None = None
        self.end: tuple[float, float, int] | None = None

    def updates_made(self, updates: int) -> None:
        now = (time.perf_counter(), time.process_time(), updates)
        if updates >= 1 and self.first_update is None:
            self.first_update = time.time() - self.job.began
        if updates >= self.job.warm_updates and self.start is None:
            self.start = now
        if updates >= self.job.warm_updates + self.job.timed_updates and self.end is None:
            self.end = now

    def report(self, *packages: str, libraries: Mapping[str, str] | None = None, **more: float) -> None:
        """One line of JSON on standard output.

        Args:
            packages: whose versions are told.
            libraries: versions of what is no Python package.
            more: what else was measured.
        """
        assert self.start is not None
        assert self.end is not None
        seconds, cpu_seconds, updates = (end - start for start, end in zip(self.start, self.end, strict=True))
        result = {
            "updates_per_second": updates / seconds,
            "seconds": seconds,
            "cpu_seconds": cpu_seconds,
            "updates": updates,
            "first_update_seconds": self.first_update,
            "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            * (1 if sys.platform == "darwin" else 1024),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            **more,
            "versions": {name: version(name) for name in (*packages, "gymnasium", "mujoco", "numpy")}
            | dict(libraries or {}),
        }
        print(json.dumps(result), flush=True)
