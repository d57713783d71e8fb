"""A stop within what takes long - a round of updates, the Q bias - is obeyed there, and the run goes on bit for bit."""

from __future__ import annotations

import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest

from saclab.environments.checked import CheckedEnvironment
from saclab.training import loop
from saclab.training.checkpoint import newest_first
from saclab.training.events import Event, Finished, Interrupted, Saved
from saclab.training.local_engine import LocalEngine
from saclab.training.requests import Requests

from .helpers import assert_same_run, finish, settings, small_config, start, wait_for

WITHIN_SECONDS = 45  # some ten, unless the machine is busy or slow
ROUND = 12


@contextmanager
def stop_at_call(number: int, owner: type, name: str, requests: Requests) -> Iterator[None]:
    """Ask for a stop in this call of a method, counted from 1."""
    real, made = getattr(owner, name), []

    def call(*arguments: object) -> object:
        made.append(name)
        if len(made) == number:
            requests.stop = 1
        return real(*arguments)

    with mock.patch.object(owner, name, call):
        yield


@contextmanager
def stop_at_update(updates: int, requests: Requests) -> Iterator[None]:
    """Ask for a stop within a round, when so many updates of the run are made."""
    real = LocalEngine.make_updates

    def make_updates(engine: LocalEngine, should_pause: Callable[[], bool]) -> None:
        def asked() -> bool:
            if engine.run.counters.updates == updates:
                requests.stop = 1
            return should_pause()

        real(engine, asked)

    with mock.patch.object(LocalEngine, "make_updates", make_updates):
        yield


def long_rounds(**changes: object):
    """Rounds of twelve updates; Pendulum's first episode ends with one of them."""
    return small_config("Pendulum-v1", update_interval=10, updates_per_interval=ROUND, **changes)


def stopped_within_a_round(config, folder: Path, updates: int) -> list[Event]:
    requests = Requests()
    with stop_at_update(updates, requests):
        return list(loop.train(config, folder, requests))


@pytest.mark.parametrize("delay", [0, 1])
def test_a_stop_within_a_round_of_updates_goes_on_bit_for_bit(tmp_path, delay):
    """In the first round, in the one of a step that ends an episode, and in a later one; and after each of its own."""
    config = long_rounds(acting_delay=delay, reward_scaling="deviation")
    finish(config, tmp_path / "straight")
    ends = 14 * ROUND  # the round of step 200, with which the first episode ends
    for updates in (1, 5, ends - 7, ends - 6, 15 * ROUND + 3):
        told = stopped_within_a_round(config, tmp_path / "stopped", updates)
        steps = 60 + 10 * -(-updates // ROUND)
        assert told[-1] == Interrupted(steps)
        newest = newest_first(tmp_path / "stopped/checkpoints")[0].name
        assert newest == f"step-{steps:012d}-update-{updates:012d}"
    finish(config, tmp_path / "stopped")
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")


def test_a_save_within_a_round_of_updates_changes_nothing(tmp_path):
    config = long_rounds(max_steps=80)
    finish(config, tmp_path / "straight")
    saved = list(loop.train(config, tmp_path / "saved", checkpoint_minutes=0))
    names = [event.checkpoint.name for event in saved if isinstance(event, Saved)]
    assert sum(bool(re.search(r"-update-\d+$", name)) for name in names) > ROUND
    assert_same_run(tmp_path / "straight", tmp_path / "saved")


def test_a_stop_within_the_q_bias_goes_on_bit_for_bit(tmp_path):
    """The evaluation and the estimate are made again, with the same draws."""
    config = small_config("Pendulum-v1", q_bias_episodes=2, discount=0.9)
    finish(config, tmp_path / "straight")
    for call in (90 + 200 + 1, 200 + 300):  # of the first and of the second episode, after an evaluation of 200 steps
        requests = Requests()
        with stop_at_call(call, CheckedEnvironment, "step", requests):
            told = list(loop.train(config, tmp_path / "stopped", requests))
        assert told[-1] == Interrupted(90)
        assert newest_first(tmp_path / "stopped/checkpoints")[0].name == "step-000000000090-untested"
        assert len((tmp_path / "stopped/q_bias.csv").read_text().splitlines()) == 1
    assert isinstance(finish(config, tmp_path / "stopped")[-1], Finished)
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")


def told_of_a_stop(process: subprocess.Popen[str]) -> None:
    """Stop a process by SIGTERM: within the seconds that are promised, and it says how to go on."""
    began = time.monotonic()
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=600)
    assert time.monotonic() - began < WITHIN_SECONDS
    assert process.returncode == 143, output
    assert "saved; continue with" in output


@pytest.mark.slow
def test_a_process_stops_within_ten_million_updates(tmp_path):
    """And goes on there: nothing is lost and nothing made twice."""
    often = ("--checkpoint-minutes", "0.01")
    endless = settings(updates_per_interval=10_000_000, max_steps=100_000, replay_capacity=2_000)
    process = start(tmp_path, "train", "Pendulum-v1", *endless, *often)
    folder = tmp_path / "runs/Pendulum-v1/sac-auto/standard/seed-0"
    for _ in range(2):
        before = updates_saved(folder)
        wait_for(lambda: updates_saved(folder) > before or process.poll() is not None)  # noqa: B023
        told_of_a_stop(process)
        assert updates_saved(folder) > before
        process = start(tmp_path, "resume", str(folder), *often)
    process.kill()
    process.communicate()


def updates_saved(folder: Path) -> int:
    """Updates of the newest checkpoint within the first round; 0 if there is none."""
    names = [path.name for path in newest_first(folder / "checkpoints")]
    assert all(name.startswith("step-000000000062-update-") for name in names)
    return int(names[0].rpartition("-")[2]) if names else 0


@pytest.mark.slow
def test_a_process_stops_within_a_long_q_bias(tmp_path):
    long = settings(q_bias_episodes=5_000, evaluation_interval_steps=50, max_steps=100)
    process = start(tmp_path, "train", "Pendulum-v1", *long)
    folder = tmp_path / "runs/Pendulum-v1/sac-auto/standard/seed-0"
    wait_for(lambda: (folder / "q_bias.csv").exists() or process.poll() is not None)
    time.sleep(5)
    told_of_a_stop(process)
    assert newest_first(folder / "checkpoints")[0].name == "step-000000000050-untested"
