"""What an environment raises, prints, changes or never returns from: one line, its own last ones, the rest on disk."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
import signal
import threading
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from resume.helpers import wait_for, without_seconds

import saclab
from saclab.cli.main import main
from saclab.environments import watch
from saclab.environments.checked import CheckedEnvironment
from saclab.errors import RunBroken, for_terminal
from saclab.trained_policy import load_policy, save_policy
from saclab.training.common_checkpoint import checkpoint_steps
from saclab.training.run_folder import read_config

from .rogue import HAPPENINGS, Rogue

RUN = "Rogue-v0/sac-auto/quick/seed-0"
SETTINGS = {"hidden_layers": 8, "batch_size": 16, "random_steps": 20, "max_steps": 40, "evaluation_interval_steps": 20,
            "evaluation_episodes": 1, "q_bias_episodes": 1}  # fmt: skip
WORDS = [part for name, value in SETTINGS.items() for part in ("--" + name.replace("_", "-"), str(value))]
RAISING = [name for name in HAPPENINGS if name not in ("death", "hang")]


def command(folder: Path, capfd, *words: str, **arguments) -> tuple[int, str]:
    """A command's exit status and what it printed; no traceback, and no letter that a terminal would obey."""
    Rogue.made = count(1)
    capfd.readouterr()
    if words[0] == "train":
        words = ("train", "Rogue-v0", "--protocol", "quick", "--runs", str(folder), *WORDS,
                 "--environment-arguments", json.dumps(arguments), *words[1:])  # fmt: skip
    status = main(words)
    told = capfd.readouterr().err
    assert "Traceback" not in told
    assert "\x1b" not in told
    assert len(told) < 4000
    return status, told


@pytest.mark.parametrize("what", RAISING)
def test_whatever_a_step_raises_is_a_line_and_the_rest_on_disk(tmp_path, capfd, what):
    status, told = command(tmp_path, capfd, "train", where="step", what=what, at=30, instance=2)
    assert status == 1
    assert "saclab: environment Rogue-v0 raised an error in step: " in told.splitlines()[-1]
    assert "rogue.py" in told, "its own last lines"
    assert "rogue.py" in (tmp_path / RUN / "failure/traceback.txt").read_text()
    assert json.loads((tmp_path / RUN / "failure/failure.json").read_text())["counters"]["steps"] == 29


@pytest.mark.parametrize(
    ("where", "at", "instance", "named"),
    [
        ("reset", 1, 2, "in reset"),
        ("reset", 3, 2, "in reset"),
        ("step", 2, 3, "in step"),
        ("reset", 2, 3, "in reset"),
        ("saclab_capture", 1, 2, "in saclab_capture"),
        ("__init__", 1, 2, "in __init__"),
    ],
    ids=["first reset", "a later reset", "evaluation", "Q bias", "state", "init of the second"],
)
def test_wherever_it_raises_the_run_ends_with_a_line(tmp_path, capfd, where, at, instance, named):
    status, told = command(tmp_path, capfd, "train", where=where, at=at, instance=instance)
    assert status == (2 if where == "__init__" else 1)
    assert f"{named}: RuntimeError: the wheels" in told.splitlines()[-1]
    assert any("the wheels" in path.read_text() for path in (tmp_path / RUN).rglob("traceback.txt"))


@pytest.mark.parametrize("what", ["error", "type", "exit", "mute"])
def test_an_environment_that_cannot_be_made_is_refused(tmp_path, capfd, what):
    status, told = command(tmp_path, capfd, "train", where="__init__", what=what)
    assert status == 2
    assert "rogue.py" in told
    assert not (tmp_path / "Rogue-v0").exists()


def test_an_error_in_close_harms_no_result(tmp_path, capfd, caplog):
    status, _ = command(tmp_path, capfd, "train", where="close", instance=2)
    assert status == 0
    assert (tmp_path / RUN / "result.json").exists()
    (told,) = caplog.messages
    assert "raised an error in close: RuntimeError: the wheels" in told
    assert "Traceback" not in told
    assert "rogue.py" in (tmp_path / RUN / "traceback.txt").read_text()


