"""Which checkpoints a run has, and what their manifests tell. It knows no arrays: a report reads manifests too."""

from __future__ import annotations

import hashlib
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from saclab.errors import TrainingFailed
from saclab.records import JSON_BYTES, Damaged, Formatted, Manifest, Unreadable, from_json, read_bytes

FORMAT, OLDEST_FORMAT = 4, 1
MANIFEST, MANIFEST_CHECKSUM = "manifest.json", "manifest.sha256"
SAFE_FILE = re.compile(r"[a-z]+(-\d{4,})?\.safetensors")
CHECKPOINT_NAME = re.compile(r"step-(\d{12,})(?:-update-(\d{12,})|(-untested))?")


class CheckpointError(TrainingFailed):
    """A checkpoint could not be written, or none that is whole could be read."""


class Moment(NamedTuple):
    """When a checkpoint was taken; a later moment is a larger one."""

    steps: int
    round_is_whole: bool = True
    """Whether all updates were made that this many steps make due."""
    updates: int = 0
    """Updates made, where more are due; else 0."""
    tested: bool = True
    """Whether the evaluation that falls into this step, if any, has been made."""

    @property
    def name(self) -> str:
        """The name of the checkpoint's folder."""
        if not self.round_is_whole:
            return f"step-{self.steps:012d}-update-{self.updates:012d}"
        return f"step-{self.steps:012d}" + ("" if self.tested else "-untested")


def moment_named(name: str) -> Moment | None:
    """The moment of the checkpoint whose folder has this name; None if it is none's."""
    if (match := CHECKPOINT_NAME.fullmatch(name)) is None:
        return None
    steps, updates, untested = match.groups()
    return Moment(int(steps), updates is None, int(updates or 0), untested is None)


def moment_of(checkpoint: Path) -> Moment:
    """The moment of a finished checkpoint."""
    moment = moment_named(checkpoint.name)
    assert moment is not None
    return moment


def newest_first(folder: Path) -> list[Path]:
    """The finished checkpoints; none if there is no such folder.

    Raises:
        Unreadable: if it cannot be looked into. A run whose checkpoints were hidden must not begin anew.
    """
    try:
        names = os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise Unreadable(folder, error.strerror or error, "let this process read it") from error
    return sorted((folder / name for name in names if moment_named(name)), key=moment_of, reverse=True)


def visible_checkpoints(folder: Path) -> list[Path]:
    """The same, for those who only look around; none where nothing can be seen."""
    with suppress(Unreadable):
        return newest_first(folder)
    return []


def read_manifest(folder: Path) -> Manifest:
    """The manifest, checked against its own checksum and its schema; raises CheckpointError."""
    content = read_plain_file(folder / MANIFEST, JSON_BYTES)
    expected = read_plain_file(folder / MANIFEST_CHECKSUM, 2 * len(hashlib.sha256().hexdigest()))
    if hashlib.sha256(content).hexdigest() != expected.decode(errors="replace").strip():
        raise CheckpointError(f"{MANIFEST} does not match its checksum")
    try:
        found = from_json(folder / MANIFEST, content, Formatted).format
        if not OLDEST_FORMAT <= found <= FORMAT:
            raise CheckpointError(
                f"it has format {found!r}, and this version of saclab reads formats {OLDEST_FORMAT} to {FORMAT}"
            )
        manifest = from_json(folder / MANIFEST, content, Manifest)
    except Damaged as error:
        raise CheckpointError(f"{MANIFEST} is not what saclab writes: {error.reason}") from error
    for name, entry in manifest.files.items():
        if not SAFE_FILE.fullmatch(name):
            raise CheckpointError(f"its manifest names a file {name!r} that no checkpoint has")
        if entry.sha256 is None:
            raise CheckpointError(f"its manifest has no checksum for {name}")
    return manifest


def read_plain_file(path: Path, limit: int) -> bytes:
    """A file of at most `limit` bytes, which memory must hold; never a link, a pipe or a device."""
    if path.is_symlink():
        raise CheckpointError(f"{path.name} is a link")
    try:
        return read_bytes(path, limit)
    except Damaged as error:
        raise CheckpointError(f"{path.name}: {error.reason}") from error
