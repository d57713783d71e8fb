"""Checkpoints: written whole or not at all, checksummed, never unpickled, and cheap to take often.

    checkpoints/step-000000012000/                       or step-…-untested, if an evaluation comes first, or
                                                         step-…-update-…, if further updates do
      learner.safetensors, environments.safetensors, …   one file per group of arrays
      replay-0000.safetensors, …                         the replay buffer, SEGMENT_ROWS rows each
      manifest.json                                      every file's SHA-256 and size, and the plain state
      manifest.sha256                                    the manifest's own

The newest two are kept. A segment of the replay buffer that has not changed since the checkpoint before the last is
hard-linked from it, not written again; never from the last one, so that the two kept checkpoints share no file and
damage to one leaves the other whole. A checkpoint that could not be used is set aside as step-….damaged, so that none
of its files is linked to, and goes when the next one has been written.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
import safetensors.numpy

from saclab.files import sync, write_bytes
from saclab.records import FileRecord, Manifest, ReplayRecord, file_record
from saclab.replay import ReplayBuffer, RowLayout
from saclab.training import format_1
from saclab.training.manifest import (
    FORMAT,
    MANIFEST,
    MANIFEST_CHECKSUM,
    CheckpointError,
    Moment,
    newest_first,
    read_manifest,
    read_plain_file,
    visible_checkpoints,
)

KEPT = 2
SEGMENT_ROWS = 8192

Arrays = dict[str, np.ndarray]


class Checkpoint(NamedTuple):
    groups: dict[str, Arrays]
    """Group -> name -> array."""
    state: dict[str, Any]
    """JSON-able."""
    transitions: int = 0
    """Transitions added to the replay buffer since the start of the run."""
    format: int = FORMAT
    """The format that it was written in; the groups are those of today's."""


class Replay(Protocol):
    """A replay buffer as far as it has to be read: that of the host, or one that lies on a device."""

    @property
    def capacity(self) -> int: ...

    @property
    def added(self) -> int: ...

    @property
    def size(self) -> int: ...

    @property
    def rows(self) -> Any:
        """f32[capacity, width], which can be indexed."""

    @property
    def layout(self) -> RowLayout: ...


def save_checkpoint(folder: Path, moment: Moment, checkpoint: Checkpoint, replay: Replay) -> Path:
    """Write `folder`/step-… and remove all but the newest two; an existing one of the same moment stays.

    Raises:
        CheckpointError: if it cannot be written; what was there before is whole.
    """
    final = folder / moment.name
    if final.exists():
        return final
    partial = final.with_suffix(".partial")
    try:
        if not folder.exists():
            folder.mkdir(parents=True)
            sync(folder.parent)
        remove_all(folder.glob("step-*.partial"))
        partial.mkdir()
        write_files(partial, checkpoint, replay, link_from=replaced_by_next(folder))
        sync(partial)
        partial.rename(final)
        sync(folder)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise CheckpointError(cannot_save(final, error)) from error
    with suppress(OSError):  # it is saved: what cannot be removed now is at the next save
        for old in newest_first(folder)[KEPT:]:
            old.rename(old.with_suffix(".partial"))  # from now on it is no checkpoint, however far the removal gets
        remove_all([*folder.glob("step-*.partial"), *folder.glob("step-*.damaged")])
    return final


def cannot_save(final: Path, error: OSError) -> str:
    """What happened, what is kept, and the way out."""
    kept = visible_checkpoints(final.parent)
    reason = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else str(error)
    return (
        f"cannot save {final}: {reason}. "
        + (f"The last good checkpoint, {kept[0].name}, is kept" if kept else "There is no earlier checkpoint")
        + "; make room, then start the same command again, or continue a run that is alone with: saclab resume "
        + str(final.parent.parent)
    )


def set_aside(checkpoint: Path, suffix: str) -> None:
    """Rename a checkpoint, so that it is none from now on."""
    shutil.rmtree(checkpoint.with_suffix(suffix), ignore_errors=True)
    checkpoint.rename(checkpoint.with_suffix(suffix))


def replaced_by_next(folder: Path) -> Path | None:
    """The checkpoint that will be removed once the next one is written."""
    existing = newest_first(folder)
    return existing[KEPT - 1] if len(existing) >= KEPT else None


def remove_all(paths: Iterable[Path]) -> None:
    for path in paths:
        shutil.rmtree(path)


# --- writing


def write_files(folder: Path, checkpoint: Checkpoint, replay: Replay, link_from: Path | None) -> None:
    files = {
        f"{group}.safetensors": write_arrays(folder / f"{group}.safetensors", arrays)
        for group, arrays in checkpoint.groups.items()
    }
    files |= write_replay(folder, replay, link_from)
    buffer = ReplayRecord(replay.added, replay.capacity, SEGMENT_ROWS, replay.layout.columns)
    manifest = msgspec.to_builtins(Manifest(FORMAT, files, buffer, checkpoint.state))
    content = json.dumps(manifest, indent=1, allow_nan=False).encode()
    write_bytes(folder / MANIFEST, content)
    write_bytes(folder / MANIFEST_CHECKSUM, (hashlib.sha256(content).hexdigest() + "\n").encode())