def test_an_error_while_a_state_is_restored_is_told(tmp_path, capfd):
    command(tmp_path, capfd, "train", "--checkpoint-minutes", "0", where="saclab_restore", instance=2)
    run = tmp_path / RUN
    (run / "result.json").unlink()
    assert checkpoint_steps(run)
    status, told = command(tmp_path, capfd, "resume", str(run))
    assert status == 1
    assert "in saclab_restore: RuntimeError: the wheels" in told
    assert "rogue.py" in (run / "traceback.txt").read_text()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    plain = {name: (value,) if name == "hidden_layers" else value for name, value in SETTINGS.items()}
    return saclab.train("Rogue-v0", protocol="quick", runs=folder, **plain).path


@pytest.mark.parametrize("where", ["__init__", "reset", "step", "render"])
@pytest.mark.parametrize("verb", ["evaluate", "record"])
def test_evaluate_and_record_say_it_too(trained, tmp_path, capfd, where, verb):
    if (verb, where) == ("evaluate", "render"):
        pytest.skip("an evaluation draws nothing")
    run, policy = tmp_path / "run", load_policy(trained)
    config = dataclasses.replace(read_config(trained), environment_arguments={"where": where})
    save_policy(run / "best", config, policy.spec, policy.parameters, {})
    more = ["--video", str(tmp_path / "film.mp4")] if verb == "record" else []
    status, told = command(tmp_path, capfd, verb, str(run), *more)
    assert status == (2 if where in ("__init__", "render") else 1)
    assert f"in {where}: RuntimeError: the wheels" in told.splitlines()[-1]
    assert "rogue.py" in (run / "traceback.txt").read_text()


def test_the_python_interface_raises_with_the_traceback(tmp_path):
    Rogue.made = count(1)
    plain = {**SETTINGS, "hidden_layers": (8,)}
    arguments = {"where": "step", "at": 30, "instance": 2}
    with pytest.raises(RunBroken, match="raised an error in step: RuntimeError") as caught:
        saclab.train("Rogue-v0", protocol="quick", runs=tmp_path, environment_arguments=arguments, **plain)
    assert "rogue.py" in caught.value.traceback
    assert "RuntimeError: the wheels" in for_terminal(caught.value, "")


def test_a_meddling_environment_changes_no_result(tmp_path, monkeypatch, capfd):
    """Directory, variables, NumPy's errors, seeds, warnings, signal handlers: the run is the same, bit for bit."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    handlers = set()
    plain = {**SETTINGS, "hidden_layers": (8,), "protocol": "quick",
             "on_event": lambda event: handlers.add(signal.getsignal(signal.SIGTERM))}  # fmt: skip
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        for name in ("NPROC", "XLA_FLAGS", "HOME"):
            patch.setenv(name, os.environ.get(name, ""))
        fair = saclab.train("Meddling-v0", runs="fair", **plain)
        ours = saclab.train("Meddling-v0", runs="ours", environment_arguments={"folder": str(elsewhere)}, **plain)
    assert ours.path == tmp_path / "ours/Meddling-v0/sac-auto/quick/seed-0"
    for name in ("metrics.jsonl", "evaluations.csv", "episodes.csv", "q_bias.csv"):
        assert without_seconds(ours.path / name) == without_seconds(fair.path / name)
    assert not list(elsewhere.iterdir())
    assert signal.SIG_IGN not in handlers


def test_what_is_waited_for_is_told_once(monkeypatch, caplog):
    """By a thread of its own, while the step goes on."""
    monkeypatch.setattr(watch, "SECONDS", 0.2)
    monkeypatch.setattr(watch, "LOOK_SECONDS", 0.05)
    monkeypatch.setitem(HAPPENINGS, "hang", lambda: wait_for(lambda: bool(caplog.messages)))
    monkeypatch.setattr(watch, "THREAD", "another, which looks more often")
    Rogue.made = count(1)
    environment = CheckedEnvironment("Rogue-v0", {"where": "step", "what": "hang", "at": 2})
    environment.reset(0)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            environment.step(np.zeros(1, np.float32))
    (told,) = [message for message in caplog.messages if "step has taken" in message]
    assert re.match(r"environment Rogue-v0: step has taken \d+ seconds and is not done", told)
    assert any(thread.daemon for thread in threading.enumerate() if thread.name == watch.THREAD)
