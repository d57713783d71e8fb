"""The table of examples/family, from made-up runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from .synthetic import write_run

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "examples" / "family" / "results.py"


def test_ours_beside_the_published_returns(tmp_path):
    """Evaluations lie 10,000 steps apart: a published step of XQC is among them."""
    for seed, last in ((0, 5000.0), (1, 5310.4)):
        write_run(tmp_path, "xqc", seed, protocol="standard", returns=[100.0, 200.0, 300.0, 400.0, last])
    write_run(tmp_path, "tqc", protocol="standard", returns=[100.0, 4321.0])
    write_run(tmp_path, "flashsac", protocol="standard", returns=[100.0, 200.0, 300.0])
    write_run(tmp_path, "crossq", protocol="standard", returns=[1000.0, 4000.0])
    write_run(tmp_path, "redq", protocol="standard", evaluations=0, finished=False)
    table = subprocess.run([sys.executable, RESULTS, tmp_path], capture_output=True, text=True, check=True).stdout
    assert table.splitlines()[2:] == [
        "| `crossq` | 10,000 | 1000 | 1148 ± 853, 10 seeds | -0.2 |",
        "| `crossq` | 20,000 | 4000 | 3850 ± 946, 10 seeds | +0.2 |",
        "| `flashsac` | 30,000 | 300 | first at 100,000: 9815 ± 174 |  |",
        "| `tqc` | 20,000 | 4321 | none |  |",
        "| `xqc` | 50,000 | 5000, 5310 | 6754 ± 1098, 10 seeds | -1.5 |",  # (5155.2 − 6753.7) / 1098.4
    ]


def test_the_table_of_the_page_is_that_of_the_kept_runs():
    table = subprocess.run([sys.executable, RESULTS], capture_output=True, text=True, check=True).stdout
    page = (ROOT / "docs" / "variants" / "README.md").read_text()
    assert page.partition("<!-- family -->\n")[2].partition("<!-- /family -->")[0] == table
    assert table.count("\n") > 2, "there are runs"
