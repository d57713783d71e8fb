"""One process at a time works on a run folder."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from saclab.children import kept_from_children
from saclab.errors import UserError

RETRY_SECONDS = 0.5
LOOKS, LOOK_SECONDS = 5, 0.02  # `holder` has the lock for a moment, too: who finds it taken looks again


class InUse(UserError):  # noqa: N818 - it names what is
    """Another process works on the run folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the run folder; the system lets go of it when the process ends, however it ends.

    Raises:
        InUse: if another process holds it, with that one's id.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("a+") as file:
        if not taken(file, fcntl.LOCK_EX, LOOKS):
            file.seek(0)
            process = file.read(20).strip() or "?"
            if process == str(os.getpid()):
                raise InUse(f"{folder} is in use by this process: close the iterator of its events first")
            raise InUse(f"{folder} is in use by process {process}: wait for it, or stop it first")
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        with kept_from_children(file.fileno()):
            yield


def taken(file: IO[str], kind: int, looks: int = 1) -> bool:
    """Take a lock, unless another process keeps it for all of the looks."""
    for look in range(looks):
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(LOOK_SECONDS * (look + 1 < looks))
    return False


def holder(folder: Path) -> str | None:
    """The id of the process that works on the run folder; None if there is none."""
    try:
        with (folder / "lock").open() as file:
            return None if taken(file, fcntl.LOCK_SH) else file.read(20).strip() or "?"
    except OSError:
        return None


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process is in here with this folder; a file system that knows no locks lets all in.

    Raises:
        OSError: if the folder cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def wait_until_free(folder: Path, seconds: float) -> None:
    """Wait for another process to let go of the run folder, at most so long."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with suppress(UserError), locked(folder):
            return
        time.sleep(RETRY_SECONDS)
