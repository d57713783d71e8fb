"""The camera that films a policy."""

from __future__ import annotations

import mujoco
import pytest

from saclab.playback import filmed_environment


@pytest.mark.parametrize("name", ["HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4", "Humanoid-v5"])
def test_the_camera_follows_the_robot(name: str) -> None:
    environment = filmed_environment(name, {}, size=64)
    model, renderer = environment.environment.unwrapped.model, environment.environment.unwrapped.mujoco_renderer
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    assert camera >= 0
    assert renderer.camera_id == camera
    assert (renderer.width, renderer.height) == (64, 64)
    environment.close()


def test_an_environment_that_knows_no_camera_keeps_its_own_view() -> None:
    environment = filmed_environment("Pendulum-v1", {"g": 9.0}, size=64)
    assert (environment.environment.unwrapped.g, environment.environment.unwrapped.render_mode) == (9.0, "rgb_array")
    environment.close()
