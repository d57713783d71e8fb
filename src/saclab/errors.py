"""The errors that a user can mend. The command line prints each as one line and exits with status 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class UserError(Exception):
    """Something the user gave cannot work; the message names it and the way out.

    Not a ValueError: the command-line parser would put those into a message of its own.
    """


class SettingError(UserError):
    """A setting's value cannot work."""

    def __init__(self, setting: str, value: object, way_out: str) -> None:
        text = repr(value)
        super().__init__(f"{setting} = {text if len(text) <= 200 else text[:199] + '…'}: {way_out}")
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


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that is not among the known ones; suggests the nearest."""
    known = sorted(known)
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    listed = ", ".join(known) if len(known) <= 60 else f"{len(known)} of them"
    return UserError(f"unknown {kind} {name!r}: {hint}known: {listed}")
