"""The camera that films a policy, and policies that do not fit what they are played in."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from saclab.environments.make import EnvironmentSpec
from saclab.errors import SettingError, UserError
from saclab.playback import evaluate, filmed_environment, record
from saclab.protocols import make_config
from saclab.records import PolicyDescription
from saclab.trained_policy import TrainedPolicy, save_policy


@pytest.mark.parametrize("name", ["HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4", "Humanoid-v5"])
def test_the_camera_follows_the_robot(name: str) -> None:
    environment = filmed_environment(described(name), size=64)
    model, renderer = environment.environment.unwrapped.model, environment.environment.unwrapped.mujoco_renderer
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    assert camera >= 0
    assert renderer.camera_id == camera
    assert (renderer.width, renderer.height) == (64, 64)
    environment.close()


def test_an_environment_that_knows_no_camera_keeps_its_own_view() -> None:
    environment = filmed_environment(described("Pendulum-v1", g=9.0), size=64)
    assert (environment.environment.unwrapped.g, environment.environment.unwrapped.render_mode) == (9.0, "rgb_array")
    environment.close()


def test_a_film_is_of_the_environment_inside_its_wrappers() -> None:
    environment = filmed_environment(described("Hopper-v4", wrappers=("TimeAwareObservation",)), size=64)
    assert environment.spec.observation_size == 12
    assert environment.environment.unwrapped.mujoco_renderer.width == 64
    environment.close()


def described(environment: str, wrappers: tuple[str, ...] = (), **arguments: object) -> PolicyDescription:
    return PolicyDescription(environment, arguments, 1, 1, {}, wrappers=wrappers)


def saved_policy(folder: Path, environment: str, arguments: dict[str, object], spec: EnvironmentSpec) -> Path:
    """A policy that does nothing, signed for an environment and arguments that need not be its own."""
    config = make_config(environment, overrides={"hidden_layers": (4,)})
    config = dataclasses.replace(config, environment_arguments=arguments)
    size = TrainedPolicy(config.algorithm, spec, np.zeros(0)).policy.network.size
    save_policy(folder / "best", config, spec, np.zeros(size, np.float32), {})
    return folder


ONE = np.ones(1, np.float32)
SIX = np.ones(6, np.float32)


@pytest.mark.parametrize("play", [lambda run: evaluate(run, 1, 0), lambda run: record(run, run / "x.mp4", 1, 0, 64)])
def test_a_policy_of_another_environment_is_named(tmp_path: Path, play: Callable[[Path], object]) -> None:
    saved_policy(tmp_path, "Pendulum-v1", {}, EnvironmentSpec(17, 6, -SIX, SIX))
    with pytest.raises(UserError, match=r"not one for Pendulum-v1: its observation_size is 17, and there it is 3"):
        play(tmp_path)


@pytest.mark.parametrize("name", ["/etc/passwd", "/nowhere.xml", "\0", "x" * 5000])
def test_a_file_named_in_a_policys_arguments_is_one_line(tmp_path: Path, name: str) -> None:
    saved_policy(tmp_path, "HalfCheetah-v5", {"xml_file": name}, EnvironmentSpec(17, 6, -SIX, SIX))
    with pytest.raises(UserError, match="HalfCheetah-v5"):
        evaluate(tmp_path, 1, 0)


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_what_is_no_seed_is_named(tmp_path: Path, seed: int) -> None:
    saved_policy(tmp_path, "Pendulum-v1", {}, EnvironmentSpec(3, 1, -2 * ONE, 2 * ONE))
    with pytest.raises(SettingError, match=f"seed = {seed}"):
        evaluate(tmp_path, 1, seed)
    assert evaluate(tmp_path, 1, 0).episodes == 1
