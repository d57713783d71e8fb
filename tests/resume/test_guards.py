"""A run stops at the first number that is not finite, leaves what led to it, and never starts what cannot fit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from environments import tiny  # noqa: F401 - registers them

from saclab import memory
from saclab.errors import NonFiniteError, SettingError, TrainingFailed
from saclab.protocols import make_config
from saclab.settings import AlgorithmSettings
from saclab.training import checkpoint, failure, loop, run_writer, symptoms
from saclab.training.checkpoint import newest_first, read_manifest
from saclab.training.common_checkpoint import load_newest_checkpoint
from saclab.training.events import UpdatesLogged, Warned
from saclab.training.local_engine import LocalBuilder, LocalEngine
from saclab.training.requests import Requests
from saclab.training.snapshot import to_checkpoint

from .helpers import environment_of, request_at, small_config, vanish_after


def broken(config, folder: Path, steps_saved: int) -> tuple[str, dict, dict]:
    """Train until it breaks; the message, failure.json and the arrays. The checkpoint before it must be whole."""
    requests = Requests()
    with request_at(steps_saved, requests, "save"), pytest.raises(NonFiniteError) as error:
        list(loop.train(config, folder, requests))
    kept = newest_first(folder / "checkpoints")
    assert read_manifest(kept[0]).state["counters"]["steps"] == steps_saved
    assert f"{kept[0].name}, is kept" in str(error.value)
    assert str(folder / "failure") in str(error.value)
    assert not (folder / "result.json").exists()
    story = json.loads((folder / "failure" / "failure.json").read_text())
    assert story["message"] in str(error.value)
    return str(error.value), story, safetensors.numpy.load_file(folder / "failure" / "state.safetensors")


@pytest.mark.parametrize("what", ["observation", "reward"])
def test_an_environment_that_breaks_stops_the_run_with_its_step(tmp_path, what):
    config = make_config("Counting-v0", "sac", environment_arguments={"broken_at": 3, "broken": what}, overrides={
        "hidden_layers": (8,), "batch_size": 4, "random_steps": 12, "max_steps": 60, "evaluation_interval_steps": 100,
    })  # fmt: skip
    message, story, arrays = broken(config, tmp_path, steps_saved=2)
    assert "environment Counting-v0 number 0" in message
    assert "in step 3 of an episode" in message
    assert story["counters"]["steps"] == 2
    assert arrays["action"].shape == (1,)
    assert np.isnan(arrays["next_observation"]).any() == (what == "observation")
    assert np.isnan(arrays["reward"]) == (what == "reward")
    assert arrays["recent_transitions"].shape == (2, 3 + 1 + 1 + 3 + 1)
    assert ".actor.weights" in arrays


@pytest.mark.parametrize("field", ["critic_loss", "temperature"])
def test_an_update_that_breaks_is_named_and_the_environment_is_not_blamed(tmp_path, monkeypatch, field):
    """The policy that came of it would give the environment actions that are not finite."""
    real = LocalEngine.__init__

    def init(engine, start, replay):
        real(engine, start, replay)
        update = engine.update

        def breaking(numbers, state, rows, context):
            state, metrics = update(numbers, state, rows, context)
            if engine.run.counters.updates == 9:
                metrics = metrics.at[engine.run.metrics.index(field)].set(jnp.nan)
                state = state._replace(actor=state.actor._replace(weights=state.actor.weights * jnp.nan))
            return state, metrics

        engine.update = breaking

    monkeypatch.setattr(LocalEngine, "__init__", init)
    config = small_config("Pendulum-v1", log_interval=100)
    message, story, arrays = broken(config, tmp_path, steps_saved=70)
    assert f"update 10 gave a value that is not finite in {field}: lower the learning rates" in message
    assert story["counters"]["updates"] == 10
    assert np.isnan(arrays["metrics"][9]).any()
    assert np.isfinite(arrays["metrics"][:9]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_learner_that_is_not_finite_is_not_saved(value):
    engine = LocalEngine.new(small_config("Pendulum-v1"))
    critic = engine.learner_state.critic
    broken_critic = critic._replace(weights=critic.weights.at[0, 0].set(value))
    engine.learner_state = engine.learner_state._replace(critic=broken_critic)
    with pytest.raises(NonFiniteError, match=r"\.critic\.weights is not finite"):
        to_checkpoint(engine.snapshot(0), engine.capture_environments(0))
    engine.close()


def test_a_fixed_temperature_of_zero_has_a_logarithm_that_is_saved():
    engine = LocalEngine.new(small_config("Pendulum-v1", "sac", initial_temperature=0.0))
    saved = to_checkpoint(engine.snapshot(0), engine.capture_environments(0))
    assert np.isneginf(saved.groups["learner"][".temperature.weights"])
    engine.close()


@pytest.mark.parametrize(
    ("sane", "advice"),
    [
        ((1e-5, 0.9), ["cannot reach the target entropy: lower --target-entropy"]),
        ((1.1, 100.0), ["raise --target-entropy"]),
        (symptoms.SANE_TEMPERATURES, []),
    ],
    ids=["exploding", "collapsing", "sane"],
)
def test_a_runaway_temperature_is_told_once_with_advice(tmp_path, monkeypatch, sane, advice):
    """The temperature begins at 1 and stays near it for so few updates."""
    monkeypatch.setattr(symptoms, "SANE_TEMPERATURES", sane)
    config = small_config("Pendulum-v1", max_steps=110, evaluation_interval_steps=1_000)
    told = [event.message for event in loop.train(config, tmp_path) if isinstance(event, Warned)]
    assert len(told) == len(advice)
    assert all(words in message for words, message in zip(advice, told, strict=True))


@pytest.mark.parametrize(
    ("head", "bound", "scaling", "q_mean", "advice"),
    [
        ("categorical", 5.0, "none", -4.6, "cuts off what lies beyond 5: raise --critic-bound, or scale rewards"),
        ("categorical", 5.0, "deviation", 4.6, "cuts off what lies beyond 5: raise --critic-bound"),
        ("categorical", 5.0, "none", 4.4, ""),
        ("categorical", 5.0, "deviation_or_bound", 4.9, ""),
        ("scalar", 5.0, "none", 4.6, ""),
    ],
)
def test_values_near_the_bound_of_a_categorical_critic_are_told(head, bound, scaling, q_mean, advice):
    settings = AlgorithmSettings(critic_head=head, critic_bound=bound, reward_scaling=scaling)
    told = symptoms.values_at_the_bound(settings, {"q_mean": q_mean})
    assert advice in told
    assert bool(told) == bool(advice)
    assert ("scale rewards" in told) == (bool(advice) and scaling == "none")


@pytest.mark.parametrize("temperature", [1e-9, 1.0, 1e9])
def test_a_fixed_temperature_is_no_news(tmp_path, temperature):
    config = small_config(
        "Pendulum-v1", "sac", initial_temperature=temperature, max_steps=80, evaluation_interval_steps=1_000
    )
    events = list(loop.train(config, tmp_path))
    assert [event.means["temperature"] for event in events if isinstance(event, UpdatesLogged)] == pytest.approx(
        [temperature] * 2, rel=1e-5
    )
    assert not any(isinstance(event, Warned) for event in events)


# --- memory

FILL = """
import sys
from pathlib import Path
import numpy as np
from saclab.environments.vector import Transitions
from saclab.replay import ReplayBuffer, RowLayout, replay_bytes

