"""What a run leaves on disk, and how it is read back: plain text for people, safetensors for arrays.

config.json          everything resolved, versions, machine
metrics.jsonl        one line per window of updates
episodes.csv         one line per training episode
evaluations.csv      one line per evaluation, with every episode's return
checkpoints/         what `saclab resume` continues from
best/                the policy with the best test return
result.json          written when the run has finished
"""

from __future__ import annotations

import csv
import json
import os
import platform
import re
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from saclab.config import Config
from saclab.errors import UserError

FORMAT = 1
LOGS = ("metrics.jsonl", "episodes.csv", "evaluations.csv")
EPISODE_COLUMNS = ("episode", "steps", "updates", "return", "running_average", "length", "terminated", "seconds")
"""`episode` counts from 1 after the random steps; episodes that ended within them have number 0."""


def evaluation_columns(episodes: int) -> tuple[str, ...]:
    """`seconds` is wall-clock time, here as in every log: the only entry that differs between equal runs."""
    returns = [f"return_{index}" for index in range(episodes)]
    lengths = [f"length_{index}" for index in range(episodes)]
    return ("evaluation", "steps", "updates", "episodes", "mean_return", *returns, *lengths, "seconds")


def run_path(root: Path, config: Config, name: str | None = None) -> Path:
    """runs/<environment>/<variant or name>/<protocol>/seed-<n>."""
    parts = (config.environment, name or config.variant, config.protocol, f"seed-{config.seed}")
    return root.joinpath(*(safe_name(part) for part in parts))


