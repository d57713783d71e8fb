"""What saclab reads back from disk: one schema for each file, used for writing too. What does not fit is named.

A run folder may come from anywhere and may have suffered anything, so nothing in it is believed: every reader raises
`Damaged`, which tells the file, the place in it and the reason, and reads nothing that is no plain file.
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct

from saclab.errors import UserError
from saclab.machine import available_memory

JSON_BYTES = 2**26
"""Far more than a description, a result or a manifest takes; what is no larger is read without a look at memory."""
UNREADABLE = (msgspec.MsgspecError, RecursionError, ValueError)
"""What msgspec raises for content that does not fit."""
LET_READ = "put a plain file in its place that this process may read"
RETRAIN = "restore it, or remove the folder and train again"

Count = Annotated[int, Meta(ge=0, lt=2**53)]
Flag = Annotated[int, Meta(ge=0, le=1)]
Size = Annotated[int, Meta(ge=1, lt=2**31)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Record = TypeVar("Record")


class Damaged(UserError):  # noqa: N818 - it names what the file is
    """A file that is not what saclab has written."""

    state = "is damaged"

    def __init__(self, path: Path, reason: object, way_out: str = RETRAIN) -> None:
        super().__init__(f"{path} {self.state} ({reason}): {way_out}")
        self.path, self.reason = path, str(reason)


class Unreadable(Damaged):
    """A file that the system does not let be read, or that is none."""

    state = "cannot be read"


class OfAnotherVersion(Damaged):
    """A file in which another version of saclab has written what this one does not know."""

    state = "does not fit this version of saclab"


class Missing(Unreadable):
    """There is no such file."""


# --- schemas


class FileRecord(Struct, omit_defaults=True):
    """What is recorded of a file, or of the beginning of a log that grows."""

    bytes: Count
    sha256: Sha256 | None = None
    """None where an earlier saclab recorded the size only."""
    version: int | None = None
    """What a segment of the replay buffer holds; None for other files."""


class Formatted(Struct):
    """Any file that says its format."""

    format: int


class Prefilled(Struct):
    """What is recorded of the experience that a run has begun with."""

    transitions: Count
    """In the replay buffer before the first step; 0 where it is a policy."""
    sha256: Sha256
    """Of the transitions, or of the policy."""

    def __str__(self) -> str:
        what = f"{self.transitions} transitions" if self.transitions else "a policy"
        return f"{what}, SHA-256 {self.sha256[:16]}"


class RunDescription(Formatted, omit_defaults=True):
    """config.json."""

    config: dict[str, Any]
    """`Config.to_dict()`."""
    versions: dict[str, str]
    machine: dict[str, Any]
    prefill: Prefilled | None = None


class Machine(Struct):
    """What is asked of the machine that a session ran on."""

    threads: Size | None = None
    batch: Annotated[int, Meta(ge=0, le=4096)] = 0
    """Slots of the run group; 0 for a run alone."""


class Facts(Struct):
    """What `machine_facts` gave for config.json or a checkpoint, as far as it is used."""

    machine: Machine


class Session(Facts):
    """A line of sessions.jsonl, as far as it is used."""

    from_step: Count = 0


class Result(Struct):
    """result.json, of a finished run."""

    reason: str
    steps: Count
    updates: Count
    episodes: Count
    best_return: float
    final_return: float
    seconds: float
    files: dict[str, FileRecord] = {}
    """The logs and config.json at the end; empty for runs of before they were recorded."""


class PolicyDescription(Struct, omit_defaults=True):
    """policy.json."""

    environment: str
    environment_arguments: dict[str, Any]
    observation_size: Size
    action_size: Size
    algorithm: dict[str, Any]
    """AlgorithmSettings."""
    mean_return: float | None = None
    """That of the evaluation that found it the best."""
    episode: Count | None = None
    """Training episodes until then."""
    wrappers: tuple[str, ...] = ()
    """Around the environment, the first one innermost."""


class ReplayRecord(Struct):
    """What a checkpoint's manifest tells of the replay buffer."""

    added: Count
    capacity: Count
    segment_rows: Count
    columns: dict[str, Count] | None = None
    """None in format 1."""


class Manifest(Formatted):
    """manifest.json of a checkpoint."""

    files: dict[str, FileRecord]
    replay: ReplayRecord
    state: dict[str, Any]


Columns = Mapping[str, Any]
"""The columns of a log: name -> type of its numbers."""
EPISODES: Columns = {
    "episode": Count, "steps": Count, "updates": Count, "return": float, "running_average": float, "length": Count,
    "terminated": Flag, "seconds": float,
}  # fmt: skip
"""`episode` counts from 1 after the random steps; episodes that ended within them have number 0."""
COUNTERS: Columns = {"evaluation": Count, "steps": Count, "updates": Count, "episodes": Count}
EVALUATIONS: Columns = {**COUNTERS, "mean_return": float, "seconds": float}
"""Beside them the return and the length of each episode."""
Q_BIAS: Columns = {
    **COUNTERS, "pairs": Count, "mean_q": float | None, "mean_return": float | None, "mean_bias": float | None,
    "bias_spread": float | None, "seconds": float,
}  # fmt: skip
"""From `pairs` on, the fields of `saclab.training.q_bias.QBias`: numbers but for an evaluation without pairs."""
REWARD_TERMS: Columns = {**COUNTERS, "seconds": float}
"""Beside them, of each term, its mean return and its weight (`saclab.training.logs.reward_term_columns`)."""
METRICS: Columns = {"updates": Count, "steps": Count, "seconds": float}
"""Beside them whatever the variant reports."""


# --- reading


