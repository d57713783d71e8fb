"""What the tests of run groups share: small runs of one structure, and stopping them at a chosen step."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
from resume.helpers import SMALL as ALONE

from saclab.batch.builder import DeviceBuilder
from saclab.batch.engine import DeviceEngine
from saclab.batch.loop import train_batch
from saclab.config import Config
from saclab.protocols import make_config
from saclab.training.engine import build_new
from saclab.training.events import Event, Failed
from saclab.training.requests import Requests

TESTS = Path(__file__).parents[1]
SMALL = {**ALONE, "evaluation_episodes": 2, "acting_delay": 1}


def config(variant: str = "sac-auto", seed: int = 0, environment: str = "Pendulum-v1", **changes: object) -> Config:
    return make_config(environment, variant, "standard", seed, None, {**SMALL, **changes})


def mixed(**changes: object) -> list[Config]:
    """Runs of one group that differ in the seed and in plain numbers."""
    return [
        config("sac", 0, **changes),
        config("sac-auto", 1, **changes),
        config("sac-auto", 2, discount=0.9, polyak_rate=0.02, actor_learning_rate=1e-3, **changes),
    ]


def engine_of(configs: Sequence[Config], workers: int = 1) -> DeviceEngine:
    """The engine of these runs before their first step."""
    return build_new(DeviceBuilder(configs, 0, workers))


def folders(root: Path, configs: Sequence[Config]) -> list[Path]:
    return [root / f"run-{index}" for index in range(len(configs))]


def train(root: Path, configs: Sequence[Config], workers: int = 2, **options: object) -> list[tuple[int, Event]]:
    """All that the group tells; in folders that `folders` names."""
    return list(train_batch(configs, folders(root, configs), workers=workers, **options))


def failures(told: Sequence[tuple[int, Event]]) -> dict[int, str]:
    return {run: event.message for run, event in told if isinstance(event, Failed)}


@contextmanager
def at_step(step: int, happens: Callable[[DeviceEngine], None]) -> Iterator[None]:
    """Let something happen when the group has done exactly so many steps."""
    real = DeviceEngine.step

    def step_and_more(engine: DeviceEngine, *arguments: object) -> object:
        result = real(engine, *arguments)
        if engine.steps == step:
            happens(engine)
        return result

    with mock.patch.object(DeviceEngine, "step", step_and_more):
        yield


def stop_at(step: int, root: Path, configs: Sequence[Config]) -> list[tuple[int, Event]]:
    """Train until so many steps are done; the group saves and stops."""
    requests = Requests()
    with at_step(step, lambda engine: setattr(requests, "stop", 1)):
        return train(root, configs, requests=requests)


@contextmanager
def tiny_environments(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Let the processes of a group find the environments of `environments/tiny.py`; the prefix of their ids."""
    paths = [str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    yield "environments.tiny:"
