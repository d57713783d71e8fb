"""The settings as options of the command line, of which only those come back that were given."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict, get_type_hints

from tyro.conf import OmitArgPrefixes, arg

from saclab.config import Config
from saclab.files import absolute
from saclab.hub import is_address
from saclab.protocols import own_config
from saclab.settings import AlgorithmSettings, TrainingSettings, field_names

HELP = ("-h", "--help")
AN_ENVIRONMENT = re.compile(r"-v\d+$")


def with_settings(command: type, arguments: Sequence[str]) -> Any:
    """A command whose `algorithm` and `training` are dictionaries: tyro leaves out what was not given.

    If help is asked for, it shows the values that the environment, variant and protocol on the line would have.
    """
    shown = named_config(arguments) if set(HELP) & set(arguments[1:]) else None
    kinds = {"algorithm": AlgorithmSettings, "training": TrainingSettings}
    bare: Any = OmitArgPrefixes
    fields = [(name, bare[options_of(kind, getattr(shown, name, None))]) for name, kind in kinds.items()]
    return dataclasses.make_dataclass(
        command.__name__, fields, bases=(command,), namespace={"__doc__": command.__doc__}, frozen=True
    )


def named_config(arguments: Sequence[str]) -> Config:
    """The configuration that a line names so far; raises UserError for an unknown name."""
    line = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    line.add_argument("--variant", default="sac-auto")
    line.add_argument("--protocol", default="standard")
    named, _ = line.parse_known_args(arguments)
    environment = next(filter(AN_ENVIRONMENT.search, arguments), "HalfCheetah-v4")
    return own_config(environment, named.variant, named.protocol)


def options_of(kind: type[AlgorithmSettings | TrainingSettings], shown: object) -> Any:
    """A dictionary type with an option per setting: with its docstring and the value in `shown` if there is any."""
    hints, told = get_type_hints(kind), docstrings(kind) if shown else {}
    entries = {}
    for name in field_names(kind):
        option = arg(help=told.get(name, ""), help_behavior_hint=default_text(getattr(shown, name, None)))
        entries[name] = Annotated[hints[name], option]
    dictionary: Any = TypedDict
    made = dictionary(kind.__name__, entries, total=False)
    made.__doc__ = kind.__doc__
    return made


def with_absolute_paths(command: Any) -> Any:
    """A command with every path of its line as it stays when an environment changes the working directory."""

    def stable(value: Any) -> Any:
        match value:
            case Path():
                return value if is_address(value) else absolute(value)
            case tuple():
                return tuple(map(stable, value))
        return with_absolute_paths(value) if dataclasses.is_dataclass(value) else value

    return dataclasses.replace(
        command, **{field.name: stable(getattr(command, field.name)) for field in dataclasses.fields(command)}
    )


def default_text(value: object) -> str:
    words = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return f"(default: {words})"


def docstrings(kind: type) -> Mapping[str, str]:
    """The docstring below each field of a dataclass, as one line."""
    (definition,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in zip(definition.body, definition.body[1:]):
        match field, below:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(text.split())
    return found
