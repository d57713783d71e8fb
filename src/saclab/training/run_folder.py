"""What a run leaves on disk, and how it is read back: plain text for people, safetensors for arrays.

config.json          everything resolved, versions, machine
metrics.jsonl        one line per window of updates
episodes.csv         one line per training episode
evaluations.csv      one line per evaluation, with every episode's return
reward_terms.csv     likewise, with each reward term's mean return and weight, if there are terms
checkpoints/         what `saclab resume` continues from
best/                the policy with the best evaluation return
result.json          written when the run has finished
failure/             what led to its end, if it came to a bad one
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from saclab.config import Config
from saclab.errors import UserError, require
from saclab.records import (
    EPISODES,
    EVALUATIONS,
    JSON_BYTES,
    METRICS,
    Q_BIAS,
    REWARD_TERMS,
    Count,
    Damaged,
    FileRecord,
    Formatted,
    Missing,
    OfAnotherVersion,
    Prefilled,
    Result,
    RunDescription,
    Session,
    Table,
    from_json,
    read_bytes,
    read_json,
    require_recorded,
    table_from_csv,
    table_from_json_lines,
)
from saclab.training.logs import OF_TERMS, evaluation_columns
from saclab.training.manifest import CheckpointError, newest_first, read_manifest
from saclab.training.saved_state import files_in

FORMAT = 1
LONGEST_NAME = 200
"""Letters of a folder's name that every file system takes."""
FAILURE = "failure"
"""Folder with what led to a run's end, if it came to a bad one."""
EVALUATION_TYPES = {"return_": float, "length_": Count}
"""The start of the numbered columns' names in evaluations.csv -> the type of their values."""
ROUNDED = 1e-4
"""What is computed from logs may differ from what is recorded by such a share: logs may be rounded to five digits."""


def run_path(root: Path, config: Config, name: str | None = None) -> Path:
    """runs/<environment>/<variant or name>/<protocol>/seed-<n>."""
    parts = {"environment": config.environment, "name": name or config.variant, "protocol": config.protocol}
    for setting, part in parts.items():
        require(len(safe_name(part)) <= LONGEST_NAME, setting, part, f"use at most {LONGEST_NAME} letters")
    return root.joinpath(*map(safe_name, parts.values()), f"seed-{config.seed}")


def safe_name(text: str) -> str:
    """A folder name: letters, digits, dot, dash and underscore; never empty, `.` or `..`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip(".") or "_"


def read_config(run: Path) -> Config:
    """The configuration of a run folder; raises UserError if it is not one, or is not the one that was recorded."""
    return config_of(run, read_description(run, recorded_files(run, read_result(run))))


def read_description(run: Path, recorded: Mapping[str, FileRecord]) -> RunDescription:
    """config.json; raises UserError if it is none of saclab's, Damaged if it is not what was recorded of it."""
    path = run / "config.json"
    try:
        content = read_bytes(path, JSON_BYTES)
    except Missing as error:
        raise UserError(f"{run} is not a run folder: it has no config.json") from error
    if path.name in recorded:
        require_recorded(path, content, recorded[path.name], grows=False)
    try:
        found = from_json(path, content, Formatted).format
    except Damaged as error:
        raise UserError(f"{run} is not a run folder: its config.json is not saclab's ({error.reason})") from error
    if found != FORMAT:
        raise UserError(f"{path} has format {found!r}, and this version of saclab reads {FORMAT}")
    return from_json(path, content, RunDescription)


def config_of(run: Path, description: RunDescription) -> Config:
    """The configuration in config.json; raises Damaged if there is none that works, or none that works here."""
    try:
        return Config.from_dict(description.config)
    except (msgspec.ValidationError, UserError) as error:
        path, writer = run / "config.json", description.versions.get("saclab")
        if writer in (None, version("saclab")):
            raise Damaged(path, error) from error
        raise OfAnotherVersion(path, error, f"it was written by saclab {writer}, so read it with that") from error


def append_line(path: Path, value: object) -> None:
    """Add a line of JSON, on a line of its own even if a crash cut the last one short."""
    with path.open("a+b") as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(0, end - 1))
        torn = file.read(1) not in (b"", b"\n")
        file.write(b"\n" * torn + json.dumps(value, allow_nan=False).encode() + b"\n")


def read_last_session(run: Path) -> Session:
    """The last session that worked on a run; that of its making if it has none yet. Its machine has threads.

    Lines that a crash or anything else has damaged are passed over. Raises Damaged if nothing tells the threads.
    """
    path, lines = run / "sessions.jsonl", []
    with suppress(Damaged):
        lines = read_bytes(path).splitlines()
    for line in reversed(lines):
        with suppress(Damaged):
            session = from_json(path, line, Session)
            if session.machine.threads is not None:
                return session
    session = read_json(run / "config.json", Session)
    if session.machine.threads is None:
        raise Damaged(run / "config.json", "it does not tell the machine's threads")
    return session


# --- what is recorded of the files, so that damage is seen


def is_finished(run: Path) -> bool:
    return os.path.isfile(run / "result.json")


def read_result(run: Path) -> Result | None:
    """result.json; None for a run that has not finished. Raises Damaged."""
    try:
        return read_json(run / "result.json", Result)
    except Missing:
        return None


