"""What a contestant of time_to_score.py is told, and how it tells what it reached. Standard library only."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class ScoreJob:
    """One training, until an evaluation reaches the score."""

    environment: str
    seed: int
    score: float
    most_steps: int
    evaluation_interval_steps: int
    evaluation_episodes: int
    folder: str
    """The contestant may write here."""
    began: float
    """`time.time()` when the process was started."""
    settings: dict[str, str | int | float] = field(default_factory=dict)
    """Variant, protocol and settings of saclab's."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_command_line() -> ScoreJob:
        return ScoreJob(**json.loads(sys.argv[1]))


class ScoreWatch:
    """Told of each evaluation."""

    def __init__(self, job: ScoreJob) -> None:
        self.job = job
        self.evaluations: list[tuple[float, int, float]] = []
        """Seconds from the start of the process, environment steps, mean return."""

    def evaluated(self, steps: int, mean_return: float) -> bool:
        """Whether the score is reached."""
        self.evaluations.append((round(time.time() - self.job.began, 1), steps, round(mean_return, 1)))
        return mean_return >= self.job.score

    def report(self) -> None:
        """One line of JSON on standard output."""
        print(json.dumps(self.evaluations), flush=True)
