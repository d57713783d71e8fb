"""Fixtures of damaged and hostile checkpoints."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from saclab.training import checkpoint

from .stage import Stage


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "SEGMENT_ROWS", 40)
        yield Stage(tmp_path_factory.mktemp("stage"))


@pytest.fixture
def folder(stage, tmp_path):
    return Path(shutil.copytree(stage.saved, tmp_path / "run"))