def recorded_files(run: Path, result: Result | None) -> dict[str, FileRecord]:
    """What is known of config.json and the logs: from the end of a run, or from its newest checkpoint.

    Empty where nothing is: before the first checkpoint, and for runs of before November 2026.
    """
    if result is not None and result.files:
        return result.files
    for path in newest_first(run / "checkpoints"):
        with suppress(CheckpointError):
            return files_in(read_manifest(path).state)
    return {}


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
    reward_terms: dict[str, np.ndarray] = {}  # noqa: RUF012 - read only
    """The columns of `reward_term_columns`; empty for a run whose reward is not split."""
    prefill: Prefilled | None = None
    """What the run began with, if with anything."""


def read_run(run: Path | str) -> RunRecord:
    """Read a run folder, finished or not.

    Raises:
        UserError: if it is not one, or a file in it is damaged: what was recorded of the logs, and what follows from
            other numbers, is compared.
    """
    run = Path(run)
    result = read_result(run)
    recorded = recorded_files(run, result)
    description = read_description(run, recorded)
    config = config_of(run, description)

    def log(name: str) -> bytes:
        return read_log(run / name, recorded.get(name), grows=result is None)

    evaluations = table_from_csv(run / "evaluations.csv", log("evaluations.csv"), EVALUATIONS, EVALUATION_TYPES)
    evaluations = with_matrices(run / "evaluations.csv", evaluations, config.training.evaluation_episodes)
    require_consistent(run, evaluations, result)
    episodes = table_from_csv(run / "episodes.csv", log("episodes.csv"), EPISODES)
    if episodes:
        learning = episodes["episode"] > 0
        episodes = {name: column[learning] for name, column in episodes.items()}
    return RunRecord(
        path=run,
        config=config,
        versions=description.versions,
        machine=description.machine,
        evaluations=evaluations,
        episodes=episodes,
        metrics=table_from_json_lines(run / "metrics.jsonl", log("metrics.jsonl"), METRICS),
        q_bias=table_from_csv(run / "q_bias.csv", log("q_bias.csv"), Q_BIAS),
        result=None if result is None else msgspec.to_builtins(result),
        reward_terms=table_from_csv(run / OF_TERMS, log(OF_TERMS), REWARD_TERMS),
        prefill=description.prefill,
    )


def read_evaluations(run: Path, config: Config) -> Table | None:
    """The evaluations of a run that goes on, as `RunRecord` has them; None if there is none yet. Raises Damaged."""
    path = run / "evaluations.csv"
    table = table_from_csv(path, read_log(path, None, grows=True), EVALUATIONS, EVALUATION_TYPES)
    return with_matrices(path, table, config.training.evaluation_episodes) if table else None


def read_log(path: Path, recorded: FileRecord | None, grows: bool) -> bytes:
    """A log; nothing if there is none and nothing is recorded of it. Raises Damaged."""
    try:
        content = read_bytes(path)
    except Missing:
        if recorded is None:
            return b""
        raise
    if recorded is not None:
        require_recorded(path, content, recorded, grows)
    return content


def with_matrices(path: Path, evaluations: Table, episodes: int) -> Table:
    """The columns of evaluations.csv, those of the single episodes put together as [n, episodes]."""
    if not evaluations:
        return {"returns": np.zeros((0, 0)), "lengths": np.zeros((0, 0))}
    if lacking := [name for name in evaluation_columns(episodes) if name not in evaluations]:
        raise Damaged(path, f"it has no column {lacking[0]!r}")
    table = dict(evaluations)
    for field, prefix in (("returns", "return_"), ("lengths", "length_")):
        table[field] = np.stack([table.pop(f"{prefix}{index}") for index in range(episodes)], axis=1)
    return table


def require_consistent(run: Path, evaluations: Table, result: Result | None) -> None:
    """Raise Damaged unless every evaluation is there, and its mean is that of its episodes.

    A finished run's best and last returns are compared too: they are all that tells of a log of before checksums.
    """
    path = run / "evaluations.csv"
    if not evaluations["returns"].size:
        if result is not None:
            raise Damaged(path, "the run has finished, and there is no evaluation")
        return
    means, returns = evaluations["mean_return"], evaluations["returns"]
    if not np.array_equal(evaluations["evaluation"], np.arange(1, len(means) + 1)):
        raise Damaged(path, "its evaluations are not numbered 1, 2, 3, …")
    for name in ("steps", "updates", "episodes"):
        if (np.diff(evaluations[name]) < 0).any():
            raise Damaged(path, f"its {name} go back")
    tolerance = ROUNDED * np.abs(returns).max(axis=1)
    if (np.abs(means - returns.mean(axis=1)) > tolerance).any():
        raise Damaged(path, "a mean_return is not the mean of its episodes' returns")
    ends = (
        {} if result is None else {"best": (result.best_return, means.max()), "last": (result.final_return, means[-1])}
    )
    for name, (told, found) in ends.items():
        if abs(told - found) > tolerance.max():
            raise Damaged(path, f"its {name} mean_return is {found:g}, and result.json has {told:g}")


def find_runs(roots: Iterable[Path]) -> list[Path]:
    """All run folders at or below the given ones, sorted, and folders that cannot be looked into.

    Raises UserError if there is none.
    """
    roots, runs = list(roots), set[Path]()
    problems: list[OSError] = []
    for root in roots:
        for folder, folders, files in os.walk(root, onerror=problems.append):
            if "config.json" in (*folders, *files):
                runs.add(Path(folder))
            folders[:] = [name for name in folders if name != "checkpoints"]
    unreadable = {Path(problem.filename) for problem in problems}
    if not runs | unreadable - set(roots):
        reasons = "".join(f"; {problem.filename}: {problem.strerror}" for problem in problems)
        raise UserError(f"no run folder (one with a config.json) in {', '.join(map(str, roots))}{reasons}")
    return sorted(runs | unreadable)
