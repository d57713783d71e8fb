"""Signals to a real process: save and stop with a documented status within seconds, or save and go on."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from saclab.training.checkpoint import newest_first, read_checkpoint
from saclab.training.local_engine import LocalBuilder
from saclab.training.run_folder import read_config

from .helpers import assert_same_run, command, environment_of, kill, run, settings, start, wait_for

# Evaluations of twenty episodes are under way most of the time: no one should have to wait for their end.
LONG = tuple(settings(
    max_steps=50_000_000, replay_capacity=2_000, evaluation_episodes=20, evaluation_interval_steps=50
))  # fmt: skip
RUN = Path("runs/Pendulum-v1/sac-auto/standard/seed-0")
WITHIN_SECONDS = 45  # one or two, unless the machine is busy or slow


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
    output, _ = process.communicate(timeout=600)
    assert time.monotonic() - began < WITHIN_SECONDS
    assert process.returncode == 143, output
    assert f"saved; continue with: saclab resume {tmp_path / RUN}" in output
    assert_whole(tmp_path)


@pytest.mark.slow
def test_int_saves_and_stops_with_its_own_status(tmp_path):
    process = started(tmp_path)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=600)
    assert time.monotonic() - began < WITHIN_SECONDS
    assert process.returncode == 130
    assert_whole(tmp_path)


@pytest.mark.slow
def test_a_closed_terminal_saves_and_stops_and_nohup_goes_on(tmp_path):
    process = started(tmp_path)
    process.send_signal(signal.SIGHUP)
    process.communicate(timeout=600)
    assert process.returncode == 129
    assert_whole(tmp_path)
    line = shlex.join(["nohup", *command("resume", str(RUN))])
    process = subprocess.Popen(
        ["bash", "-c", f"exec {line} > out 2>&1"], cwd=tmp_path, env=environment_of(), process_group=0
    )
    evaluated = len((tmp_path / RUN / "evaluations.csv").read_text().splitlines())
    wait_for(lambda: len((tmp_path / RUN / "evaluations.csv").read_text().splitlines()) > evaluated + 1)
    process.send_signal(signal.SIGHUP)
    time.sleep(1)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    assert "saved; continue with" in (tmp_path / "out").read_text()


# --- what cannot be interrupted

SLEEPING = """
import os, time
import gymnasium
import numpy as np
from gymnasium.envs.classic_control.pendulum import PendulumEnv

class Sleeping(PendulumEnv):
    \"\"\"Pendulum, that sleeps in step NAP of the training environment if its file is there.\"\"\"
    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 130 and os.path.exists({file!r}):
            open({file!r}, "w").write("asleep")
            time.sleep(600)
        return super().step(action)

    def saclab_capture(self):
        return {{"state": np.array(self.state), "steps": np.array(self.steps)}}

    def saclab_restore(self, captured):
        self.state, self.steps = captured["state"].copy(), int(captured["steps"])

gymnasium.register("Sleeping-v0", Sleeping, max_episode_steps=200)
"""


def asleep_in_a_step(folder: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str):
    """A process whose environment sleeps for ten minutes in one step; its last checkpoint is some steps old."""
    bed = folder / "bed"
    (folder / "sleeping.py").write_text(SLEEPING.format(file=str(bed)))
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    bed.write_text("")
    process = start(folder, arguments[0], "sleeping:Sleeping-v0", *settings(max_steps=200), *arguments[1:])
    wait_for(lambda: bed.read_text() == "asleep" or process.poll() is not None)
    bed.unlink()
    return process


def ended_in_time(process, number: int) -> str:
    began = time.monotonic()
    process.send_signal(number)
    output, _ = process.communicate(timeout=600)
    assert time.monotonic() - began < WITHIN_SECONDS, output
    assert process.returncode == 128 + number, output
    return output


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_step_that_does_not_end_is_not_waited_for(tmp_path, monkeypatch, number):
    """What is lost since the last checkpoint is done again, bit for bit."""
    process = asleep_in_a_step(tmp_path, monkeypatch, "train", "--checkpoint-minutes", "0.001")
    run_folder = tmp_path / "runs/sleeping_Sleeping-v0/sac-auto/standard/seed-0"
    assert newest_first(run_folder / "checkpoints")
    assert "Nothing that was saved is lost" in ended_in_time(process, number)
    run(tmp_path, "resume", str(run_folder), "--imports", "sleeping")
    run(tmp_path, "train", "sleeping:Sleeping-v0", *settings(max_steps=200), "--runs", "straight")
    assert_same_run(tmp_path / "straight" / run_folder.relative_to(tmp_path / "runs"), run_folder)


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--batch", "2")], ids=["workers", "a group"])
def test_a_grid_does_not_wait_for_a_step_that_does_not_end(tmp_path, monkeypatch, more):
    process = asleep_in_a_step(tmp_path, monkeypatch, "compare", "--variants", "sac", "--seeds", "1", *more)
    assert "interrupted" in ended_in_time(process, signal.SIGTERM)
    # The environments' processes die with their worker, by the kernel: a moment after it.
    wait_for(lambda: not [path for path in Path("/proc").glob("[0-9]*/environ") if says(path, str(tmp_path))], 60)


def says(path: Path, text: str) -> bool:
    with suppress(OSError):
        return text.encode() in path.read_bytes() and b") Z" not in (path.parent / "stat").read_bytes()
    return False


@pytest.mark.slow
def test_a_compilation_is_not_waited_for(tmp_path, monkeypatch):
    """Of a hundred layers, which takes XLA more than ten seconds; the run is begun and has no checkpoint yet."""
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")
    deep = settings(hidden_layers=(8,) * 120, random_steps=40, max_steps=50)
    process = start(tmp_path, "train", "Pendulum-v1", *deep)
    wait_for(lambda: (tmp_path / RUN / "config.json").exists() or process.poll() is not None)
    time.sleep(2)  # what comes next is the program that makes the networks
    assert "(a compilation, a step that takes long, or reading what the run begins with): ended" in ended_in_time(
        process, signal.SIGTERM
    )
    assert not newest_first(tmp_path / RUN / "checkpoints")
    assert (tmp_path / RUN / "config.json").exists(), "the same command goes on from here, which is the beginning"


def test_a_save_is_waited_for_and_nothing_else(monkeypatch, tmp_path):
    """A process that saves for longer than it has time to obey, and then does nothing."""
    program = """
import os, signal, sys, time
from saclab import signals
signals.SECONDS_TO_OBEY = 0.5
with signals.requests_from_signals(process_ends=True) as requests:
    with requests.while_saving():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(2)
        print("saved", flush=True)
    began = time.monotonic()
    time.sleep(30)
"""
    began = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600)
    assert (ended.returncode, ended.stdout) == (143, "saved\n"), ended.stderr
    assert 2.4 < time.monotonic() - began < 25


def test_a_signal_to_a_forked_child_is_none_to_this_process():
    program = """
import os, signal, time
from saclab import signals
signals.SECONDS_TO_OBEY = 0.3
with signals.requests_from_signals(process_ends=True) as requests:
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        os.write(writer, b"ready")
        time.sleep(1)
        os._exit(0)
    os.read(reader, 5)
    os.kill(child, signal.SIGTERM)
    os.waitpid(child, 0)
    time.sleep(1)
    print("alive")
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600)
    assert (ended.returncode, ended.stdout) == (0, "alive\n"), ended.stderr


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
