"""Packages that only some commands need."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from saclab.errors import UserError


def required(module: str, extra: str, option: str) -> Any:
    """Import an optional package, or raise a UserError that says which option needs it and how to install it.

    saclab is on no index yet, so what is installed is a checkout: `pip install '.[extra]'` in its folder.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise UserError(
            f"{option} needs the package {module}: pip install '.[{extra}]' in the folder of saclab's sources"
        ) from error
