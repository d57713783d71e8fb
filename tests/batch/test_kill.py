"""`kill -9` on a whole comparison in run groups, at moments that nobody chose: the same command goes on bit for bit."""

from __future__ import annotations

import random
import time

import pytest
from resume.helpers import assert_same_run, kill, run, settings, start, wait_for

VARIANTS = ("sac", "averaged-auto")


def arguments(**overrides: object) -> list[str]:
    return [
        "compare", "Hopper-v4", "--variants", *VARIANTS, "--seeds", "2", "--batch", "4", "--workers", "2",
        "--threads", "1", "--checkpoint-minutes", "0.005",
        *settings(max_steps=900, evaluation_interval_steps=300, **overrides),
    ]  # fmt: skip


@pytest.mark.slow
def test_a_comparison_in_groups_that_is_killed_often_ends_the_same(tmp_path):
    (tmp_path / "straight").mkdir()
    (tmp_path / "killed").mkdir()
    run(tmp_path / "straight", *arguments())
    chance = random.Random(11)
    for _ in range(6):
        process = start(tmp_path / "killed", *arguments())
        wait_for(lambda process=process: process.poll() is not None or any(
            (tmp_path / "killed").rglob("checkpoints/step-*")))  # fmt: skip
        time.sleep(chance.uniform(0, 8))
        kill(process)
        end_of_processes(tmp_path)
    run(tmp_path / "killed", *arguments())
    folders = sorted(path.parent for path in (tmp_path / "straight").rglob("result.json"))
    assert len(folders) == 4
    for folder in folders:
        assert_same_run(folder, tmp_path / "killed" / folder.relative_to(tmp_path / "straight"))


def end_of_processes(root):
    """The launcher is gone; its worker notices when it next speaks, and saves. Its lock says whether it is there."""
    import fcntl

    def free() -> bool:
        for path in (root / "killed").rglob("lock"):
            with path.open("a+") as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    return False
        return True

    wait_for(free)
