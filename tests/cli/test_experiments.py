"""The scripts that train the planned experiments: what they start is what the command line understands."""

from __future__ import annotations

import csv
import subprocess

import pytest
from experiments import EXAMPLES, commands_of, config_of

HALF_CHEETAH = {"averaged", "averaged-spacing-200", "averaged-auto", "sac", "sac-lag", "averaged-entropy", "sac-auto"}
HUMANOID = {"averaged", "averaged-auto", "sac", "sac-auto"}


@pytest.mark.parametrize(
    ("script", "words", "arms", "seeds"),
    [
        ("averaging", ("2", "0"), HALF_CHEETAH, 2),
        ("averaging", ("0", "3"), HUMANOID, 3),
        ("family", (), {"redq", "droq", "tqc", "crossq", "xqc", "simbav2", "flashsac", "sac-auto"}, 1),
    ],
)
def test_every_arm_is_started_for_every_seed_and_can_be(tmp_path, script, words, arms, seeds):
    commands = commands_of(script, *words, folder=tmp_path)
    assert all(config_of(each) for each in commands)
    assert sorted((each.name, each.seed) for each in commands) == sorted(
        (arm, seed) for arm in arms for seed in range(seeds)
    )


def test_the_family_is_evaluated_at_published_steps(tmp_path):
    """Of each variant whose curve has a point that an hour reaches; episodes take 1000 steps, after the random ones."""
    reached = set()
    with (EXAMPLES / "family" / "published.csv").open() as file:
        curve = [(row["variant"], int(row["steps"])) for row in csv.DictReader(file)]
    for each in commands_of("family", folder=tmp_path):
        training = config_of(each).training
        last = training.random_steps + 1000 * training.max_episodes
        steps = range(training.evaluation_interval_steps, last + 1, training.evaluation_interval_steps)
        reached |= {variant for variant, at in curve if variant == each.variant and training.random_steps < at in steps}
    assert reached == {"sac-auto", "redq", "droq", "crossq", "xqc"}


def test_a_folder_that_xargs_would_take_apart_is_refused(tmp_path):
    script, folder = EXAMPLES / "family" / "run.sh", tmp_path / "my runs"
    done = subprocess.run([script, folder], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert "use one without blanks, quotes and backslashes" in done.stderr
    assert not folder.exists()


def test_runs_that_are_kept_are_not_trained_again(tmp_path):
    """Of the averaging experiment the five seeds on HalfCheetah-v4 are kept, and no sixth."""
    commands = commands_of("averaging", "6", "0", folder=tmp_path, keeping=True)
    assert sorted((each.name, each.seed) for each in commands) == sorted((arm, 5) for arm in HALF_CHEETAH)
