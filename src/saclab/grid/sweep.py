"""A sweep: several values of some settings, every combination an arm with a name of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple, get_args, get_type_hints

import msgspec

from saclab.errors import SettingError, require
from saclab.other_names import unknown_setting
from saclab.reward_schedule import SETTING as SCHEDULE
from saclab.settings import AlgorithmSettings, TrainingSettings, field_names

EXAMPLE = "polyak_rate=0.001,0.005"


class SweptArm(NamedTuple):
    settings: dict[str, Any]
    suffix: str
    """Of its name, behind the variant's."""


def swept_arms(sweep: Mapping[str, Sequence[Any]]) -> Iterator[SweptArm]:
    """Every combination of a sweep's values, the last setting changing first; without a sweep one arm of no change.

    Raises:
        UserError: for a name that is no setting of the algorithm, or a value of another type.
    """
    converted = {name: converted_values(name, values) for name, values in sweep.items()}
    for combination in product(*converted.values()):
        settings = dict(zip(converted, combination, strict=True))
        yield SweptArm(settings, "".join(f"-{name}-{value_name(value)}" for name, value in settings.items()))


def converted_values(name: str, values: Sequence[Any]) -> tuple[Any, ...]:
    """The different values of a setting, each of its type, so that an arm has one name however it was written."""
    require_algorithm_setting(name)
    require(
        isinstance(values, list | tuple | range) and len(values) > 0,
        "sweep", f"{name}: {values!r}", f"give a list of values, as in {EXAMPLE}",
    )  # fmt: skip
    hint = get_type_hints(AlgorithmSettings)[name]
    try:
        return tuple(dict.fromkeys(msgspec.convert(value, hint) for value in values))
    except msgspec.ValidationError as error:
        raise SettingError("sweep", f"{name}: {values!r}", str(error)) from error


def parse_sweep(texts: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    """A sweep from the words of a command line.

    Args:
        texts: each name=value,value,…; numbers within one value stand apart: hidden_layers=256 256,512 512; terms of
            one reward schedule have a semicolon between them.

    Raises:
        UserError: for a name that is no setting of the algorithm, or a value of another type.
    """
    hints, sweep = get_type_hints(AlgorithmSettings), {}
    for text in texts:
        name, equals, values = text.partition("=")
        name = name.strip().replace("-", "_")
        require(bool(equals) and bool(values.strip()), "sweep", text, f"write a setting and its values: {EXAMPLE}")
        require_algorithm_setting(name)
        require(name not in sweep, "sweep", text, f"{name} is swept already: give all its values at once")
        sweep[name] = tuple(parse_value(name, value.strip(), hints[name]) for value in values.split(","))
    return sweep


def parse_value(name: str, text: str, hint: Any) -> Any:
    """One value of a setting; raises SettingError for text that is none."""
    lists, no_value = "tuple" in str(hint), type(None) in get_args(hint) and text.lower() == "none"
    require(bool(text), "sweep", name, f"a value is missing: write {EXAMPLE}")
    parts = [part.strip() for part in text.split(";")] if name == SCHEDULE else text.split()
    try:
        return msgspec.convert(None if no_value else parts if lists else text, hint, strict=False)
    except msgspec.ValidationError as error:
        raise SettingError("sweep", f"{name}={text}", str(error)) from error


def require_algorithm_setting(name: str) -> None:
    """Raise UserError for what cannot be swept."""
    known = field_names(AlgorithmSettings)
    if name in field_names(TrainingSettings):
        raise SettingError(
            "sweep", name,
            "it is a setting of the training, in which the runs of a comparison must agree: sweep settings of the "
            "algorithm, and compare this one in reports of its own",
        )  # fmt: skip
    if name not in known:
        raise unknown_setting(name, known)


def value_name(value: Any) -> str:
    return "x".join(map(str, value)) if isinstance(value, tuple) else str(value)
