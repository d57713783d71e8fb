"""`kill -9` at any instant costs time and nothing else: 50 of them, each continuation equal to the straight run."""

from __future__ import annotations

import random
import shutil
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from saclab.training.checkpoint import newest_first

from .helpers import assert_same_run, kill, lines_of, run, settings, start, wait_for

KILLS = 25  # on each environment
ENVIRONMENTS = ("HalfCheetah-v4", "Humanoid-v4")
OFTEN = ("--checkpoint-minutes", "0.005")  # every 0.3 s
SETTINGS = tuple(settings(
    max_steps=8_000, random_steps=100, replay_capacity=3_000, evaluation_interval_steps=1_900, update_interval=4,
))  # fmt: skip


def train(environment: str) -> tuple[str, ...]:
    return ("train", environment, "--variant", "averaged-auto", "--seed", "2", *SETTINGS, *OFTEN)


def folder_of(root: Path, environment: str) -> Path:
    return root / "runs" / environment / "averaged-auto" / "standard" / "seed-2"


def kill_at_some_instant(process: subprocess.Popen[str], folder: Path, chance: random.Random) -> str:
    """During a save, soon after training has begun or gone on, or any time since the process started."""
    sessions = len(lines_of(folder / "sessions.jsonl"))
    began = time.monotonic()
    how = chance.choice(("during a save", "during a save", "while it trains", "while it trains", "any time"))
    instant = chance.uniform(0, 8)
    if how == "any time":
        wait_for(lambda: time.monotonic() - began > instant or process.poll() is not None)
    else:
        wait_for(lambda: len(lines_of(folder / "sessions.jsonl")) > sessions or process.poll() is not None)
        if how == "during a save":
            saves = chance.randrange(1, 3)
            for _ in range(saves):
                wait_for(lambda: not partial(folder) or process.poll() is not None, every=0)
                wait_for(lambda: partial(folder) or process.poll() is not None, every=0.0005)
            time.sleep(chance.uniform(0, 0.02))
        else:
            time.sleep(chance.uniform(0, 1.0))
    caught = partial(folder)
    kill(process)
    return "during a save" if caught and partial(folder) else how if how != "during a save" else "after a save"


def partial(folder: Path) -> bool:
    return any(folder.glob("checkpoints/*.partial"))


def chain(environment: str, root: Path) -> dict[str, int]:
    """Kill and go on, again and again; every run that comes to its end is compared with the straight one."""
    chance = random.Random(environment)
    straight, number, instants = root / "straight", 0, {}
    straight.mkdir()
    run(straight, *train(environment))
    broken = root / "broken"
    broken.mkdir()
    while number < KILLS:
        process = start(broken, *train(environment))
        folder = folder_of(broken, environment)
        how = kill_at_some_instant(process, folder, chance)
        assert process.stdout is not None
        output = process.stdout.read()
        assert "Traceback" not in output
        assert "saclab: " not in output  # an error message
        if process.returncode == 0:  # it was faster
            assert_same_run(folder_of(straight, environment), folder)
            shutil.rmtree(folder)
            continue
        assert process.returncode == -9
        number += 1
        instants[how] = instants.get(how, 0) + 1
    run(broken, *train(environment))
    assert_same_run(folder_of(straight, environment), folder)
    sessions = lines_of(folder / "sessions.jsonl")
    assert sessions[-1]["from_step"] > 0
    assert not any(line["notes"] for line in sessions), "no checkpoint was damaged"
    assert len(newest_first(folder / "checkpoints")) == 2
    return instants


@pytest.mark.slow
def test_every_continuation_after_50_kills_equals_the_straight_run(tmp_path):
    for environment in ENVIRONMENTS:
        (tmp_path / environment).mkdir()
    with ThreadPoolExecutor() as pool:  # the two chains share the cores
        chains = [pool.submit(chain, environment, tmp_path / environment) for environment in ENVIRONMENTS]
        instants = [one.result() for one in chains]
    print(dict(zip(ENVIRONMENTS, instants, strict=True)))
    assert sum(sum(some.values()) for some in instants) == 50
    assert all(some.get("during a save", 0) >= 1 for some in instants), instants
