"""Signals to a real process: save and stop with a documented status within seconds, or save and go on."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from saclab.training.checkpoint import newest_first, read_checkpoint
from saclab.training.local_engine import LocalBuilder
from saclab.training.run_folder import read_config

from .helpers import assert_same_run, kill, run, settings, start, wait_for

# Evaluations of twenty episodes are under way most of the time: no one should have to wait for their end.
LONG = tuple(settings(
    max_steps=50_000_000, replay_capacity=2_000, evaluation_episodes=20, evaluation_interval_steps=50
))  # fmt: skip
RUN = Path("runs/Pendulum-v1/sac-auto/standard/seed-0")
WITHIN_SECONDS = 15  # one or two, unless the machine is busy


def started(folder: Path):
    """A process that has begun to evaluate its policy."""
    process = start(folder, "train", "Pendulum-v1", *LONG)
    wait_for(lambda: (folder / RUN / "evaluations.csv").exists() or process.poll() is not None)
    wait_for(lambda: len((folder / RUN / "evaluations.csv").read_text().splitlines()) > 2)
    return process


def assert_whole(folder: Path) -> None:
    replay = LocalBuilder(read_config(folder / RUN)).replay
    assert read_checkpoint(newest_first(folder / RUN / "checkpoints")[0], replay)


@pytest.mark.slow
def test_usr1_saves_and_goes_on_and_term_saves_and_stops(tmp_path):
    """However often they come."""
    process = started(tmp_path)
    process.send_signal(signal.SIGUSR1)
    wait_for(lambda: len(newest_first(tmp_path / RUN / "checkpoints")) == 1)
    assert process.poll() is None
    process.send_signal(signal.SIGUSR1)
    wait_for(lambda: len(newest_first(tmp_path / RUN / "checkpoints")) == 2)
    assert process.poll() is None
    began = time.monotonic()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
        process.send_signal(number)
        time.sleep(0.01)
    output, _ = process.communicate(timeout=60)
    assert time.monotonic() - began < WITHIN_SECONDS
    assert process.returncode == 143, output
    assert f"saved; continue with: saclab resume {RUN}" in output
    assert_whole(tmp_path)


@pytest.mark.slow
def test_int_saves_and_stops_with_its_own_status(tmp_path):
    process = started(tmp_path)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert time.monotonic() - began < WITHIN_SECONDS
    assert process.returncode == 130
    assert_whole(tmp_path)


# --- processes that go on from each other, with one thread and with two

WIDE = {"hidden_layers": (128, 128), "batch_size": 128, "random_steps": 200, "replay_capacity": 1_000,
        "max_steps": 900, "evaluation_interval_steps": 400}  # fmt: skip
WIDE_RUN = Path("runs/HalfCheetah-v4/averaged/standard/seed-0")


def command_of(threads: int, *more: str) -> tuple[str, ...]:
    """Networks wide enough for the number of threads to show."""
    return ("train", "HalfCheetah-v4", "--variant", "averaged", "--threads", str(threads), *settings(**WIDE), *more)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_a_new_process_with_as_many_threads_continues_exactly(tmp_path, threads):
    run(tmp_path, *command_of(threads), threads=None)
    broken = tmp_path / "broken"
    process, folder = interrupted(broken, threads)
    assert process.returncode == -9
    output = run(broken, "resume", str(folder), threads=None)  # takes the number of threads from the run
    assert "resumed at step" in output
    assert "when the checkpoint was made" not in output
    assert_same_run(tmp_path / WIDE_RUN, folder)


def interrupted(folder: Path, threads: int):
    """Killed once it has made a checkpoint after its first update."""
    folder.mkdir()
    process = start(folder, *command_of(threads, "--checkpoint-minutes", "0.001"), threads=None)
    run_folder = folder / WIDE_RUN
    wait_for(lambda: any(newest.name >= "step-000000000400" for newest in newest_first(run_folder / "checkpoints")))
    kill(process)
    process.communicate()
    return process, run_folder


@pytest.mark.slow
def test_another_number_of_threads_is_told_with_the_way_out(tmp_path):
    """The setting that continues exactly."""
    _, folder = interrupted(tmp_path / "broken", 1)
    output = run(tmp_path, "resume", str(folder), "--threads", "2", threads=None)
    assert "threads was 1 when the checkpoint was made and is 2 now" in output
    assert "continue exactly with --threads 1 (or NPROC=1 in the environment)" in output
