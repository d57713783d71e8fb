"""The rooms of the house: imports go down only, never in a circle; no file, no function and no test's name is long."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import saclab

HOUSE = Path(saclab.__file__).parent
ROOMS = (
    "children", "errors", "extras", "files", "limits", "other_names", "reward_schedule", "refusals", "settings",
    "config", "variants", "protocols", "machine", "records", "hub", "algorithm", "environments", "replay", "memory",
    "trained_policy", "onnx_export", "training", "signals", "exits", "trackers", "batch", "grid", "report",
    "playback", "play", "sharing", "tuning", "api", "cli",
)  # fmt: skip
"""From the ground up: a room imports itself and what stands before it."""
FILE_LINES, FUNCTION_LINES, NAME_LETTERS = 350, 55, 70
FILES = {path.relative_to(HOUSE.parent).with_suffix("").as_posix().replace("/", "."): path
         for path in sorted(HOUSE.rglob("*.py")) if path.name not in ("__init__.py", "__main__.py")}  # fmt: skip


def imported(path: Path) -> set[str]:
    """The modules of saclab that a file imports, wherever it does, but for those of which it wants the types only."""
    found: set[str] = set()
    tree = ast.parse(path.read_text())
    for_types = {line for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
                 for line in range(node.lineno, node.end_lineno + 1)}  # fmt: skip
    for node in ast.walk(tree):
        if getattr(node, "lineno", 0) in for_types:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("saclab."):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found & FILES.keys()


IMPORTS = {module: imported(path) for module, path in FILES.items()}


def test_nothing_imports_upward():
    def floor(module: str) -> int:
        return ROOMS.index(module.split(".")[1])

    upward = [f"{module} imports {other}" for module, others in IMPORTS.items() for other in others
              if floor(other) > floor(module)]  # fmt: skip
    assert upward == []


def test_a_report_knows_nothing_of_grids():
    assert [name for name in IMPORTS if name.startswith("saclab.report.")], "there are files to look at"
    assert not [name for name, others in IMPORTS.items() if name.startswith("saclab.report.")
                for other in others if other.startswith(("saclab.grid", "saclab.batch"))]  # fmt: skip


def test_imports_make_no_circle():
    left = dict(IMPORTS)
    while free := [module for module, others in left.items() if not others & left.keys()]:
        for module in free:
            del left[module]
    assert sorted(left) == []


@pytest.mark.parametrize("module", FILES)
def test_no_file_and_no_function_is_long(module):
    text = FILES[module].read_text()
    assert text.count("\n") <= FILE_LINES
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < FUNCTION_LINES, node.name


def test_names_of_tests_are_short():
    """A name says what holds; the rest of the sentence is the docstring's."""
    trees = [ast.parse(path.read_text()) for path in Path(__file__).parent.rglob("test_*.py")]
    names = [node.name for tree in trees for node in ast.walk(tree)
             if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]  # fmt: skip
    assert len(names) > 300
    assert [name for name in names if len(name) > NAME_LETTERS] == []
