"""The data of docs/averaging.md that this repository holds: small, and enough to make its page again."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from saclab.report.report import write_report
from saclab.training.run_folder import find_runs, is_finished

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "averaging"


def test_the_runs_are_small_and_all_finished():
    runs = find_runs([EXAMPLE / "runs"])
    assert all(is_finished(run) for run in runs)
    assert sum(path.stat().st_size for path in (EXAMPLE / "runs").rglob("*") if path.is_file()) < 10e6


def test_the_page_comes_again_from_them(tmp_path):
    page = write_report(find_runs([EXAMPLE / "runs"]), tmp_path)
    assert page.stat().st_size < 3e6
    assert "averaged-spacing-200" in page.read_text()
    kept = EXAMPLE / "report"
    assert (tmp_path / "scores.csv").read_text() == (kept / "scores.csv").read_text(), "saclab report makes it again"
    assert len((kept / "index.html").read_text().splitlines()) == len(page.read_text().splitlines())


@pytest.fixture(scope="module")
def printed() -> str:
    """The planned comparisons, as the command prints them."""
    command = [sys.executable, EXAMPLE / "results.py"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_tables_of_the_page_are_those_that_the_command_prints(printed):
    assert "| `averaged` | 5 |" in printed
    assert "| `averaged` | 3 |" in printed, "of Humanoid-v4"
    page = (ROOT / "docs" / "averaging.md").read_text()
    assert page.partition("<!-- results -->\n")[2].partition("\n<!-- end of results -->")[0] == printed


@pytest.mark.parametrize("name", ["docs/averaging.md", "README.md"])
def test_every_interval_in_the_words_stands_in_the_tables(printed, name):
    words = (ROOT / name).read_text()
    if name == "README.md":
        words = words.partition("**Does averaging help?**")[2].partition("## Two commands")[0]
    said = re.findall(r"([+−-]?[\d.]+)\s\[([^]]*\d, [^]]*)\]", words)
    assert len(said) >= (2 if name == "README.md" else 12)
    known = {tuple(map(plain, found)) for found in re.findall(r"([+-]?[\d.]+) \[([^]]*)\]", printed)}
    assert not {tuple(map(plain, each)) for each in said} - known


def plain(text: str) -> str:
    """Without signs of plus, which words leave out, and with minus as a program writes it."""
    return text.replace("−", "-").replace("+", "")
