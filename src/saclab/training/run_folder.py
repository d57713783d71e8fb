"""What a run leaves on disk, and how it is read back: plain text for people, safetensors for arrays.

config.json          everything resolved, versions, machine
metrics.jsonl        one line per window of updates
episodes.csv         one line per training episode
evaluations.csv      one line per evaluation, with every episode's return
checkpoints/         what `saclab resume` continues from
best/                the policy with the best evaluation return
result.json          written when the run has finished
failure/             what led to its end, if it came to a bad one
"""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from saclab.config import Config
from saclab.errors import UserError

FORMAT = 1
FAILURE = "failure"
"""Folder with what led to a run's end, if it came to a bad one."""
LOGS = ("metrics.jsonl", "episodes.csv", "evaluations.csv", "q_bias.csv")
EPISODE_COLUMNS = ("episode", "steps", "updates", "return", "running_average", "length", "terminated", "seconds")
"""`episode` counts from 1 after the random steps; episodes that ended within them have number 0."""
Q_BIAS_COLUMNS = (
    "evaluation", "steps", "updates", "episodes", "pairs", "mean_q", "mean_return", "mean_bias", "bias_spread",
    "seconds",
)  # fmt: skip
"""From `pairs` on, the fields of `saclab.training.q_bias.QBias`."""


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


def read_config(run: Path) -> Config:
    """The configuration of a run folder; raises UserError if it is not one."""
    return config_of(run, read_config_file(run))


def config_of(run: Path, content: dict[str, Any]) -> Config:
    """The configuration in what `read_config_file` read; raises UserError if there is none that works."""
    try:
        config = Config.from_dict(content["config"])
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise damaged(run / "config.json", error) from error
    for settings in (config, config.algorithm, config.training):
        for name, hint in get_type_hints(type(settings)).items():
            value = getattr(settings, name)
            if not fits(value, hint):
                raise damaged(run / "config.json", f"{name} = {value!r}")
    return config


def fits(value: object, hint: Any) -> bool:
    """Whether a value that came from JSON is of the type of a setting."""
    kind, arguments = get_origin(hint), get_args(hint)
    if kind is Literal:
        return value in arguments
    if kind is tuple:
        return isinstance(value, tuple) and all(fits(part, arguments[0]) for part in value)
    if kind in (Union, UnionType):
        return any(fits(value, argument) for argument in arguments)
    if hint is float:
        return type(value) in (int, float)
    return type(value) is (kind or hint)


def damaged(path: Path, reason: object) -> UserError:
    return UserError(f"{path} is damaged ({reason}): restore it, or remove the folder and train again")


def read_config_file(run: Path) -> dict[str, Any]:
    path = run / "config.json"
    if not path.is_file():
        raise UserError(f"{run} is not a run folder: it has no config.json")
    try:
        content: dict[str, Any] = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise damaged(path, error) from error
    if not isinstance(content, dict) or "format" not in content:
        raise damaged(path, "it is not what saclab writes")
    if content["format"] != FORMAT:
        raise UserError(f"{path} has format {content.get('format')!r}, and this version of saclab reads {FORMAT}")
    for part in ("config", "versions", "machine"):
        if not isinstance(content.get(part), dict):
            raise damaged(path, f"it has no {part}")
    return content


def append_line(path: Path, value: object) -> None:
    """Add a line of JSON, on a line of its own even if a crash cut the last one short."""
    with path.open("a+b") as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(0, end - 1))
        torn = file.read(1) not in (b"", b"\n")
        file.write(b"\n" * torn + json.dumps(value).encode() + b"\n")


def read_last_session(run: Path) -> dict[str, Any]:
    """The facts of the last session that worked on a run; those of its making if it has no session yet.

    Its `machine` has `threads`. Lines that a crash or anything else has damaged are passed over.
    """
    path = run / "sessions.jsonl"
    for line in reversed(path.read_bytes().splitlines() if path.is_file() else []):
        try:
            session = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if has_threads(session):
            return dict(session)
    content = read_config_file(run)
    if not has_threads(content):
        raise damaged(run / "config.json", "it does not tell the machine's threads")
    return content


