"""The errors that a user can mend, and what is said of those that an environment raises."""

from __future__ import annotations

import difflib
import traceback as tracebacks
from collections.abc import Iterable, Mapping
from typing import Any

LONGEST_SHOWN = 200  # characters


class UserError(Exception):
    """Something the user gave cannot work; the message names it and the way out.

    Not a ValueError: the command-line parser would put those into a message of its own. The command line exits with
    status 2.
    """

    traceback = ""
    """Where an environment's own code raised an error, if that is what it is about."""


class SettingError(UserError):
    """A setting's value cannot work."""

    def __init__(self, setting: str, value: object, way_out: str) -> None:
        super().__init__(f"{setting} = {shown(value)}: {way_out}")
        self.setting, self.value, self.way_out = setting, value, way_out


def require(condition: bool, setting: str, value: object, way_out: str) -> None:
    """Raise a SettingError that names the setting, its value and what would work, unless `condition` holds."""
    if not condition:
        raise SettingError(setting, value, way_out)


class TrainingFailed(RuntimeError):  # noqa: N818 - it names what happened
    """A run cannot go on; what it had saved is kept. The command line exits with status 1."""

    traceback = ""
    """Where an environment's own code raised an error, if that is what it is about."""


class RunBroken(TrainingFailed):
    """Something in a run itself, its environment or an update, ends it; the others of its run group go on."""

    def __init__(self, message: str, arrays: Mapping[str, Any] | None = None, traceback: str = "") -> None:
        super().__init__(message)
        self.arrays = dict(arrays or {})
        """Name -> NumPy array: what is left for a look at the step."""
        self.traceback = traceback


class NonFiniteError(RunBroken):
    """An environment or an update gave a number that is not finite."""


def shown(value: object) -> str:
    """A value in an error's line: its middle is left out if it is long."""
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN // 2]}…{text[-LONGEST_SHOWN // 2 :]}"


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that is not among the known ones; suggests the nearest."""
    known = sorted(known)
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    listed = ", ".join(known) if len(known) <= 60 else f"{len(known)} of them"
    return UserError(f"unknown {kind} {shown(name)}: {hint}known: {listed}")


MESSAGE_LETTERS, LINE_LETTERS = 300, 200
LAST_FRAMES, LAST_LINES = 2, 12
TRACEBACK_LETTERS = 1_000_000
LAST_LINE_LETTERS = 20_000


def in_words(error: BaseException) -> str:
    """The kind and the message of anybody's exception, as one line that can be printed."""
    try:
        said = str(error)
    except BaseException:
        said = "(its message cannot be told)"
    line = " ".join(said[: 10 * MESSAGE_LETTERS].split())
    return printable(f"{type(error).__name__}: {line}" if line else type(error).__name__, MESSAGE_LETTERS)


def traceback_of(error: BaseException) -> str:
    """The whole traceback of anybody's exception."""
    try:
        text = "".join(tracebacks.format_exception(error))
    except BaseException:
        text = in_words(error)
    if len(text) > TRACEBACK_LETTERS:
        half = TRACEBACK_LETTERS // 2
        text = f"{text[:half]}\n…\n{text[-half:]}"
    return text.encode(errors="backslashreplace").decode()


def for_terminal(error: BaseException, line: str) -> str:
    """The last lines of an environment's own code, if that is what an error is about, and one of ours."""
    lines = getattr(error, "traceback", "").splitlines()
    frames = [number for number, line in enumerate(lines) if line.startswith("  File ")][-LAST_FRAMES:]
    last = lines[frames[0] if frames else 0 :][:LAST_LINES]
    own = [printable(each, LAST_LINE_LETTERS) for each in f"saclab: {line}".splitlines()]
    return "\n".join([*(printable(each, LINE_LETTERS) for each in last), *own])


def printable(line: str, letters: int) -> str:
    """A line without control characters, cut to a length."""
    cut = line if len(line) <= letters else line[: letters - 1] + "…"
    return "".join(letter if letter.isprintable() else "�" for letter in cut)
