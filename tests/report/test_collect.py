"""examples/collect.py: the runs that a repository keeps."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from saclab.training.run_folder import find_runs, is_finished

ROOT = Path(__file__).parents[2]
RUN = Path("Humanoid-v4/sac/paper/seed-0")
KEPT = ROOT / "examples" / "averaging" / "runs" / RUN


def collected(runs: Path, example: Path) -> Path:
    """The copy of RUN that the script makes."""
    subprocess.run([sys.executable, ROOT / "examples" / "collect.py", runs, example], check=True)
    return example / "runs" / RUN


def test_a_collected_run_is_a_finished_one_with_thinner_logs(tmp_path):
    run = tmp_path / "runs" / RUN
    run.mkdir(parents=True)
    for name in ("config.json", "evaluations.csv", "metrics.jsonl"):
        (run / name).write_text((KEPT / name).read_text())
    result = json.loads((KEPT / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | {"files": {"metrics.jsonl": "of all lines"}}))
    (run / "reward_terms.csv").write_text("evaluation,return_a\n1,0.123456789\n2,nan\n")

    copy = collected(tmp_path / "runs", tmp_path / "example")
    assert find_runs([tmp_path / "example"]) == [copy]
    assert is_finished(copy)
    assert json.loads((copy / "result.json").read_text()) == result
    assert (copy / "reward_terms.csv").read_text() == "evaluation,return_a\n1,0.12346\n2,nan\n"
    assert (copy / "metrics.jsonl").read_text().splitlines() == (run / "metrics.jsonl").read_text().splitlines()[9::10]
    logs = [np.loadtxt(folder / "evaluations.csv", delimiter=",", skiprows=1) for folder in (run, copy)]
    assert np.array_equal(*logs)
    assert not (copy / "episodes.csv").exists()


def test_an_unfinished_run_is_left_where_it_is(tmp_path):
    run = tmp_path / "runs" / RUN
    run.mkdir(parents=True)
    (run / "config.json").write_text((KEPT / "config.json").read_text())
    assert not collected(tmp_path / "runs", tmp_path / "example").exists()
