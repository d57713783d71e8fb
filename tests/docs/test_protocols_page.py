"""The tables of docs/protocols.md are the rows of saclab.protocols."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from saclab.protocols import PROTOCOLS, protocol_settings
from saclab.settings import AlgorithmSettings, TrainingSettings

PAGE = Path(__file__).parents[2] / "docs" / "protocols.md"
DEFAULTS = {field.name: field.default for cls in (TrainingSettings, AlgorithmSettings)
            for field in dataclasses.fields(cls)}  # fmt: skip


def words(value: Any) -> str:
    """A value as the page writes it."""
    if value is None:
        return "–"
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def settings_table() -> str:
    """Every setting that a protocol changes, on an environment that none has a row of its own for."""
    said = {name: protocol_settings(name, "Name-v0") for name in PROTOCOLS}
    changed = [name for name in DEFAULTS if any(row.get(name, DEFAULTS[name]) != DEFAULTS[name]
                                                for row in said.values())]  # fmt: skip
    rows = [[f"`{name}`", *(words(row.get(name, DEFAULTS[name])) for row in said.values())] for name in changed]
    seeds = ["seeds of a comparison", *(str(row.seeds) for row in PROTOCOLS.values())]
    return table(["", *(f"`{name}`" for name in PROTOCOLS)], [*rows, seeds])


def exceptions_table() -> str:
    """What a protocol changes further on some environments."""
    rows = [[f"`{name}`", f"{prefix}…", f"`{setting}`", words(value)]
            for name, protocol in PROTOCOLS.items()
            for prefix, settings in protocol.by_environment.items()
            for setting, value in settings.items()]  # fmt: skip
    return table(["protocol", "environment", "setting", "value"], rows)


def ceilings_table() -> str:
    """To what a protocol holds a variant's own settings."""
    rows = [[f"`{name}`", f"`{setting}`", words(value)]
            for name, protocol in PROTOCOLS.items()
            for setting, value in protocol.ceilings.items()]  # fmt: skip
    return table(["protocol", "setting", "at most"], rows)


def test_the_tables_are_the_rows_of_the_protocols():
    page = PAGE.read_text()
    for wanted in (settings_table(), exceptions_table(), ceilings_table()):
        assert f"\n\n{wanted}\n" in page, f"put this into {PAGE.name}:\n{wanted}"


def test_each_protocol_is_told_of_in_words():
    for name in PROTOCOLS:
        assert f"\n- **`{name}`**" in PAGE.read_text()
