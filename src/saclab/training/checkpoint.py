"""Checkpoints: written whole or not at all, checksummed, never unpickled, and cheap to take often.

    checkpoints/step-000000012000/
      learner.safetensors, environments.safetensors, …   one file per group of arrays
      replay-0000.safetensors, …                         the replay buffer, SEGMENT_ROWS rows each
      manifest.json                                      every file's SHA-256 and size, and the plain state
      manifest.sha256                                    the manifest's own

The newest two are kept. A segment of the replay buffer that has not changed since the checkpoint before the last is
hard-linked from it, not written again; never from the last one, so that the two kept checkpoints share no file and
damage to one leaves the other whole.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy

from saclab.errors import TrainingFailed
from saclab.replay import ReplayBuffer

FORMAT = 1
KEPT = 2
SEGMENT_ROWS = 8192
MANIFEST, MANIFEST_CHECKSUM = "manifest.json", "manifest.sha256"
SAFE_FILE = re.compile(r"[a-z]+(-\d{4,})?\.safetensors")

Arrays = dict[str, np.ndarray]


class CheckpointError(TrainingFailed):
    """A checkpoint could not be written, or none that is whole could be read."""


class Checkpoint(NamedTuple):
    groups: dict[str, Arrays]
    """Group -> name -> array."""
    state: dict[str, Any]
    """JSON-able."""


def save_checkpoint(folder: Path, step: int, checkpoint: Checkpoint, replay: ReplayBuffer) -> Path:
    """Write `folder`/step-… and remove all but the newest two; an existing one of the same step stays.

    Raises:
        CheckpointError: if it cannot be written; what was there before is whole.
    """
    final = folder / f"step-{step:012d}"
    if final.exists():
        return final
    partial = final.with_suffix(".partial")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_unfinished(folder)
        partial.mkdir()
        write_files(partial, checkpoint, replay, link_from=replaced_by_next(folder))
        sync(partial)
        partial.rename(final)
        sync(folder)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        kept = newest_first(folder)
        reason = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else str(error)
        raise CheckpointError(
            f"cannot save {final}: {reason}. "
            + (f"The last good checkpoint, {kept[0].name}, is kept" if kept else "There is no earlier checkpoint")
            + f"; make room, then continue with: saclab resume {folder.parent}"
        ) from error
    for old in newest_first(folder)[KEPT:]:
        shutil.rmtree(old)
    return final


def load_newest_checkpoint(folder: Path, replay: ReplayBuffer, warn: Callable[[str], None]) -> Checkpoint | None:
    """The newest checkpoint that is whole, its transitions put into `replay`; None if there is none at all.

    Raises:
        CheckpointError: if there are checkpoints and every one is damaged.
    """
    problems = []
    for path in newest_first(folder):
        try:
            return read_checkpoint(path, replay)
        except (CheckpointError, OSError) as error:
            problems.append(f"{path} is damaged: {error}")
            warn(problems[-1] + "; the one before it is tried")
    if problems:
        raise CheckpointError("no checkpoint can be used. " + "; ".join(problems))
    return None


def newest_first(folder: Path) -> list[Path]:
    """The finished checkpoints."""
    return sorted((path for path in folder.glob("step-*") if path.suffix != ".partial"), reverse=True)


def replaced_by_next(folder: Path) -> Path | None:
    """The checkpoint that will be removed once the next one is written."""
    existing = newest_first(folder)
    return existing[KEPT - 1] if len(existing) >= KEPT else None


def remove_unfinished(folder: Path) -> None:
    for path in folder.glob("step-*.partial"):
        shutil.rmtree(path)


# --- writing


def write_files(folder: Path, checkpoint: Checkpoint, replay: ReplayBuffer, link_from: Path | None) -> None:
    files = {
        f"{group}.safetensors": write_arrays(folder / f"{group}.safetensors", arrays)
        for group, arrays in checkpoint.groups.items()
    }
    files |= write_replay(folder, replay, link_from)
    manifest = {
        "format": FORMAT,
        "files": files,
        "replay": {"added": replay.added, "capacity": replay.capacity, "segment_rows": SEGMENT_ROWS},
        "state": checkpoint.state,
    }
    content = json.dumps(manifest, indent=1).encode()
    write_bytes(folder / MANIFEST, content)
    write_bytes(folder / MANIFEST_CHECKSUM, (hashlib.sha256(content).hexdigest() + "\n").encode())


def write_replay(folder: Path, replay: ReplayBuffer, link_from: Path | None) -> dict[str, dict[str, Any]]:
    """Write the changed segments and link the others; `version` tells whether a segment has changed."""
    old_files: dict[str, dict[str, Any]] = read_manifest(link_from)["files"] if link_from else {}
    files = {}
    for index, rows in enumerate(segments(replay)):
        name = f"replay-{index:04d}.safetensors"
        version = segment_version(index, replay)
        if link_from and old_files.get(name, {}).get("version") == version:
            link_or_copy(link_from / name, folder / name)
            files[name] = old_files[name]
        else:
            files[name] = write_arrays(folder / name, {"rows": rows}) | {"version": version}
    return files


def segments(replay: ReplayBuffer) -> Iterator[np.ndarray]:
    for start in range(0, replay.size, SEGMENT_ROWS):
        yield replay.rows[start : min(start + SEGMENT_ROWS, replay.size)]


def segment_version(index: int, replay: ReplayBuffer) -> int:
    """The number of the newest transition in a segment: it changes whenever the segment does."""
    start = index * SEGMENT_ROWS
    length = min(SEGMENT_ROWS, replay.size - start)
    newest = replay.added - 1
    position = newest % replay.capacity
    if start <= position < start + length:
        return newest
    last_of_segment = start + length - 1
    return newest - (position - last_of_segment) % replay.capacity


def write_arrays(path: Path, arrays: Arrays) -> dict[str, Any]:
    """Write a safetensors file; its manifest entry."""
    content = safetensors.numpy.save({name: np.array(array, order="C") for name, array in arrays.items()})
    write_bytes(path, content)
    return {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}


def write_bytes(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def link_or_copy(source: Path, destination: Path) -> None:
    try:
        os.link(source, destination)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, destination)


def sync(folder: Path) -> None:
    """Make renames and new names in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# --- reading


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest, checked against its own checksum."""
    content = (folder / MANIFEST).read_bytes()
    expected = (folder / MANIFEST_CHECKSUM).read_bytes().decode(errors="replace").strip()
    if hashlib.sha256(content).hexdigest() != expected:
        raise CheckpointError(f"{MANIFEST} does not match its checksum")
    manifest: dict[str, Any] = json.loads(content)
    if manifest["format"] != FORMAT:
        raise CheckpointError(f"it has format {manifest['format']}, and this version of saclab reads {FORMAT}")
    return manifest


def read_checkpoint(folder: Path, replay: ReplayBuffer) -> Checkpoint:
    """Read and check every file; raises CheckpointError if one is not as it was written."""
    manifest = read_manifest(folder)
    groups = {}
    if manifest["replay"]["capacity"] != replay.capacity:
        raise CheckpointError(f"its replay capacity is {manifest['replay']['capacity']}, not {replay.capacity}")
    for name, entry in manifest["files"].items():
        arrays = read_arrays(folder, name, entry)
        stem = name.removesuffix(".safetensors")
        if stem.startswith("replay-"):
            start = int(stem.removeprefix("replay-")) * manifest["replay"]["segment_rows"]
            replay.rows[start : start + len(arrays["rows"])] = arrays["rows"]
        else:
            groups[stem] = arrays
    replay.added = manifest["replay"]["added"]
    return Checkpoint(groups, manifest["state"])


def read_arrays(folder: Path, name: str, entry: dict[str, Any]) -> Arrays:
    if not SAFE_FILE.fullmatch(name):
        raise CheckpointError(f"its manifest names a file {name!r} that no checkpoint has")
    content = (folder / name).read_bytes()
    if len(content) != entry["bytes"] or hashlib.sha256(content).hexdigest() != entry["sha256"]:
        raise CheckpointError(f"{name} does not match its checksum")
    arrays: Arrays = safetensors.numpy.load(content)
    return arrays