def read_bytes(path: Path, limit: int | None = None) -> bytes:
    """A plain file, or one that a link leads to; never a pipe, which would hang, or a device.

    Args:
        path: of the file.
        limit: bytes that it may have at most; what memory holds limits it anyway.

    Raises:
        Missing: if there is none.
        Damaged: if it cannot be read.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise Unreadable(path, "it is no plain file", LET_READ)
            if limit is not None and status.st_size > limit:
                raise Damaged(path, f"it has {status.st_size} bytes, more than the {limit} that it can have")
            available = available_memory() if status.st_size > JSON_BYTES else None
            if available is not None and status.st_size > available:
                raise Damaged(path, f"it has {status.st_size} bytes, and {available} bytes of memory are free")
            return file.read()
    except FileNotFoundError as error:
        raise Missing(path, "it is missing") from error
    except OSError as error:
        raise Unreadable(path, error.strerror or error, LET_READ) from error


def is_there(path: Path) -> bool:
    """Whether there is such a file or folder; raises Unreadable where the system does not let that be seen."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return False
    except OSError as error:
        raise Unreadable(path, error.strerror or error, LET_READ) from error
    return True


def from_json(path: Path, content: bytes, schema: type[Record]) -> Record:
    """The JSON of a file; raises Damaged with the place that does not fit."""
    try:
        return msgspec.json.decode(content, type=schema)
    except UNREADABLE as error:
        raise Damaged(path, error) from error


def read_json(path: Path, schema: type[Record]) -> Record:
    """Read a file of JSON; raises as `read_bytes` and `from_json` do."""
    return from_json(path, read_bytes(path, JSON_BYTES), schema)


def file_record(content: bytes) -> FileRecord:
    return FileRecord(len(content), hashlib.sha256(content).hexdigest())


def require_recorded(path: Path, content: bytes, recorded: FileRecord, grows: bool) -> None:
    """Raise Damaged unless a file is what was recorded, or begins with it and `grows`."""
    if len(content) < recorded.bytes or (len(content) > recorded.bytes and not grows):
        raise Damaged(path, f"it has {len(content)} bytes, and {recorded.bytes} were written")
    beginning = content[: recorded.bytes]
    if recorded.sha256 is not None and hashlib.sha256(beginning).hexdigest() != recorded.sha256:
        raise Damaged(path, "it does not match its checksum")


def table_from_csv(path: Path, content: bytes, columns: Columns, more: Mapping[str, Any] | None = None) -> Table:
    """Columns of a log as f64 arrays.

    A last line that is not whole, of a run that is being written, is left out. Columns that this version does not know
    are numbers.

    Args:
        path: for the error.
        content: of the file.
        columns: those that it must have.
        more: beginnings of the names of numbered columns -> their type.

    Raises:
        Damaged: for a column that is missing or there twice, and for anything but a finite number in its place.
    """
    head, *lines = whole_lines(content) or [b""]
    if not head:
        return {}
    names = head.decode("ascii", "replace").split(",")
    if lacking := [name for name in columns if name not in names]:
        raise Damaged(path, f"it has no column {lacking[0]!r}")
    if len(set(names)) < len(names):
        raise Damaged(path, "it has a column twice")
    kinds = [columns.get(name) or (more or {}).get(name.rstrip("0123456789"), float) for name in names]
    row: Any = tuple.__class_getitem__(tuple(kinds))
    rows = decoded(path, [b"[%b]" % line.replace(b"nan", b"null") for line in lines], row, first=2)
    return as_columns(names, rows)


def table_from_json_lines(path: Path, content: bytes, columns: Columns) -> Table:
    """The same of lines of JSON, which all have the names of the first."""
    rows: list[dict[str, float]] = decoded(path, whole_lines(content), dict[str, float], first=1)
    names = list(rows[0]) if rows else []
    for number, row in enumerate(rows, start=1):
        if row.keys() != rows[0].keys():
            raise Damaged(path, f"line {number} has other names than line 1")
    if rows and (lacking := [name for name in columns if name not in names]):
        raise Damaged(path, f"it has no {lacking[0]!r}")
    return as_columns(names, [list(row.values()) if list(row) == names else [row[n] for n in names] for row in rows])


Table = dict[str, np.ndarray]
"""Column -> f64[rows]."""


def whole_lines(content: bytes) -> list[bytes]:
    """The lines of a log, without a last one that is not whole."""
    return [line.rstrip(b"\r") for line in content.split(b"\n")[:-1]]


def decoded(path: Path, lines: Iterable[bytes], kind: Any, first: int) -> list[Any]:
    """Each line of a log, which begins with line `first`, as JSON; raises Damaged with the line's number."""
    decoder, rows = msgspec.json.Decoder(kind), []
    for number, line in enumerate(lines, start=first):
        try:
            rows.append(decoder.decode(line))
        except UNREADABLE as error:
            raise Damaged(path, f"line {number}: {error}") from error
    return rows


def as_columns(names: Sequence[str], rows: Sequence[Sequence[float | None]]) -> Table:
    table = np.array(rows, np.float64).reshape(len(rows), len(names))
    return {name: table[:, index] for index, name in enumerate(names)}


# --- CSV for other programs

FORMULA_BEGINNINGS = tuple("=+-@＝＋－＠")


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows as lines of CSV. Text that a spreadsheet would run as a formula gets an apostrophe; numbers stay numbers."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([[harmless(cell) for cell in row] for row in rows])
    return text.getvalue()


def harmless(cell: object) -> object:
    if not isinstance(cell, str):
        return cell
    text = cell.replace("\r", " ")
    return "'" + text if text.lstrip().startswith(FORMULA_BEGINNINGS) else text
