"""Whenever a save is cut off, the checkpoint before it or the new one is there, whole."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

from saclab.signals import requests_from_signals
from saclab.training import checkpoint, loop
from saclab.training.events import Interrupted

from .helpers import environment_of, small_config


def test_death_at_any_system_call_of_a_save_leaves_a_whole_checkpoint():
    """The old one or the new one."""
    program = Path(__file__).with_name("kill_at_every_call.py")
    result = subprocess.run(
        [sys.executable, str(program)], capture_output=True, text=True, timeout=600, env=environment_of(1)
    )
    assert result.returncode == 0, result.stderr
    deaths = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(deaths) > 120
    kinds = {death["died_at"] for death in deaths if death["died_at"]}
    assert kinds >= {"open a file", "write", "fsync", "rename", "link", "mkdir", "unlink", "rmdir", "close a file"}
    for death in deaths:
        assert death["loaded"] in (death["old"], 60), death
        assert death["then"] == 63, death
        assert not any(name.endswith(".partial") for name in death["left"]), death
    for old in {death["old"] for death in deaths}:
        loaded = [death["loaded"] for death in deaths if death["old"] == old]
        assert loaded == sorted(loaded, key=lambda step: step == 60), "old until the rename, new from then on"
        assert {*loaded} == {old, 60}


def test_any_number_of_signals_during_a_save_is_harmless(tmp_path, monkeypatch):
    """Each file of the checkpoint is written while signals come in."""
    config, real, sent = small_config("Pendulum-v1"), checkpoint.write_bytes, []

    def write_bytes(path, content):
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
            signal.raise_signal(number)
            sent.append(path.name)
        real(path, content)

    with requests_from_signals() as requests:
        monkeypatch.setattr(checkpoint, "write_bytes", write_bytes)
        requests.stop = signal.SIGTERM
        assert list(loop.train(config, tmp_path, requests))[-1] == Interrupted(0)
        assert requests.stop == signal.SIGTERM, "the first signal decides the exit status"
    assert len(sent) >= 3 * 5
    monkeypatch.undo()
    saved = checkpoint.newest_first(tmp_path / "checkpoints")
    assert len(saved) == 1
    assert checkpoint.read_manifest(saved[0]).state["counters"]["steps"] == 0
