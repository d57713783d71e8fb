"""The data of docs/averaging.md that this repository holds: small, and enough to make its page again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from saclab.report.report import write_report
from saclab.training.run_folder import find_runs, is_finished

EXAMPLE = Path(__file__).parents[2] / "examples" / "averaging"


def test_the_runs_are_small_and_all_finished():
    runs = find_runs([EXAMPLE / "runs"])
    assert all(is_finished(run) for run in runs)
    assert sum(path.stat().st_size for path in (EXAMPLE / "runs").rglob("*") if path.is_file()) < 10e6


def test_the_page_comes_again_from_them(tmp_path):
    page = write_report(find_runs([EXAMPLE / "runs"]), tmp_path)
    assert page.stat().st_size < 3e6
    assert "averaged-spacing-200" in page.read_text()


def test_the_planned_comparisons_are_printed():
    told = subprocess.run(
        [sys.executable, EXAMPLE / "results.py"], capture_output=True, text=True, check=True
    ).stdout  # fmt: skip
    assert "### HalfCheetah-v4" in told
    assert "| `averaged` |" in told
