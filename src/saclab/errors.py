"""The errors that a user can mend. The command line prints each as one line and exits with status 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

LONGEST_SHOWN = 200  # characters


class UserError(Exception):
    """Something the user gave cannot work; the message names it and the way out.

    Not a ValueError: the command-line parser would put those into a message of its own.
    """


class SettingError(UserError):
    """A setting's value cannot work."""

    def __init__(self, setting: str, value: object, way_out: str) -> None:
        super().__init__(f"{setting} = {shown(value)}: {way_out}")
        self.setting, self.value, self.way_out = setting, value, way_out


class TrainingFailed(RuntimeError):  # noqa: N818 - it names what happened
    """A run cannot go on; what it had saved is kept. The command line exits with status 1."""


class RunBroken(TrainingFailed):
    """Something in a run itself, its environment or an update, ends it; the others of its run group go on."""

    def __init__(self, message: str, arrays: Mapping[str, Any] | None = None, traceback: str = "") -> None:
        super().__init__(message)
        self.arrays = dict(arrays or {})
        """Name -> NumPy array: what is left for a look at the step."""
        self.traceback = traceback
        """Where an environment's code raised an error, if it did."""


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
