"""The experiment of docs/curriculum.md: its script names runs that can be begun, those of the page."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from saclab.cli.main import parse
from saclab.protocols import make_config

ROOT = Path(__file__).parents[2]
NOTING = """#!/bin/sh
for word in "$@"; do printf '%s\\n' "$word"; done >"$NOTES/$$"
"""


@pytest.fixture(scope="module")
def configs(tmp_path_factory):
    """The configuration of each run that the script would train."""
    folder = tmp_path_factory.mktemp("curriculum")
    program, notes = folder / "saclab", folder / "notes"
    program.write_text(NOTING)
    program.chmod(0o755)
    notes.mkdir()
    environment = os.environ | {"SACLAB": str(program), "NOTES": str(notes)}
    subprocess.run([ROOT / "examples/curriculum/run.sh", folder / "runs"], env=environment, check=True, timeout=100)
    found = []
    for path in notes.iterdir():
        command = parse(path.read_text().splitlines())
        given = {**command.algorithm, **command.training}
        found.append((command.name, make_config(command.environment, command.variant, command.protocol,
                                                command.seed, overrides=given)))  # fmt: skip
    return found


def test_the_script_trains_three_seeds_of_the_arms_of_the_page(configs):
    arms = {(config.environment, name, config.seed) for name, config in configs}
    assert len(arms) == len(configs) == 3 * (2 + 3)
    page = (ROOT / "docs/curriculum.md").read_text()
    for name, config in configs:
        assert f"| `{name}` |" in page
        for text in config.algorithm.reward_schedule:
            assert f"`{text}` |" in page
    assert {config.planned_updates for _, config in configs} == {30_000, 60_000}
    assert {config.training.patience_episodes for _, config in configs} == {None}


def test_every_arm_logs_the_terms_that_are_compared(configs):
    forward = {"HalfCheetah-v4": "reward_ctrl", "Humanoid-v4": "reward_linvel"}
    assert all(forward[config.environment] in config.algorithm.terms_of_reward for _, config in configs)
