"""What environments saclab takes, and what it says of the others."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from saclab.environments import make
from saclab.environments.make import environment_spec, make_environment
from saclab.errors import UserError

from . import tiny  # noqa: F401 - registers them

TRIED = (
    "HalfCheetah-v4", "HalfCheetah-v5", "Humanoid-v4", "Humanoid-v5", "Hopper-v4", "Walker2d-v4", "Ant-v4",
    "Pendulum-v1",
)  # fmt: skip


@pytest.mark.parametrize("name", TRIED)
def test_the_environment_makes_steps_and_has_the_sizes_it_says(name):
    environment = make_environment(name)
    spec = environment_spec(name, environment)
    observation, _ = environment.reset(seed=0)
    assert observation.shape == (spec.observation_size,)
    action = spec.scale_action(np.ones(spec.action_size, np.float32))
    assert environment.action_space.contains(action)
    observation, reward, *_ = environment.step(action)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    environment.close()


def test_sizes_of_the_papers_environments():
    specs = [environment_spec(name, make_environment(name)) for name in ("HalfCheetah-v4", "Humanoid-v4")]
    assert [(spec.observation_size, spec.action_size) for spec in specs] == [(17, 6), (376, 17)]


def test_an_id_of_a_module_that_registers_it_is_taken(tmp_path, monkeypatch):
    (tmp_path / "somebodys_package.py").write_text(
        "import gymnasium\nfrom environments.tiny import Counting\ngymnasium.register('Somebodys-v0', Counting)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert environment_spec("", make_environment("somebodys_package:Somebodys-v0")).observation_size == 3


def test_arguments_reach_the_environment():
    assert make_environment("Counting-v0", {"terminate_at": 4}).unwrapped.terminate_at == 4


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("HalfCheeta-v4", {}, "unknown environment 'HalfCheeta-v4': did you mean 'HalfCheetah-v4'"),
        ("halfcheetah-v4", {}, "did you mean 'HalfCheetah-v4'"),
        ("Pendulum-v9", {}, "did you mean 'Pendulum-v1'"),
        ("Half Cheetah", {}, "environment = 'Half Cheetah': Error: Malformed"),
        ("CartPole-v1", {}, "environment = 'CartPole-v1': its actions are discrete"),
        ("Odd-v0", {"kind": "discrete action"}, "its actions are discrete"),
        ("Odd-v0", {"kind": "dict action"}, "its action space is Dict"),
        ("Odd-v0", {"kind": "infinite action"}, "its action bounds are infinite"),
        ("Odd-v0", {"kind": "half infinite action"}, "its action bounds are infinite"),
        ("Odd-v0", {"kind": "dict observation"}, "observations are a Dict.*FlattenObservation.* keys are image, speed"),
        ("Odd-v0", {"kind": "square observation"}, "a Box of one dimension is needed.*FlattenObservation"),
        ("HalfCheetah-v4", {"wings": 2}, "environment_arguments = {'wings': 2}: HalfCheetah-v4 does not accept"),
        ("Pendulum-v1", {"wings": 2}, "environment_arguments = {'wings': 2}: Pendulum-v1 does not accept"),
        ("no_such_package.part:Env-v0", {}, "No module named 'no_such_package'.*package.module:Name-v0"),
        ("HalfCheetah-v2", {}, "environment = 'HalfCheetah-v2'"),
        ("HalfCheetah-v3", {}, "environment = 'HalfCheetah-v3'"),
        ("HalfCheetah-v5", {"xml_file": "no-such-file.xml"}, "no-such-file.xml"),
    ],
)
def test_what_cannot_be_trained_on_is_refused_in_one_line_that_says_why(name, arguments, message):
    with pytest.raises(UserError, match=message) as caught:
        make_environment(name, arguments)
    assert "\n" not in str(caught.value)


def test_a_dm_control_that_does_not_know_mujoco_4_is_told_apart(tmp_path, monkeypatch):
    """It reads a field of the model that is there no longer."""
    (tmp_path / "dm_control").mkdir()
    (tmp_path / "dm_control/index.py").write_text("def read(model):\n    return model.flex_vertedge\n")
    (tmp_path / "somebodys_suite.py").write_text(
        "import gymnasium, dm_control.index\n"
        "gymnasium.register('Suite-v0', lambda render_mode=None: dm_control.index.read(object()))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(make, "version", lambda package: "4.0.0")
    with pytest.raises(UserError, match=r"'flex_vertedge'; this dm_control needs MuJoCo 3: pip install 'mujoco<4'"):
        make_environment("somebodys_suite:Suite-v0")
    monkeypatch.setattr(make, "version", lambda package: "3.17.0")
    with pytest.raises(UserError, match=r"'flex_vertedge'$"):
        make_environment("somebodys_suite:Suite-v0")


def test_a_v4_environment_leaves_no_file_and_no_word_on_the_terminal(tmp_path):
    """A process of its own makes it, with a simulation that diverges, which MuJoCo warns about."""
    script = """
import numpy as np
from saclab.environments.make import make_environment
from saclab.environments.vector import TrainingEnvironments
from saclab.errors import NonFiniteError
make_environment("HalfCheetah-v4").reset(seed=0)
environments = TrainingEnvironments("HalfCheetah-v4", {}, [0])
data = environments.environments[0].environment.unwrapped.data
data.qvel[:] = 1e12
try:
    environments.step(np.zeros((1, 6), np.float32))
except NonFiniteError:
    pass
assert sum(warning.number for warning in data.warning) > 0
"""
    paths = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (done.stdout, done.stderr) == ("", "")
    assert list(tmp_path.iterdir()) == []
