"""One process at a time works on a run folder."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from saclab.errors import UserError

RETRY_SECONDS = 0.5


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the run folder; the system lets go of it when the process ends, however it ends.

    Raises:
        UserError: if another process holds it, with that one's id.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise UserError(
                f"{folder} is in use by process {file.read(20).strip() or '?'}: wait for it, or stop it first"
            ) from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def wait_until_free(folder: Path, seconds: float) -> None:
    """Wait for another process to let go of the run folder, at most so long."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with suppress(UserError), locked(folder):
            return
        time.sleep(RETRY_SECONDS)
