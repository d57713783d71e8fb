"""docs/extend.md does what it says: its code is applied to a copy of the sources, and its commands are run there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "extend.md"
COPIED = ("src", "tests", "pyproject.toml")
BLOCK = re.compile(r'^```(\w+)(?: title="([^"\n]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    language: str
    title: str
    """The file that it belongs to; none for commands."""
    text: str


def sections() -> dict[str, list[Block]]:
    """The blocks below each heading that has some."""
    found = {}
    for part in PAGE.read_text().split("\n## ")[1:]:
        heading, _, text = part.partition("\n")
        found[heading] = [Block(*groups) for groups in BLOCK.findall(text)]
    return found


def write(tree: Path, block: Block) -> None:
    """Put a block where its title says: into a new file, to the end of one, or in the place of a diff's lines."""
    path = tree / block.title
    if block.language == "diff":
        text, old, new = path.read_text(), side(block.text, "-"), side(block.text, "+")
        assert text.count(old) == 1, f"{block.title} has these lines {text.count(old)} times:\n{old}"
        path.write_text(text.replace(old, new))
    elif path.exists():
        path.write_text(f"{path.read_text()}\n\n{block.text}")
    else:
        path.write_text(block.text)


def side(diff: str, sign: str) -> str:
    """The lines of a diff before ("-") or after ("+")."""
    lines = [line or " " for line in diff.splitlines()]
    assert {line[0] for line in lines} <= set(" -+"), "each line of a diff begins with a blank, - or +"
    return "".join(f"{line[1:]}\n" for line in lines if line[0] in (" ", sign))


def run(tree: Path, commands: str) -> str:
    """What the commands print, in `tree` and with the program and the tests that lie there."""
    path = os.pathsep.join([str(tree / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    variables = {"PATH": path, "PYTHONPATH": str(tree / "src"), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", commands], cwd=tree, env=os.environ | variables, timeout=600,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert done.returncode == 0, f"{commands}\n{done.stdout}"
    return done.stdout


@pytest.fixture
def tree(tmp_path):
    """A copy of the sources, with a program `saclab` that runs them."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        else:
            shutil.copy(ROOT / name, tmp_path / name)
    program = tmp_path / "bin" / "saclab"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -P -m saclab "$@"\n')
    program.chmod(0o755)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("heading", list(sections()))
def test_the_steps_of_a_section_work(tree, heading):
    blocks = sections()[heading]
    for block in blocks:
        if block.language != "bash":
            write(tree, block)
    written = " ".join(sorted({block.title for block in blocks if block.title}))
    run(tree, f"ruff check --quiet {written} && ruff format --check --quiet {written}")
    printed = [run(tree, block.text) for block in blocks if block.language == "bash"]
    assert any(re.search(r"\d+ passed", text) for text in printed)
    assert any("finished: max_updates = 30 reached" in text for text in printed)


def test_every_section_has_code_and_commands():
    assert len(sections()) == 4
    for blocks in sections().values():
        assert {block.language for block in blocks} <= {"python", "diff", "bash"}
        assert all(bool(block.title) == (block.language != "bash") for block in blocks)
        assert [block.title for block in blocks if block.language != "bash"]
        assert [block for block in blocks if block.language == "bash"]
    assert PAGE.read_text().count("\n```") == 2 * sum(map(len, sections().values())), "a block was not understood"


def test_a_diff_whose_lines_have_changed_is_found_out(tmp_path):
    (tmp_path / "file").write_text("one\ntwo\n")
    write(tmp_path, Block("diff", "file", " one\n-two\n+three\n"))
    assert (tmp_path / "file").read_text() == "one\nthree\n"
    with pytest.raises(AssertionError, match="0 times"):
        write(tmp_path, Block("diff", "file", "-two\n+three\n"))
