"""What of a run tells of the machine that it ran on, and is not for others."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from saclab.config import Config
from saclab.errors import UserError
from saclab.records import Prefilled, Result, RunDescription

ABSOLUTE_PATH = re.compile(r"(?<![\w./])(~?/(?:[\w.~]|-\w)|(?<!:)//[\w.-]|~\w+/|[A-Za-z]:[\\/]|\\\\\w)|\bfile:")
"""Absolute paths of any system, ~/…, and file:…, anywhere in a text; not https://…, package.module:Name or a/b."""


def texts(value: Any, at: str = "") -> Iterator[tuple[str, str]]:
    """Every text within plain values, keys too, with the place where it stands."""
    if isinstance(value, str):
        yield at, value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield at, key
            yield from texts(each, f"{at}.{key}" if at else key)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from texts(each, at)


def require_no_paths(values: Any) -> None:
    """Raise UserError for a text that is, or holds, a path of this machine."""
    home = str(Path.home())
    for at, text in texts(values):
        if ABSOLUTE_PATH.search(text) or (len(home) > 1 and home in text):
            raise UserError(
                f"{at} = {text!r} is a path of this machine, which others have not got and would see: train with what "
                "they have too, such as a file of a package, or publish it all the same with --paths-too"
            )


def public_description(description: RunDescription) -> RunDescription:
    """config.json without the machine: its processor, its system, its cores, its environment variables.

    What the run began with is told by its content, not by where it lay.
    """
    config = public_config(Config.from_dict(description.config), description.prefill).to_dict()
    return msgspec.structs.replace(description, machine={}, config=config)


def public_config(config: Config, prefill: Prefilled | None) -> Config:
    """A configuration whose prefill is named by the SHA-256 of its content, where it is a path."""
    kind, place = config.training.prefill_source or ("", "")
    if prefill is None or not ABSOLUTE_PATH.search(place):
        return config
    named = dataclasses.replace(config.training, prefill=f"{kind}:{prefill.sha256}")
    return dataclasses.replace(config, training=named)


def public_result(result: Result) -> Result:
    """result.json without the checksums of files that are not published, or not as they lie here."""
    return msgspec.structs.replace(result, files={})
