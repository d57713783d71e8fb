"""A policy as an ONNX graph acts as it does here, whatever its networks are."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
import onnx
import onnxruntime
import pytest

from saclab.algorithm.networks.network import ACTIVATIONS
from saclab.cli.main import main
from saclab.environments.make import EnvironmentSpec
from saclab.errors import UserError
from saclab.onnx_export import Graph, export_onnx
from saclab.protocols import own_config
from saclab.trained_policy import TrainedPolicy, load_policy, save_policy
from saclab.variants import VARIANTS

LOW, HIGH = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)
OBSERVATIONS = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32) * 3
NOISE = np.random.default_rng(2).normal(size=(40, 2)).astype(np.float32)


def saved(folder: Path, low=LOW, high=HIGH, variant: str = "sac-auto", **overrides: object) -> TrainedPolicy:
    """A policy away from its start that has been saved and loaded: running statistics positive, as they are."""
    config = own_config("Some-v0", variant, "standard", overrides=overrides)
    spec = EnvironmentSpec(3, 2, low, high)
    network = TrainedPolicy(config.algorithm, spec, np.zeros(0)).policy.network
    generator = np.random.default_rng(0)
    first = np.asarray(network.init(jax.random.PRNGKey(0)))
    actor = (first + generator.normal(scale=0.05, size=network.size)).astype(np.float32)
    if network.statistics:
        actor[-network.statistics :] = generator.uniform(0.5, 2, network.statistics)
    save_policy(folder / "best", config, spec, actor, {})
    return load_policy(folder)


def session_of(folder: Path) -> onnxruntime.InferenceSession:
    export_onnx(folder, folder / "policy.onnx")
    return onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])


def assert_same_actions(folder: Path, policy: TrainedPolicy) -> None:
    session = session_of(folder)
    (action,) = session.run(["action"], {"observation": OBSERVATIONS})
    (sampled,) = session.run(["sampled_action"], {"observation": OBSERVATIONS, "noise": NOISE})
    expected, _ = policy.predict(OBSERVATIONS)
    expected_sample = policy.spec.scale_action(policy.policy.act(policy.parameters, OBSERVATIONS, NOISE))
    reach = float(np.max(policy.spec.action_high.astype(float) - policy.spec.action_low))
    np.testing.assert_allclose(action, expected, rtol=0, atol=5e-6 * reach)
    np.testing.assert_allclose(sampled, expected_sample, rtol=0, atol=5e-6 * reach)
    assert action.dtype == sampled.dtype == expected.dtype
    assert np.ptp(expected.astype(float), axis=0).min() > 1e-3 * reach, "the actions differ from row to row"
    (row,) = session.run(["action"], {"observation": OBSERVATIONS[:1]})
    np.testing.assert_allclose(row, action[:1], rtol=0, atol=2e-6 * reach)


DEAREST = "simbav2", "flashsac", "xqc", "crossq"


@pytest.mark.parametrize(
    "variant", [pytest.param(name, marks=pytest.mark.slow) if name in DEAREST else name for name in VARIANTS]
)
def test_every_variant_acts_in_onnx_as_it_does_here(variant, tmp_path):
    assert_same_actions(tmp_path, saved(tmp_path, variant=variant))


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("network", ["mlp", "layer_norm_mlp"])
def test_so_do_other_networks_and_activations(network, activation, tmp_path):
    policy = saved(tmp_path, network=network, activation=activation, observation_normalisation="running")
    assert_same_actions(tmp_path, policy)


@pytest.mark.parametrize(
    ("low", "high"),
    [(np.array([-1.0, -3.0]), np.array([1.0, 5.0])), (np.array([-100, 0], np.int16), np.array([100, 50], np.int16))],
    ids=["64 bits", "whole numbers"],
)
def test_actions_are_of_the_environments_own_type(low, high, tmp_path):
    policy = saved(tmp_path, low, high, hidden_layers=(16,))
    (action,) = session_of(tmp_path).run(["action"], {"observation": OBSERVATIONS})
    expected, _ = policy.predict(OBSERVATIONS)
    assert action.dtype == low.dtype
    assert np.abs(action.astype(float) - expected).max() <= (1 if low.dtype.kind == "i" else 4e-5)
    assert np.mean(action == expected) > 0.9 or low.dtype.kind == "f"


def test_the_command_writes_the_file_and_the_model_says_what_it_is(tmp_path, capsys):
    saved(tmp_path, hidden_layers=(8,))
    assert main(["export", str(tmp_path), "--out", str(tmp_path / "deep" / "own.onnx")]) == 0
    assert "own.onnx" in capsys.readouterr().out
    told = {entry.key: entry.value for entry in onnx.load(tmp_path / "deep" / "own.onnx").metadata_props}
    assert json.loads(told["policy"])["environment"] == "Some-v0"
    assert main(["export", str(tmp_path)]) == 0
    assert (tmp_path / "best" / "policy.onnx").exists()
    assert main(["export", str(tmp_path / "nothing")]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_an_operation_that_is_not_known_is_named():
    value = Graph(onnx).input("observation", 3)
    with pytest.raises(UserError, match=r"its network calls numpy.sin, whose ONNX operation is not in saclab"):
        np.sin(value)
