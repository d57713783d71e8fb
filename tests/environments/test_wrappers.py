"""What is put around an environment: Gymnasium's wrappers by name, ours, and anybody's."""

from __future__ import annotations

import json
import os
import sys
from functools import partial

import gymnasium
import numpy as np
import pytest
from batch.helpers import config as group_config
from batch.helpers import folders as group_folders
from batch.helpers import train as train_group
from gymnasium.spaces import Box
from resume.helpers import assert_same_run, finish, small_config, stop_at

import saclab
from saclab.environments.checked import CheckedEnvironment
from saclab.environments.make import make_environment
from saclab.environments.simulator import capture_state
from saclab.errors import UserError
from saclab.playback import evaluate, record
from saclab.report.train_command import train_command
from saclab.training.run_folder import read_run

from . import tiny  # noqa: F401 - registers them

OWN = '''
import gymnasium
import numpy as np


class Louder(gymnasium.RewardWrapper):
    """Ten times the reward."""

    saclab_stateless = True

    def reward(self, reward):
        return 10.0 * reward


class Quieter(Louder):
    """It does not say that it keeps nothing."""


def parts(environment):
    """A Dict in place of a Pendulum's three numbers."""
    space = gymnasium.spaces.Box(-8, 8, (1,), np.float64)
    return gymnasium.wrappers.TransformObservation(
        environment, lambda seen: {"x": seen[:1], "y": seen[1:2], "speed": seen[2:]},
        gymnasium.spaces.Dict({"x": space, "y": space, "speed": space}),
    )


def nothing(environment):
    return None


def broken(environment):
    raise RuntimeError("no such part")
'''


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of a user's wrappers, which worker processes find too."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "own_wrappers.py").write_text(OWN)
    (tmp_path / "modules" / "raising.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path / "modules")
    yield
    sys.modules.pop("own_wrappers", None)


class Square(gymnasium.Env):
    """Observations and actions of two dimensions, in 64 bits; it keeps the action that it was given."""

    def __init__(self, render_mode: str | None = None) -> None:
        self.observation_space = Box(-1, 1, (2, 3), np.float64)
        self.action_space = Box(np.array([[-1.0, -2.0]]), np.array([[1.0, 2.0]]), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.arange(6.0).reshape(2, 3) / 10, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.given = action
        return np.arange(6.0).reshape(2, 3) / 5, 1.0, False, False, {}


gymnasium.register("Square-v0", Square)


def test_boxes_of_any_shape_and_type_are_flattened_by_name():
    environment = CheckedEnvironment("Square-v0", wrappers=("FlattenObservation", "FlattenAction"))
    assert environment.spec.action_low.tolist() == [-1, -2]
    np.testing.assert_array_equal(environment.reset(0), np.arange(6) / 10)
    seen, *_ = environment.step(environment.spec.scale_action(np.array([0.5, 0.5], np.float32)))
    np.testing.assert_array_equal(seen, np.arange(6) / 5)
    given = environment.environment.unwrapped.given
    assert given.tolist() == [[0.5, 1.0]]
    assert given.dtype == np.float64


def test_a_dictionary_is_flattened_by_name():
    spec = CheckedEnvironment("Odd-v0", {"kind": "dict observation"}, wrappers=["FlattenObservation"]).spec
    assert spec.observation_size == 4


def test_the_first_wrapper_is_the_innermost(own):
    environment = make_environment("Pendulum-v1", wrappers=["own_wrappers:parts", "FlattenObservation"])
    observation, _ = environment.reset(seed=0)
    assert list(environment.env.observation_space) == ["speed", "x", "y"]
    plain, _ = make_environment("Pendulum-v1").reset(seed=0)
    np.testing.assert_array_equal(observation, plain[[2, 0, 1]])


@pytest.mark.parametrize(
    ("wrappers", "message"),
    [
        (["FlatenObservation"], "unknown wrapper 'FlatenObservation': did you mean 'FlattenObservation'"),
        (["vector"], "unknown wrapper 'vector'"),
        (["no_such_module:Wrapper"], "wrappers = 'no_such_module:Wrapper': there is no module no_such_module"),
        (["raising:Wrapper"], "wrappers = 'raising:Wrapper': its module cannot be imported: ZeroDivisionError"),
        ([":Wrapper"], "wrappers = ':Wrapper': write package.module:Name"),
        ([".own_wrappers:Louder"], "write package.module:Name"),
        (["own_wrappers:Louder:more"], "write package.module:Name"),
        (["gymnasium.wrappers:NormalizeObservation"], "use --observation-normalisation running"),
        (["ClipAction"], "leave it out: actions are clipped"),
        (["own_wrappers:Wrapper"], "wrappers = 'own_wrappers:Wrapper': .* write package.module:Name"),
        (["own_wrappers:broken"], "it cannot be put around the environment .RuntimeError: no such part.*:function"),
        (["own_wrappers:nothing"], "it gave NoneType in place of an environment"),
        (["FrameStackObservation"], "it cannot be put around the environment .TypeError.*package.module:function"),
        (["NormalizeObservation"], "use --observation-normalisation running"),
        (["NormalizeReward"], "use --reward-scaling deviation"),
        (["own_wrappers:parts"], "its observations are a Dict.*--wrappers FlattenObservation.*speed, x, y"),
    ],
)
def test_what_is_no_wrapper_is_refused_with_what_would_work(own, wrappers, message):
    with pytest.raises(UserError, match=message):
        make_environment("Pendulum-v1", wrappers=wrappers)


def test_shapes_that_must_be_flattened_say_by_what():
    with pytest.raises(UserError, match="use --wrappers FlattenObservation"):
        make_environment("Square-v0")
    with pytest.raises(UserError, match="use --wrappers FlattenAction"):
        make_environment("Square-v0", wrappers=["FlattenObservation"])


@pytest.mark.parametrize(
    ("wrapper", "captured"),
    [("FlattenObservation", True), ("FlattenAction", True), ("own_wrappers:Louder", True),
     ("own_wrappers:Quieter", False), ("TimeAwareObservation", False)],
)  # fmt: skip
def test_a_wrapper_that_is_known_to_keep_nothing_is_looked_through(own, wrapper, captured):
    environment = make_environment("Pendulum-v1", wrappers=[wrapper])
    environment.reset(seed=0)
    assert (capture_state(environment) is not None) == captured


WRAPPERS = ("own_wrappers:Louder", "own_wrappers:parts", "FlattenObservation")


def test_a_wrapped_run_and_its_policy_know_the_wrappers(own, tmp_path, monkeypatch):
    config = small_config("Pendulum-v1", wrappers=WRAPPERS)
    finish(config, tmp_path / "run")
    finish(small_config("Pendulum-v1", wrappers=WRAPPERS[1:]), tmp_path / "quiet")
    loud, quiet = (json.loads((tmp_path / name / "best/policy.json").read_text()) for name in ("run", "quiet"))
    assert loud["wrappers"] == list(WRAPPERS)
    assert loud["mean_return"] < 5 * quiet["mean_return"], "Pendulum's rewards are negative"
    with pytest.raises(UserError, match="imports the package own_wrappers: if you trust it, add --imports"):
        evaluate(tmp_path / "run", 1, 0)
    assert evaluate(tmp_path / "run", 1, 0, imports=["own_wrappers"]).mean_return < -5000, "ten times a Pendulum's"
    for use in (saclab.resume, partial(record, video=tmp_path / "x.mp4", steps=1, seed=0, size=64)):
        with pytest.raises(UserError, match="--imports own_wrappers"):
            use(tmp_path / "run")
    told = train_command(config)
    assert "--wrappers own_wrappers:Louder own_wrappers:parts FlattenObservation" in told


def test_a_run_whose_wrappers_keep_nothing_continues_exactly(own, tmp_path):
    wrappers = ("FlattenAction", "own_wrappers:Louder", "FlattenObservation")
    config = small_config("Hopper-v4", environments=3, wrappers=wrappers)
    finish(config, tmp_path / "straight")
    stop_at(90, config, tmp_path / "stopped")
    finish(config, tmp_path / "stopped")
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")


@pytest.mark.slow
def test_a_run_group_has_the_wrappers_too(own, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"), prepend=os.pathsep)
    configs = [group_config(seed=seed, wrappers=WRAPPERS) for seed in (0, 1)]
    train_group(tmp_path, configs)
    for folder in group_folders(tmp_path, configs):
        assert read_run(folder).evaluations["mean_return"].max() < -5000, "ten times a Pendulum's"
