"""Environments of others: dm_control's suite and gymnasium-robotics, in an environment that has them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
PYTHON = TESTS.parent / ".venv-suites" / "bin" / "python"
INSTALLED = PYTHON.parents[1] / "installed"


@pytest.mark.slow
@pytest.mark.skipif(
    not INSTALLED.exists(),
    reason="dm_control and gymnasium-robotics are not installed: make suites",
)
def test_runs_on_dm_control_and_robotics_train_and_resume():
    script = Path(__file__).with_name("in_suites.py")
    ran = subprocess.run(
        [PYTHON, "-m", "pytest", "-q", script], capture_output=True, text=True, cwd=TESTS.parent, check=False,
        env=os.environ | {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout[-5000:] + ran.stderr[-2000:]
