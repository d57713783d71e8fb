"""The map of the house in CONTRIBUTING.md shows the house as it is."""

from __future__ import annotations

from pathlib import Path

from test_rooms import IMPORTS

ROOT = Path(__file__).parents[2]
MAP = (ROOT / "CONTRIBUTING.md").read_text().split("\n```\n")[1]
NO_LINE = ("__init__.py", "__main__.py")


def mapped() -> list[str]:
    """Paths of the files on the map, below src/saclab."""
    found, folders = [], [""]
    for line in MAP.split("tests/ ")[0].splitlines()[1:]:
        name, depth = line.split()[0] if line.strip() else "", (len(line) - len(line.lstrip())) // 2
        if name.endswith("/"):
            folders[depth - 1 :] = [name]
        elif name:
            found.append("".join(folders[: depth - 1]) + name)
    return found


def test_every_file_has_one_line_on_the_map_and_every_line_a_file():
    house = ROOT / "src" / "saclab"
    files = [path.relative_to(house).as_posix() for path in house.rglob("*.py") if path.name not in NO_LINE]
    assert sorted(mapped()) == sorted(files)


def test_a_file_imports_only_what_stands_above_it():
    place = {"saclab." + path.removesuffix(".py").replace("/", "."): number for number, path in enumerate(mapped())}
    assert [f"{module} imports {other}" for module, others in IMPORTS.items() for other in others
            if place[other] > place[module]] == []  # fmt: skip