def resident():
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) * 1024

layout, capacity, some = RowLayout(376, 17), 40_000, 400
rows = Transitions(np.ones((some, 376), np.float32), np.ones((some, 17), np.float32), np.ones((some, 1), np.float32),
                   np.ones((some, 376), np.float32), np.ones(some, bool))
buffer = ReplayBuffer(2 * some, layout)
for _ in range(4):
    buffer.add(rows)  # whatever is taken once and kept is taken now
before = resident()
buffer = ReplayBuffer(capacity, layout)
empty = resident() - before
for _ in range(capacity // some + 10):
    buffer.add(rows)
print(replay_bytes(capacity, layout), resident() - before, empty)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not tell a process's memory")
def test_a_replay_buffer_takes_the_memory_that_was_forecast():
    """A full one takes it, within 5 percent."""
    result = subprocess.run(
        [sys.executable, "-c", FILL], capture_output=True, text=True, timeout=600, env=environment_of(1), check=True
    )
    forecast, taken, empty = map(int, result.stdout.split())
    assert forecast == 40_000 * 771 * 4
    assert abs(taken - forecast) / forecast < 0.05
    assert empty < forecast / 10, "taken as it is filled"


def test_what_cannot_fit_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 2**20)
    with pytest.raises(SettingError, match=r"replay_capacity = 200000: .*GiB.*--replay-capacity \d+ or less"):
        list(loop.train(small_config("Pendulum-v1", replay_capacity=200_000), tmp_path / "run"))
    assert not (tmp_path / "run").exists()


# --- a disk that does not take it


def test_a_disk_that_fills_up_while_logs_are_written_is_told(tmp_path, monkeypatch):
    config = small_config("Pendulum-v1")
    vanish_after(70, config, tmp_path)
    kept = newest_first(tmp_path / "checkpoints")

    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_writer.Logs, "metrics", full)
    monkeypatch.setattr(run_writer.Logs, "close", full)
    with pytest.raises(TrainingFailed, match=r"No space left on device; what was saved is kept: make room.*resume"):
        list(loop.train(config, tmp_path))
    assert newest_first(tmp_path / "checkpoints") == kept


def test_a_folder_that_cannot_be_written_to_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TrainingFailed, match="cannot write to"):
        list(loop.train(small_config("Pendulum-v1"), tmp_path / "file" / "run"))


def test_a_full_disk_does_not_hide_the_number_that_broke_the_run(tmp_path, monkeypatch):
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(failure, "replace_file", full)
    arguments = {"broken_at": 3, "broken": "reward"}
    config = make_config("Counting-v0", "sac", environment_arguments=arguments, overrides={
        "hidden_layers": (8,), "batch_size": 4, "random_steps": 12, "max_steps": 60, "evaluation_interval_steps": 100,
    })  # fmt: skip
    with pytest.raises(NonFiniteError, match=r"reward nan.*could not be written"):
        list(loop.train(config, tmp_path))


def test_a_file_system_without_links_gets_whole_files(tmp_path, monkeypatch):
    def no_links(*arguments: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(checkpoint.os, "link", no_links)
    config = small_config("Pendulum-v1", random_steps=32, max_steps=34)
    list(loop.train(config, tmp_path, checkpoint_minutes=0))
    replay = LocalBuilder(config).replay
    assert load_newest_checkpoint(tmp_path / "checkpoints", replay, pytest.fail) is not None