def write_replay(folder: Path, replay: Replay, link_from: Path | None) -> dict[str, FileRecord]:
    """Link the segments that `link_from` has already and write the others; `version` tells what a segment holds."""
    old_files = linkable_files(link_from)
    files = {}
    for index, rows in enumerate(segments(replay)):
        name = f"replay-{index:04d}.safetensors"
        version = segment_version(index, replay)
        entry = old_files.get(name)
        if entry and entry.version == version and link_from and linked(link_from / name, folder / name, entry.bytes):
            files[name] = entry
        else:
            files[name] = write_arrays(folder / name, {"rows": replay.rows[rows]})
            files[name].version = version
    return files


def linkable_files(folder: Path | None) -> dict[str, FileRecord]:
    """The files of a checkpoint by their manifest; none if there is no checkpoint or it is damaged."""
    try:
        return read_manifest(folder).files if folder else {}
    except CheckpointError:
        return {}


def linked(source: Path, destination: Path, size: int) -> bool:
    """Link a file that has the size it should have; False if there is none or the file system has no links."""
    try:
        if source.stat().st_size != size:
            return False
        os.link(source, destination)
    except OSError:
        return False
    return True


def segments(replay: Replay) -> Iterator[slice]:
    """The rows of each segment; to look at them may mean to fetch them from a device."""
    for start in range(0, replay.size, SEGMENT_ROWS):
        yield slice(start, min(start + SEGMENT_ROWS, replay.size))


def segment_version(index: int, replay: Replay) -> int:
    """The number of the newest transition in a segment: it changes whenever the segment does."""
    start = index * SEGMENT_ROWS
    length = min(SEGMENT_ROWS, replay.size - start)
    newest = replay.added - 1
    position = newest % replay.capacity
    if start <= position < start + length:
        return newest
    last_of_segment = start + length - 1
    return newest - (position - last_of_segment) % replay.capacity


def write_arrays(path: Path, arrays: Arrays) -> FileRecord:
    """Write a safetensors file; its manifest entry."""
    content = safetensors.numpy.save({name: np.array(array, order="C") for name, array in arrays.items()})
    write_bytes(path, content)
    return file_record(content)


# --- reading: every value is checked before it is used, as the folder may come from anywhere


def read_checkpoint(folder: Path, replay: ReplayBuffer) -> Checkpoint:
    """Read and check every file; raises CheckpointError if one is not as it was written."""
    manifest = read_manifest(folder)
    buffer = manifest.replay
    if buffer.capacity != replay.capacity:
        raise CheckpointError(f"its replay capacity is {buffer.capacity}, not {replay.capacity}")
    columns = replay.layout.columns
    if manifest.format > 1 and buffer.columns != columns:
        raise CheckpointError(f"the columns of its transitions are {buffer.columns!r}, not {columns}")
    size, length = min(buffer.added, replay.capacity), max(1, buffer.segment_rows)
    starts = {f"replay-{index:04d}.safetensors": start for index, start in enumerate(range(0, size, length))}
    replay_files = {name for name in manifest.files if name.startswith("replay-")}
    if replay_files != starts.keys():
        raise CheckpointError(f"its replay files are not those of {size} transitions in segments of {length}")
    groups = {}
    for name, entry in manifest.files.items():
        arrays = read_arrays(folder, name, entry)
        if name in starts:
            rows, start = arrays.get("rows"), starts[name]
            expected = (min(length, size - start), replay.layout.width)
            if rows is None or rows.shape != expected or rows.dtype != np.float32:
                raise CheckpointError(f"{name} does not hold transitions f32{list(expected)}")
            replay.rows[start : start + len(rows)] = rows
        else:
            groups[name.removesuffix(".safetensors")] = arrays
    replay.added = buffer.added
    if manifest.format == 1:
        groups["learner"] = format_1.today(groups.get("learner", {}))
    return Checkpoint(groups, manifest.state, replay.added, manifest.format)


def read_arrays(folder: Path, name: str, entry: FileRecord) -> Arrays:
    """The arrays of a file, once its size and checksum are those of its manifest entry."""
    size = entry.bytes
    content = read_plain_file(folder / name, size)
    if len(content) != size or hashlib.sha256(content).hexdigest() != entry.sha256:
        raise CheckpointError(f"{name} does not match its checksum")
    try:
        arrays: Arrays = safetensors.numpy.load(content)
    except (safetensors.SafetensorError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{name} is not a safetensors file: {error}") from error
    return arrays
