"""What can happen to a run folder: every kind of damage that a disk, a person or an enemy does to one of its files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

OTHER_VALUES = (
    None, True, 0, -1, 1, 1.5, 10**30, 2**63, 1e308, "", "NaN", "../../etc/passwd", "=cmd|' /C calc'!A0", "é\u2028\x00",
    [], [1], {}, {"a": []}, [[[[]]]],
)  # fmt: skip
OTHER_TEXTS = (
    b"NaN", b"1e999", b"-Infinity", b"[" * 50_000, b"{" * 5000, b'"\\ud800"', b"\xff\xfe", b"1" * 5000, b"", b"[1]",
    b"1_0", b"'", b"9" * 200_000,
)  # fmt: skip
NUMBER_OR_WORD = b"0123456789.-eE+"

SHARE = st.floats(0, 1, exclude_max=True)
Damage = tuple[str, str | float, float, int]
"""Kind, which file (its name, or a share of the list), where in it as a share, and which value."""
damages = st.tuples(
    st.sampled_from((
        "cut", "flip", "put", "value", "delete", "duplicate line", "drop line", "swap lines", "duplicate column",
        "swap files", "directory", "dangling link", "link to itself", "pipe", "parent becomes file", "append",
        "hostile manifest",
    )),
    st.just("evaluations.csv") | SHARE, SHARE, st.integers(0, 255),
)  # fmt: skip


def apply(run: Path, damage: Damage) -> None:
    """Do it to a file of the folder, if there is one left. A hostile manifest has the checksum that belongs to it."""
    kind, which, where, choice = damage
    files = sorted(path for path in run.rglob("*") if path.is_file() and not path.is_symlink())
    if not files:
        return
    named = [path for path in files if path.name == which]
    path = named[0] if named else files[0 if isinstance(which, str) else int(which * len(files))]
    other = files[int(where * len(files))]
    content = path.read_bytes()
    place = int(where * len(content))
    if kind in ("delete", "directory", "dangling link", "link to itself", "pipe"):
        path.unlink()
    match kind:
        case "cut":
            path.write_bytes(content[:place])
        case "flip" if content:
            path.write_bytes(content[:place] + bytes([content[place] ^ (choice or 1)]) + content[place + 1 :])
        case "put":
            path.write_bytes(with_text(content, place, OTHER_TEXTS[choice % len(OTHER_TEXTS)]))
        case "value":
            path.write_bytes(with_value(content, where, OTHER_VALUES[choice % len(OTHER_VALUES)]))
        case "duplicate line" | "drop line" | "swap lines" | "duplicate column":
            path.write_bytes(b"".join(with_lines(content.splitlines(keepends=True), kind, where)))
        case "swap files":
            path.write_bytes(other.read_bytes())
            other.write_bytes(content)
        case "directory":
            path.mkdir()
        case "dangling link":
            path.symlink_to(run / "nowhere")
        case "link to itself":
            path.symlink_to(path)
        case "pipe":
            os.mkfifo(path)
        case "parent becomes file" if path.parent != run:
            shutil.rmtree(path.parent)
            path.parent.write_bytes(content)
        case "hostile manifest":
            manifests = [path for path in files if path.name == "manifest.json"
                         and path.with_name("manifest.sha256") in files]  # fmt: skip
            if manifests:
                path = manifests[choice % len(manifests)]
                content = with_value(path.read_bytes(), where, OTHER_VALUES[choice % len(OTHER_VALUES)])
                path.write_bytes(content)
                path.with_name("manifest.sha256").write_text(hashlib.sha256(content).hexdigest() + "\n")
        case "append":
            path.write_bytes(content + OTHER_TEXTS[choice % len(OTHER_TEXTS)] + b"\n" * (choice % 2))


def with_text(content: bytes, place: int, text: bytes) -> bytes:
    """Another text in the place of the number or word at a place."""
    start = end = place
    while start > 0 and content[start - 1 : start] in [NUMBER_OR_WORD[i : i + 1] for i in range(len(NUMBER_OR_WORD))]:
        start -= 1
    while end < len(content) and content[end] in NUMBER_OR_WORD:
        end += 1
    return content[:start] + text + content[max(end, place + 1) :]


def with_value(content: bytes, where: float, value: Any) -> bytes:
    """Another value somewhere in JSON, or in a line of it; what is no JSON stays."""
    for separator in (b"\0", b"\n"):
        parts = content.split(separator)
        index = int(where * len(parts))
        try:
            found = json.loads(parts[index])
        except ValueError:
            continue
        holders = list(places(found))
        if holders:
            holder, key = holders[int(where * 997) % len(holders)]
            holder[key] = value
        parts[index] = json.dumps(found).encode()
        return separator.join(parts)
    return content


def places(value: Any) -> Any:
    """(holder, key) of every entry of a JSON value."""
    for key, part in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield value, key
        yield from places(part)


def with_lines(lines: list[bytes], kind: str, where: float) -> list[bytes]:
    if not lines:
        return lines
    index = int(where * len(lines))
    match kind:
        case "duplicate line":
            return [*lines[: index + 1], *lines[index:]]
        case "drop line":
            return lines[:index] + lines[index + 1 :]
        case "swap lines":
            return [*lines[:index], *lines[index + 1 :], lines[index]]
    column = int(where * 7)
    return [line.rstrip(b"\n") + b"," + line.rstrip(b"\n").split(b",")[column % (line.count(b",") + 1)] + b"\n"
            for line in lines]  # fmt: skip