def safe_name(text: str) -> str:
    """A folder name: letters, digits, dot, dash and underscore; never empty, `.` or `..`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip(".") or "_"


def machine_facts() -> dict[str, Any]:
    """What could make the same configuration give other bits."""
    packages = ("saclab", "jax", "jaxlib", "numpy", "optax", "gymnasium", "mujoco")
    return {
        "versions": {package: version(package) for package in packages} | {"python": platform.python_version()},
        "machine": {"system": platform.platform(), "processor": platform.machine(), "threads": visible_threads()},
    }


def visible_threads() -> int:
    """Threads that XLA uses on the CPU: its results depend on their number."""
    return int(os.environ.get("NPROC") or len(os.sched_getaffinity(0)))


def write_json(path: Path, value: object) -> None:
    """Write whole or not at all."""
    temporary = path.with_name(path.name + ".partial")
    temporary.write_text(json.dumps(value, indent=2, ensure_ascii=False) + "\n")
    temporary.replace(path)


def read_config(run: Path) -> Config:
    """The configuration of a run folder; raises UserError if it is not one."""
    return Config.from_dict(read_config_file(run)["config"])


def read_config_file(run: Path) -> dict[str, Any]:
    path = run / "config.json"
    if not path.is_file():
        raise UserError(f"{run} is not a run folder: it has no config.json")
    try:
        content: dict[str, Any] = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise UserError(f"{path} is damaged ({error}): restore it, or remove the folder and train again") from error
    if content.get("format") != FORMAT:
        raise UserError(f"{path} has format {content.get('format')!r}, and this version of saclab reads {FORMAT}")
    return content


def read_last_session(run: Path) -> dict[str, Any]:
    """The facts of the last session that worked on a run; those of its making if it has no session yet."""
    path = run / "sessions.jsonl"
    lines = path.read_text().splitlines() if path.is_file() else []
    session: dict[str, Any] = json.loads(lines[-1]) if lines else read_config_file(run)
    return session


def is_finished(run: Path) -> bool:
    return (run / "result.json").is_file()


class Logs:
    """The three growing files of a run; their lengths are part of a checkpoint."""

    def __init__(self, run: Path, evaluation_episodes: int, positions: dict[str, int] | None) -> None:
        """Open for appending, cut back to `positions`, or start anew with header lines if there are none."""
        self.files = {}
        headers = {
            "episodes.csv": ",".join(EPISODE_COLUMNS) + "\n",
            "evaluations.csv": ",".join(evaluation_columns(evaluation_episodes)) + "\n",
            "metrics.jsonl": "",
        }
        for name in LOGS:
            file = (run / name).open("r+" if (run / name).exists() else "w+", newline="")
            position = 0 if positions is None else positions[name]
            if os.fstat(file.fileno()).st_size < position:
                raise UserError(f"{run / name} is shorter than the checkpoint remembers: the run cannot be continued")
            file.truncate(position)
            file.seek(position)
            if position == 0:
                file.write(headers[name])
            self.files[name] = file

    def episode(self, *row: object) -> None:
        csv.writer(self.files["episodes.csv"], lineterminator="\n").writerow(row)

    def evaluation(self, *row: object) -> None:
        csv.writer(self.files["evaluations.csv"], lineterminator="\n").writerow(row)
        self.flush()

    def metrics(self, values: dict[str, float | int]) -> None:
        self.files["metrics.jsonl"].write(json.dumps(values) + "\n")
        self.flush()

    def flush(self) -> None:
        for file in self.files.values():
            file.flush()

    def positions(self) -> dict[str, int]:
        """Lengths in bytes, once everything is on its way to the disk."""
        self.flush()
        for file in self.files.values():
            os.fsync(file.fileno())
        return {name: os.fstat(file.fileno()).st_size for name, file in self.files.items()}

    def close(self) -> None:
        for file in self.files.values():
            file.close()


class RunRecord(NamedTuple):
    """A run as its folder tells it; `read_run` makes it. Columns are NumPy arrays of equal length."""

    path: Path
    config: Config
    versions: dict[str, str]
    machine: dict[str, Any]
    evaluations: dict[str, np.ndarray]
    """evaluation, steps, updates, episodes, mean_return, seconds: [n]; returns and lengths: [n, episodes]."""
    episodes: dict[str, np.ndarray]
    """The columns of EPISODE_COLUMNS, episodes of the random steps left out."""
    metrics: dict[str, np.ndarray]
    """updates, steps, seconds and the fields of Metrics, each averaged over a window of updates."""
    result: dict[str, Any] | None
    """result.json of a finished run."""


def read_run(run: Path) -> RunRecord:
    """Read a run folder, finished or not; raises UserError if it is not one."""
    content = read_config_file(run)
    evaluations = read_csv(run / "evaluations.csv")
    for field, prefix in (("returns", "return_"), ("lengths", "length_")):
        columns = [evaluations.pop(name) for name in list(evaluations) if name.startswith(prefix)]
        evaluations[field] = np.stack(columns, axis=1) if columns else np.zeros((0, 0))
    episodes = read_csv(run / "episodes.csv")
    if episodes:
        learning = episodes["episode"] > 0
        episodes = {name: column[learning] for name, column in episodes.items()}
    result = run / "result.json"
    return RunRecord(
        path=run,
        config=Config.from_dict(content["config"]),
        versions=content["versions"],
        machine=content["machine"],
        evaluations=evaluations,
        episodes=episodes,
        metrics=read_json_lines(run / "metrics.jsonl"),
        result=json.loads(result.read_text()) if result.is_file() else None,
    )


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Columns as f64 arrays; a last line that is not whole, of a run that is being written, is left out."""
    if not path.is_file():
        return {}
    whole = path.read_text().rpartition("\n")[0]
    header, *rows = csv.reader(whole.splitlines())
    table = np.array([[float(value) for value in row] for row in rows], np.float64).reshape(len(rows), len(header))
    return {name: table[:, index] for index, name in enumerate(header)}


def read_json_lines(path: Path) -> dict[str, np.ndarray]:
    """Columns as f64 arrays; a last line that is not whole is left out."""
    if not path.is_file():
        return {}
    lines = [json.loads(line) for line in path.read_text().rpartition("\n")[0].splitlines()]
    return {name: np.array([line[name] for line in lines], np.float64) for name in (lines[0] if lines else ())}


def find_runs(roots: Iterable[Path]) -> list[Path]:
    """All run folders at or below the given ones, sorted; raises UserError if there is none."""
    roots = list(roots)
    runs = sorted({path.parent for root in roots for path in root.rglob("config.json")})
    if not runs:
        raise UserError(f"no run folder (one with a config.json) in {', '.join(map(str, roots))}")
    return runs
