"""The example of docs/prefill.md records a data set that a run can begin with."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path

from saclab.protocols import make_config
from saclab.training import loop

EXAMPLE = Path(__file__).parents[2] / "examples" / "prefill" / "record.py"


def test_the_example_records_what_a_run_begins_with(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "shelf"))
    words = [sys.executable, EXAMPLE, "Pendulum-v1", "pendulum/random-v0", "--steps", "250"]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert said == "pendulum/random-v0: 250 steps in 2 episodes\n"
    config = make_config("Pendulum-v1", protocol="quick", overrides={"prefill": "minari:pendulum/random-v0"})
    with closing(loop.train(config, tmp_path / "run")) as events:
        assert next(events).notes[1].startswith("begins with 250 transition(s) of minari:pendulum/random-v0")
