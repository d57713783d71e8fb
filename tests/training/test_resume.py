"""A run that is stopped or killed and goes on is, bit for bit, the run that was never stopped."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from saclab.protocols import make_config
from saclab.training import checkpoint as checkpoints
from saclab.training.events import Evaluated, Finished, Interrupted, Saved
from saclab.training.loop import train
from saclab.training.requests import Requests

SMALL = {
    "hidden_layers": (32, 32),
    "batch_size": 32,
    "random_steps": 200,
    "update_interval": 5,
    "replay_capacity": 300,  # it wraps around before and after the stop
    "evaluation_episodes": 1,
    "evaluation_interval_steps": 330,  # in the middle of an episode
    "log_interval": 7,  # windows are open at the stop
    "max_steps": 660,
}
HALF = 330


def config_of(environment: str, **changes):
    return make_config(environment, "averaged-auto", "paper", seed=3, overrides={
        "evaluation_interval_episodes": None, "max_updates": None, "snapshots": 3, **SMALL, **changes,
    })  # fmt: skip


def straight(config, folder: Path) -> Path:
    assert isinstance(list(train(config, folder))[-1], Finished)
    return folder


def stopped_and_resumed(config, folder: Path) -> Path:
    """Asked to stop after half the steps, saves, and goes on."""
    requests = Requests()
    for event in train(config, folder, requests):
        if isinstance(event, Evaluated):
            requests.stop = 2
    assert event == Interrupted(HALF)
    return straight(config, folder)


def killed_and_resumed(config, folder: Path) -> Path:
    """Saves after half the steps, goes on, and is gone before the next save; then goes on from the save."""
    requests, saved = Requests(), False
    events = train(config, folder, requests)
    for event in events:
        requests.save = isinstance(event, Evaluated)
        saved = saved or isinstance(event, Saved)
        if saved and event[0] != HALF and type(event).__name__ == "UpdatesLogged":
            break
    assert saved
    assert event.steps > HALF
    events.close()
    return straight(config, folder)


def without_seconds(path: Path) -> object:
    """A log's content, apart from its column of wall-clock times."""
    if path.suffix == ".csv":
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(path.open())]
    return [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in path.read_text().splitlines()]


def fingerprint(folder: Path) -> dict[str, object]:
    """Everything that a run leaves and that time does not enter."""
    newest = checkpoints.newest_first(folder / "checkpoints")[0]
    state = checkpoints.read_manifest(newest).state
    del state["logs"], state["counters"]["seconds"]  # the lengths of the logs depend on the digits of the seconds
    result = json.loads((folder / "result.json").read_text())
    del result["seconds"], result["files"]  # the logs' checksums depend on the seconds
    hashed = [*newest.glob("*.safetensors"), folder / "best" / "policy.safetensors", folder / "best" / "policy.json"]
    return {
        **{path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in hashed},
        **{name: without_seconds(folder / name) for name in ("metrics.jsonl", "episodes.csv", "evaluations.csv")},
        "step": newest.name,
        "state": state,
        "result": result,
    }


def assert_same_run(first: Path, second: Path) -> None:
    ours, theirs = fingerprint(first), fingerprint(second)
    assert ours.keys() == theirs.keys()
    assert {"learner.safetensors", "replay-0000.safetensors", "environments.safetensors"} < ours.keys()
    for name, value in ours.items():
        assert value == theirs[name], name


@pytest.mark.parametrize(
    ("environment", "interrupted"), [("Pendulum-v1", stopped_and_resumed), ("HalfCheetah-v4", killed_and_resumed)]
)
def test_an_interrupted_run_ends_as_the_straight_one_does(environment, interrupted, tmp_path, straight_runs):
    config, expected = straight_runs(environment)
    resumed = interrupted(config, tmp_path / "interrupted")
    assert_same_run(expected, resumed)
    sessions = (resumed / "sessions.jsonl").read_text().splitlines()
    assert [json.loads(line)["from_step"] for line in sessions] == [0, HALF]


@pytest.fixture(scope="module")
def straight_runs(tmp_path_factory):
    """The uninterrupted run of each environment, made once."""
    made = {}

    def run_of(environment: str):
        if environment not in made:
            config = config_of(environment)
            made[environment] = config, straight(config, tmp_path_factory.mktemp(environment) / "straight")
        return made[environment]

    return run_of


def test_the_straight_run_has_something_to_compare(straight_runs):
    _, folder = straight_runs("Pendulum-v1")
    found = fingerprint(folder)
    assert found["result"]["updates"] == (660 - 200) // 5
    assert len(found["metrics.jsonl"]) == 92 // 7 + 1
    assert [int(row["episode"]) for row in found["episodes.csv"]] == [0, 1, 2]
    assert [int(row["steps"]) for row in found["evaluations.csv"]] == [330, 660]


def test_another_process_with_the_same_seed_gives_the_same_run(straight_runs, tmp_path):
    """Another hash seed too: nothing may depend on the order of a set."""
    config, expected = straight_runs("Pendulum-v1")
    script = """
import json, sys
from pathlib import Path
from saclab.config import Config
from saclab.training.loop import train
for event in train(Config.from_dict(json.loads(sys.argv[1])), Path(sys.argv[2])):
    pass
"""
    folder = tmp_path / "other process"
    subprocess.run(
        [sys.executable, "-c", script, json.dumps(config.to_dict()), str(folder)],
        env={**os.environ, "PYTHONHASHSEED": "1", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},  # as in conftest.py
        check=True,
    )
    assert_same_run(expected, folder)


def test_a_damaged_checkpoint_costs_only_the_steps_since_the_one_before(straight_runs, tmp_path):
    config, expected = straight_runs("Pendulum-v1")
    folder, requests, saves = tmp_path / "damaged", Requests(), 0
    events = train(config, folder, requests)
    for event in events:
        requests.save = isinstance(event, Evaluated) or (saves == 1 and type(event).__name__ == "UpdatesLogged")
        saves += isinstance(event, Saved)
        if saves == 2:
            break
    events.close()
    newest = checkpoints.newest_first(folder / "checkpoints")[0]
    path = newest / "learner.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"?")

    started, *_ = resumed = list(train(config, folder))
    assert started.resumed_at_step == HALF
    assert any(newest.name in note and "damaged" in note for note in started.notes)
    assert isinstance(resumed[-1], Finished)
    assert_same_run(expected, folder)
