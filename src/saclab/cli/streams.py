"""Standard streams that end no command: what they cannot take is dropped, and characters they do not know too."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from contextlib import suppress
from typing import Any

OUTPUTS = {"stdout": 1, "stderr": 2}
"""Name in `sys` -> file descriptor."""


class LastingStream(io.FileIO):
    """A standard stream, from whose first failure on nothing more is written.

    Whoever has closed a pipe or a terminal does not want to see more, and that is all there is to say of it; any other
    failure, such as a full disk, is told once and remembered.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self.lost: OSError | None = None
        """Why something was dropped, unless nobody was there to read it."""
        self.was_terminal = super().isatty()

    def isatty(self) -> bool:
        """Whether it is a terminal on which lines may move and have colours."""
        return super().isatty() and not (os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb")

    def write(self, content: Any) -> int:
        try:
            while (count := super().write(content)) is None:  # whoever shares it has told it not to block
                select.select([], [self], [])
            return count
        except OSError as error:
            if not (error.errno == errno.EPIPE or (self.was_terminal and error.errno == errno.EIO)):
                self.lost = error
            silence(self.fileno())
            if self.lost and self.fileno() != OUTPUTS["stderr"]:
                said = f"saclab: cannot write to standard output ({error.strerror}): going on without it\n"
                with suppress(OSError):
                    os.write(OUTPUTS["stderr"], said.encode())
            return memoryview(content).nbytes


def silence(descriptor: int) -> None:
    """Let a standard stream lead to nowhere, for libraries and other processes too."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def use_lasting_streams() -> None:
    """Put lasting streams in the place of this process's; those that somebody has replaced already stay."""
    open_standard_descriptors()
    for name, descriptor in OUTPUTS.items():
        given = getattr(sys, name)
        if given is not getattr(sys, f"__{name}__"):
            continue
        stream = io.TextIOWrapper(
            io.BufferedWriter(LastingStream(descriptor)),
            encoding=getattr(given, "encoding", "utf-8"),
            errors="replace",
            line_buffering=given is None or given.line_buffering or given.write_through,
        )
        setattr(sys, name, stream)


def open_standard_descriptors() -> None:
    """Let those that were closed when this process began lead to nowhere.

    The next file that is opened, such as a log or a checkpoint, would otherwise become its standard output.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(descriptor, True)


def output_lost() -> bool:
    """Whether something could not be shown to somebody who may want to see it."""
    with suppress(OSError):
        sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return isinstance(raw, LastingStream) and raw.lost is not None
