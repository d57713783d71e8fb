"""What the tests of this folder share: a small configuration, and how two runs are compared to the last bit."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from unittest import mock

from saclab.config import Config
from saclab.protocols import make_config
from saclab.training import loop
from saclab.training.checkpoint import newest_first, read_manifest
from saclab.training.engine import StepResult
from saclab.training.events import Event, Finished, Interrupted, Saved, UpdatesLogged
from saclab.training.local_engine import LocalEngine
from saclab.training.requests import Requests
from saclab.variants import variant_changes

STEPS = 240
SMALL = {
    "hidden_layers": (16, 16),
    "batch_size": 32,
    "random_steps": 60,
    "update_interval": 2,
    "replay_capacity": 150,  # it wraps around
    "evaluation_interval_steps": 90,
    "evaluation_episodes": 1,
    "log_interval": 7,  # a window is open at any stop
    "max_steps": STEPS,
}


def small_config(environment: str, variant: str = "averaged-auto", environments: int = 1, **changes: object) -> Config:
    overrides = {**SMALL, "parallel_environments": environments, **changes}
    if "critic_hidden_layers" in variant_changes(variant, environment):
        overrides = {"critic_hidden_layers": (16, 16), **overrides}
    return make_config(environment, variant, "standard", seed=5, overrides=overrides)


def finish(config: Config, folder: Path) -> list[Event]:
    """Train to the end, from wherever the folder stands."""
    events = list(loop.train(config, folder))
    assert isinstance(events[-1], Finished)
    return events


@contextmanager
def request_at(step: int, requests: Requests, what: str) -> Iterator[None]:
    """Let the request come when the run has done exactly so many steps, as no signal could."""
    real = LocalEngine.step

    def step_and_ask(engine: LocalEngine, *arguments: object) -> StepResult:
        result = real(engine, *arguments)
        if engine.run.counters.steps == step:
            setattr(requests, what, True)
        return result

    with mock.patch.object(LocalEngine, "step", step_and_ask):
        yield


def stop_at(step: int, config: Config, folder: Path) -> None:
    """Train until so many steps are done; the run saves and stops."""
    requests = Requests()
    with request_at(step, requests, "stop"):
        assert list(loop.train(config, folder, requests))[-1] == Interrupted(step)


def vanish_after(step: int, config: Config, folder: Path) -> None:
    """Save after so many steps, go on until more has been logged, and be gone."""
    requests, saved = Requests(), False
    with request_at(step, requests, "save"), closing(loop.train(config, folder, requests)) as events:
        for event in events:
            saved = saved or isinstance(event, Saved)
            if saved and isinstance(event, UpdatesLogged) and event.steps > step:
                break
    assert event.steps > step
    assert not (folder / "result.json").exists()


def without_seconds(path: Path) -> object:
    """A log's content, apart from its wall-clock times."""
    if path.suffix == ".csv":
        with path.open() as file:
            return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]
    if path.suffix == ".jsonl":
        return [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in path.read_text().splitlines()]
    return {key: value for key, value in json.loads(path.read_text()).items() if key not in ("seconds", "files")}


NOT_COMPARED = {"sessions.jsonl", "worker.log", "lock"}


def fingerprint(folder: Path) -> dict[str, object]:
    """Everything that a finished run leaves and that time does not enter."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir() or name in NOT_COMPARED or name.startswith("checkpoints/"):
            continue
        plain = path.suffix in (".csv", ".jsonl", ".json")
        found[name] = without_seconds(path) if plain else hashlib.sha256(path.read_bytes()).hexdigest()
    newest = newest_first(folder / "checkpoints")[0]
    manifest = read_manifest(newest)
    del manifest.state["logs"], manifest.state["counters"]["seconds"]  # logs are longer by the digits of seconds
    found[newest.name] = {"state": manifest.state, "replay": manifest.replay}
    for path in newest.glob("*.safetensors"):
        found[f"{newest.name}/{path.name}"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


MUST_BE_THERE = {"config.json", "metrics.jsonl", "episodes.csv", "evaluations.csv", "best/policy.safetensors",
                 "best/policy.json", "result.json"}  # fmt: skip


def assert_same_run(first: Path, second: Path) -> None:
    """Every result file equal, and the last learner, replay buffer, environments and generators bit for bit."""
    ours, theirs = fingerprint(first), fingerprint(second)
    assert ours.keys() == theirs.keys(), ours.keys() ^ theirs.keys()
    assert ours.keys() >= MUST_BE_THERE
    assert {name.partition("/")[2] for name in ours} >= {"learner.safetensors", "replay-0000.safetensors"}
    for name, value in ours.items():
        assert value == theirs[name], (name, value, theirs[name])


# --- processes


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "saclab", *arguments]


def environment_of(threads: int | None = 1) -> dict[str, str]:
    """The environment of a user's process: without what conftest.py sets, with so many threads."""
    plain = {key: value for key, value in os.environ.items() if key not in ("NPROC", "JAX_PLATFORMS")}
    limits = {} if threads is None else dict.fromkeys(("NPROC", "OPENBLAS_NUM_THREADS"), str(threads))
    return {**plain, "JAX_PLATFORMS": "cpu", **limits}


def start(folder: Path, *arguments: str, threads: int | None = 1) -> subprocess.Popen[str]:
    """`saclab` with these arguments in `folder`, in a process group of its own, its output in a pipe."""
    return subprocess.Popen(
        command(*arguments), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=environment_of(threads), process_group=0,
    )  # fmt: skip


def kill(process: subprocess.Popen[str]) -> None:
    """`kill -9` on the process and its helpers: `import glfw` asks a child of its own, which would complain."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def run(folder: Path, *arguments: str, threads: int | None = 1) -> str:
    """The output of `saclab` with these arguments, once it has ended well."""
    process = start(folder, *arguments, threads=threads)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    return output


def wait_for(condition: Callable[[], bool], seconds: float = 600, every: float = 0.005) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(every)


def lines_of(path: Path) -> list[dict]:
    """The whole lines: another process may be writing the next one."""
    text = path.read_text().rpartition("\n")[0] if path.exists() else ""
    return [json.loads(line) for line in text.splitlines()]


def settings(**overrides: object) -> Iterator[str]:
    """Settings as they stand on the command line."""
    for name, value in {**SMALL, **overrides}.items():
        yield "--" + name.replace("_", "-")
        yield from map(str, value if isinstance(value, tuple) else (value,))
