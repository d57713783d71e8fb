"""The scripts that train the planned experiments: what they start is what the command line understands."""

from __future__ import annotations

import csv
import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from saclab.cli.main import parse
from saclab.protocols import make_config

EXAMPLES = Path(__file__).parents[2] / "examples"
HALF_CHEETAH = {"averaged", "averaged-spacing-200", "averaged-auto", "sac", "sac-lag", "averaged-entropy", "sac-auto"}
HUMANOID = {"averaged", "averaged-auto", "sac", "sac-auto"}


def commands_of(script: str, *words: str, folder: Path, keeping: bool = False) -> list[list[str]]:
    """The words of each command that a script of the examples starts; without the runs that are kept, if told so."""
    experiment = folder / "examples" / script
    experiment.mkdir(parents=True)
    shutil.copy(EXAMPLES / "experiment.sh", experiment.parent)
    shutil.copy(EXAMPLES / script / "run.sh", experiment)
    if keeping:
        (experiment / "runs").symlink_to(EXAMPLES / script / "runs")
    told = folder / "saclab"
    told.write_text('#!/usr/bin/env bash\nprintf "%s\\n" "${*@Q}"\n')  # one write: two of them share a log
    told.chmod(0o755)
    subprocess.run(
        [experiment / "run.sh", folder / "runs", *words], check=True, env=os.environ | {"SACLAB": str(told)}
    )  # fmt: skip
    log = folder / "runs" / "log.txt"
    return [shlex.split(line) for line in log.read_text().splitlines()] if log.exists() else []


@pytest.mark.parametrize(
    ("script", "words", "arms", "seeds"),
    [
        ("averaging", ("2", "0"), HALF_CHEETAH, 2),
        ("averaging", ("0", "3"), HUMANOID, 3),
        ("curriculum", (), {"sac-auto", "control-late"}, 3),
        ("curriculum", ("humanoid",), {"sac-auto", "curriculum", "curriculum-slow"}, 4),
        ("family", (), {"redq", "droq", "tqc", "crossq", "xqc", "simbav2", "flashsac", "sac-auto"}, 1),
    ],
)
def test_every_arm_is_started_for_every_seed_and_can_be(tmp_path, script, words, arms, seeds):
    commands = [parse(each) for each in commands_of(script, *words, folder=tmp_path)]
    for each in commands:
        make_config(
            each.environment, each.variant, each.protocol, each.seed, overrides={**each.algorithm, **each.training}
        )
    assert sorted((each.name, each.seed) for each in commands) == sorted(
        (arm, seed) for arm in arms for seed in range(seeds)
    )


def test_the_family_is_evaluated_at_published_steps(tmp_path):
    """Of each variant whose curve has a point that an hour reaches; episodes take 1000 steps, after the random ones."""
    reached = set()
    with (EXAMPLES / "family" / "published.csv").open() as file:
        curve = [(row["variant"], int(row["steps"])) for row in csv.DictReader(file)]
    for each in map(parse, commands_of("family", folder=tmp_path)):
        config = make_config(
            each.environment, each.variant, each.protocol, each.seed, overrides={**each.algorithm, **each.training}
        )
        training = config.training
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
    assert sorted((each.name, each.seed) for each in map(parse, commands)) == sorted((arm, 5) for arm in HALF_CHEETAH)


def test_an_unknown_stage_is_refused():
    done = subprocess.run([EXAMPLES / "curriculum" / "run.sh", "/nowhere", "ant"], check=False, capture_output=True)
    assert done.returncode == 2
    assert done.stderr == b"unknown stage ant: use half-cheetah or humanoid\n"