def has_threads(session: object) -> bool:
    machine = session.get("machine") if isinstance(session, dict) else None
    threads = machine.get("threads") if isinstance(machine, dict) else None
    return type(threads) is int and threads > 0


def is_finished(run: Path) -> bool:
    return (run / "result.json").is_file()


class Logs:
    """The growing files of a run; their lengths are part of a checkpoint."""

    def __init__(self, run: Path, evaluation_episodes: int, positions: dict[str, int] | None) -> None:
        """Open for appending, cut back to `positions`, or start anew with header lines if there are none."""
        self.files = {}
        headers = {
            "episodes.csv": ",".join(EPISODE_COLUMNS) + "\n",
            "evaluations.csv": ",".join(evaluation_columns(evaluation_episodes)) + "\n",
            "metrics.jsonl": "",
            "q_bias.csv": ",".join(Q_BIAS_COLUMNS) + "\n",
        }
        for name in LOGS:
            file = (run / name).open("r+" if (run / name).exists() else "w+", newline="")
            position = 0 if positions is None else positions.get(name, 0)
            if os.fstat(file.fileno()).st_size < position:
                raise UserError(
                    f"{run / name} is shorter than the checkpoint remembers, so the run cannot be continued: restore "
                    "the file, or remove the folder and train again"
                )
            file.truncate(position)
            file.seek(position)
            if position == 0:
                file.write(headers[name])
                file.flush()
            self.files[name] = file

    def episode(self, *row: object) -> None:
        csv.writer(self.files["episodes.csv"], lineterminator="\n").writerow(row)

    def evaluation(self, *row: object) -> None:
        csv.writer(self.files["evaluations.csv"], lineterminator="\n").writerow(row)
        self.flush()

    def q_bias(self, *row: object) -> None:
        csv.writer(self.files["q_bias.csv"], lineterminator="\n").writerow(row)

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
    """updates, steps, seconds and what the variant reports, each averaged over a window of updates."""
    q_bias: dict[str, np.ndarray]
    """The columns of Q_BIAS_COLUMNS; empty arrays if it was not measured."""
    result: dict[str, Any] | None
    """result.json of a finished run."""


def read_run(run: Path) -> RunRecord:
    """Read a run folder, finished or not; raises UserError if it is not one or a file in it is damaged."""
    content = read_config_file(run)
    evaluations = readable(read_csv, run / "evaluations.csv")
    for field, prefix in (("returns", "return_"), ("lengths", "length_")):
        columns = [evaluations.pop(name) for name in list(evaluations) if name.startswith(prefix)]
        evaluations[field] = np.stack(columns, axis=1) if columns else np.zeros((0, 0))
    episodes = readable(read_csv, run / "episodes.csv")
    if episodes:
        learning = episodes["episode"] > 0
        episodes = {name: column[learning] for name, column in episodes.items()}
    return RunRecord(
        path=run,
        config=config_of(run, content),
        versions=content["versions"],
        machine=content["machine"],
        evaluations=evaluations,
        episodes=episodes,
        metrics=readable(read_json_lines, run / "metrics.jsonl"),
        q_bias=readable(read_csv, run / "q_bias.csv"),
        result=readable(read_json, run / "result.json") if is_finished(run) else None,
    )


def readable(read: Callable[[Path], dict[str, Any]], path: Path) -> dict[str, Any]:
    """What `read` makes of a file; raises UserError if it cannot."""
    try:
        return read(path)
    except (KeyError, RecursionError, TypeError, ValueError) as error:
        raise damaged(path, error) from error


def read_json(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text()))


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Columns as f64 arrays; a last line that is not whole, of a run that is being written, is left out."""
    if not path.is_file():
        return {}
    whole = path.read_text().rpartition("\n")[0]
    if not whole:
        return {}
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
