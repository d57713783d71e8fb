"""The data of docs/averaging.md and docs/curriculum.md that this repository holds: small, and what their words say."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from saclab.report.report import write_report
from saclab.training.run_folder import find_runs, is_finished

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
EXPERIMENTS = ("averaging", "curriculum")
QUESTIONS = {"averaging": "**Does averaging help?**", "curriculum": "**Does a reward curriculum help Humanoid?**"}
"""How the README's paragraph begins."""


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_the_runs_are_small_and_all_finished(experiment):
    runs = EXAMPLES / experiment / "runs"
    found = find_runs([runs])
    assert len(found) >= 18
    assert all(is_finished(run) for run in found)
    assert sum(path.stat().st_size for path in runs.rglob("*") if path.is_file()) < 10e6


def test_the_page_of_averaging_comes_again_from_its_runs(tmp_path, monkeypatch):
    monkeypatch.setattr("saclab.report.report.write_figures", lambda *_: None)  # their making is tested elsewhere
    page = write_report(find_runs([EXAMPLES / "averaging" / "runs"]), tmp_path)
    assert page.stat().st_size < 3e6
    assert "averaged-spacing-200" in page.read_text()
    kept = EXAMPLES / "averaging" / "report"
    assert (tmp_path / "scores.csv").read_text() == (kept / "scores.csv").read_text(), "saclab report makes it again"
    assert len((kept / "index.html").read_text().splitlines()) == len(page.read_text().splitlines())


@pytest.fixture(scope="module")
def printed() -> dict[str, str]:
    """Experiment -> its planned comparisons, as its command prints them."""
    return {experiment: told(EXAMPLES / experiment) for experiment in EXPERIMENTS}


def told(example: Path) -> str:
    command = [sys.executable, example / "results.py", example / "runs"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("experiment", "rows"),
    [
        ("averaging", ("| `averaged` | 5 |", "| `averaged` | 3 |")),
        ("curriculum", ("| `control-late` | 2 |", "| `curriculum-slow` | 3 |", "H1 holds")),
    ],
)
def test_the_tables_of_the_page_are_those_that_the_command_prints(printed, experiment, rows):
    assert all(row in printed[experiment] for row in rows)
    page = (ROOT / "docs" / f"{experiment}.md").read_text()
    assert page.partition("<!-- results -->\n")[2].partition("\n<!-- end of results -->")[0] == printed[experiment]


@pytest.mark.parametrize(("experiment", "fewest"), [("averaging", 12), ("curriculum", 10)])
def test_every_interval_in_the_words_stands_in_the_tables(printed, experiment, fewest):
    before, _, rest = (ROOT / "docs" / f"{experiment}.md").read_text().partition("<!-- results -->")
    words = before + rest.partition("<!-- end of results -->")[2]
    readme = (ROOT / "README.md").read_text().partition(QUESTIONS[experiment])[2].partition("\n\n")[0]
    assert len(intervals(words)) >= fewest
    assert len(intervals(readme)) >= 2
    known = intervals(printed[experiment])
    assert not (intervals(words) | intervals(readme)) - known


def test_one_of_the_thirty_rows_of_the_curriculum_is_decided(printed):
    rows = [line for line in printed["curriculum"].splitlines() if line.startswith("| H")]
    assert len(rows) == 30
    assert [row.split(" | ")[1:3] for row in rows if row.endswith("| yes |")] == [
        ["`curriculum-slow` − `sac-auto`", "forward return per step, area"]
    ]


def intervals(text: str) -> set[tuple[str, str]]:
    """Estimates and their intervals, without signs of plus, which words leave out, and with a program's minus."""
    return {
        (plain(estimate), plain(ends)) for estimate, ends in re.findall(r"([+−-]?[\d.]+)\s\[([^]]*\d, [^]]*)\]", text)
    }


def plain(text: str) -> str:
    return text.replace("−", "-").replace("+", "")
