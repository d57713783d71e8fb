"""docs/sharing.md shows code that runs, and tells the limits that hold."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from saclab.cli.main import parse
from saclab.environments.make import EnvironmentSpec
from saclab.onnx_export import export_onnx
from saclab.protocols import make_config
from saclab.trained_policy import POLICY_BYTES, TrainedPolicy, load_policy, save_policy

TEXT = (Path(__file__).parents[2] / "docs" / "sharing.md").read_text()
COMMANDS = re.findall(r"^(saclab .*?)(?: +#.*)?$", TEXT, re.M)


def test_the_page_runs_the_exported_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_config("Pendulum-v1", overrides={"hidden_layers": (4,)})
    spec = EnvironmentSpec(3, 1, -2 * np.ones(1, np.float32), 2 * np.ones(1, np.float32))
    size = TrainedPolicy(config.algorithm, spec, np.zeros(0)).policy.network.size
    save_policy(tmp_path, config, spec, np.full(size, 0.1, np.float32), {})
    export_onnx(tmp_path, tmp_path / "policy.onnx")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.S)
    found: dict[str, np.ndarray] = {}
    exec(code, found)
    np.testing.assert_allclose(found["action"][0], load_policy(tmp_path).predict(np.zeros(3))[0], atol=4e-6)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_pages_commands_are_commands(command: str) -> None:
    assert len(COMMANDS) == 8
    parse(command.split()[1:])


def test_the_page_tells_how_large_files_may_be() -> None:
    assert POLICY_BYTES == {"policy.json": 64 * 2**20, "policy.safetensors": 4 * 2**30}
    assert "`policy.json` of at most 64 MiB, `policy.safetensors` of at most 4 GiB" in TEXT
