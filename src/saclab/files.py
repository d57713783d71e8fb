"""Where files lie, and how they are written: a crash leaves the old one or the new one, never a part of either."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from saclab.errors import UserError


def absolute(path: Path | str) -> Path:
    """A path that the user has given, as it stays when an environment changes the working directory.

    Raises:
        UserError: if it begins at a working directory that has been removed.
    """
    try:
        return Path(path).absolute()
    except FileNotFoundError as error:
        raise UserError(f"{path}: the working directory does not exist any more: change to another one") from error


def make_folder(folder: Path, option: str) -> None:
    """Make a folder that may be there; raises UserError if that cannot be, with the option that names another."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"cannot write to {folder}: {reason}; name another folder with {option}") from error


@contextmanager
def same_directory() -> Iterator[None]:
    """Go back to this working directory at the end: an environment that was made for a look at it may have left it.

    Processes that are started later find their packages there.
    """
    descriptor = os.open(".", getattr(os, "O_PATH", os.O_RDONLY))
    try:
        yield
    finally:
        os.fchdir(descriptor)
        os.close(descriptor)


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
