"""The version stands in several files, and is one."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import saclab
from saclab.cli.main import main

ROOT = Path(__file__).parents[2]


def test_the_version_is_the_same_everywhere(capsys):
    ours = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert saclab.__version__ == version("saclab") == ours
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"saclab {ours}\n"
    assert re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == ours
    assert re.search(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == ours


def test_the_hosted_checks_run_what_the_makefile_has():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    hosted = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    ours = (ROOT / ".ci" / "run").read_text()
    assert called_in(hosted) | called_in(ours) <= targets
    assert {"lint", "types", "docs", "test", "test-slow", "wheel"} <= called_in(ours)
    assert {"lint", "types", "docs"} <= called_in(hosted)
    assert "run: .ci/run" in hosted
    published = (ROOT / ".github" / "workflows" / "publish.yml").read_text()
    assert "run: .ci/run" in published, "nothing untested is published"


def called_in(text: str) -> set[str]:
    return {target for line in re.findall(r"\bmake ([a-z -]+)", text) for target in line.split()}
