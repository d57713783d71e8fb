"""Which checkpoints a run has, and what their manifests tell. It knows no arrays: a report reads manifests too."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from saclab.errors import TrainingFailed
from saclab.records import JSON_BYTES, Damaged, Formatted, Manifest, from_json, read_bytes

FORMAT, OLDEST_FORMAT = 3, 1
MANIFEST, MANIFEST_CHECKSUM = "manifest.json", "manifest.sha256"
SAFE_FILE = re.compile(r"[a-z]+(-\d{4,})?\.safetensors")
CHECKPOINT_NAME = re.compile(r"step-(\d{12,})(-untested)?")


class CheckpointError(TrainingFailed):
    """A checkpoint could not be written, or none that is whole could be read."""


def step_of(checkpoint: Path) -> int:
    return int(checkpoint.name.split("-")[1])


def newest_first(folder: Path) -> list[Path]:
    """The finished checkpoints."""
    found = [(match, path) for path in folder.glob("step-*") if (match := CHECKPOINT_NAME.fullmatch(path.name))]
    found.sort(key=lambda pair: (int(pair[0][1]), pair[0][2] is None), reverse=True)
    return [path for _, path in found]


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
