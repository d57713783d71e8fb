"""The experiment of docs/curriculum.md: its script names runs that can be begun, those of the page."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from experiments import commands_of, config_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    """Stage -> the name and the configuration of each run that the script would train, were none at hand."""
    return {
        stage: [
            (command.name, config_of(command))
            for command in commands_of("curriculum", stage, folder=tmp_path_factory.mktemp(stage))
        ]
        for stage in ("half-cheetah", "humanoid")
    }


def test_the_script_trains_the_seeds_and_arms_of_the_page(stages):
    page = (ROOT / "docs/curriculum.md").read_text()
    expected = {"half-cheetah": ("HalfCheetah-v4", 2, 3, 30_000), "humanoid": ("Humanoid-v4", 3, 4, 100_000)}
    for stage, (environment, arms, seeds, updates) in expected.items():
        runs = stages[stage]
        assert len(runs) == len({(name, config.seed) for name, config in runs}) == seeds * arms
        assert {config.environment for _, config in runs} == {environment}
        assert {config.planned_updates for _, config in runs} == {updates}
        assert {config.training.patience_episodes for _, config in runs} == {None}
        assert {config.training.max_episodes for _, config in runs} == {None}
        for name, config in runs:
            assert f"| `{name}` |" in page
            assert all(f"`{text}` |" in page for text in config.algorithm.reward_schedule)


def test_an_arm_differs_from_its_baseline_in_the_schedule_alone(stages):
    for runs in stages.values():
        baselines = {config.seed: config for name, config in runs if name == "sac-auto"}
        for name, config in runs:
            differences = set(config.differences(baselines[config.seed]))
            told = {difference.rpartition(".")[2] for difference in differences}
            assert told <= {"variant", "reward_schedule"}
            assert ("reward_schedule" in told) == (name != "sac-auto")


def test_an_unknown_stage_is_told(tmp_path):
    script = ROOT / "examples/curriculum/run.sh"
    told = subprocess.run([script, tmp_path / "runs", "ant"], capture_output=True, text=True, timeout=600)
    assert told.returncode == 2
    assert "unknown stage ant: use half-cheetah or humanoid" in told.stderr
