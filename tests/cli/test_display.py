"""What the terminal says at the end of a comparison."""

from __future__ import annotations

import io

import pytest
from report.synthetic import write_run
from rich.console import Console

from saclab.api import Comparison
from saclab.cli.display import show_comparison
from saclab.report.sentences import ONE_SEED
from saclab.training.run_folder import read_run


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ([("sac", 0), ("averaged", 0)], True),
        ([("sac", 0), ("sac", 1), ("averaged", 0)], False),
        ([("sac", 0)], False),
    ],
)
def test_one_seed_each_is_said_below_the_table_that_looks_like_a_ranking(tmp_path, grid, said):
    runs = [read_run(write_run(tmp_path, variant, seed, evaluations=1)) for variant, seed in grid]
    text = io.StringIO()
    assert show_comparison(Comparison(runs, {}, tmp_path / "index.html"), Console(file=text)) == 0
    assert [line for line in text.getvalue().splitlines() if not line.startswith("report: ")] == [ONE_SEED] * said
