"""Write files so that a crash leaves the old one or the new one, never a part of either."""

from __future__ import annotations

import json
import os
from pathlib import Path

import msgspec


def write_bytes(path: Path, content: bytes) -> None:
    """Write a new file and wait until it is on the disk."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def replace_file(path: Path, content: bytes) -> None:
    """Put a file in the place of one that may exist."""
    temporary = path.with_name(path.name + ".partial")
    write_bytes(temporary, content)
    temporary.replace(path)
    sync(path.parent)


def write_json(path: Path, value: object) -> None:
    """Replace a file by `value`, a record of saclab.records or plain values, as JSON; never one with NaN in it."""
    text = json.dumps(msgspec.to_builtins(value), indent=2, ensure_ascii=False, allow_nan=False)
    replace_file(path, (text + "\n").encode(errors="backslashreplace"))


def sync(folder: Path) -> None:
    """Make renames and new names in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
