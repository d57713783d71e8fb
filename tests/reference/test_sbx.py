"""One update against SBX 0.28's, a library that shares no code with saclab: plain SAC, DroQ, TQC and CrossQ.

From equal parameters, batch and noise, both in 64 bits. SBX runs in an environment of its own, which `make peers` sets
up; without it these tests are skipped.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ACTION_SIZE, OBSERVATION_SIZE, VARIANT_CASES, context, make_case

from saclab.algorithm.learner import Parts

from .conftest import cast
from .numpy_networks import BatchNormPerceptron, LayerNormPerceptron, Perceptron

PEERS = Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"
INSTALLED = PEERS.parents[1] / "installed"
SCRIPT = Path(__file__).with_name("sbx_update.py")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not INSTALLED.exists(), reason="SBX is not installed: make peers"),
]

# Numbers that 32 bits hold exactly.
NUMBERS = {
    "discount": 0.875,
    "polyak_rate": 0.25,
    "actor_learning_rate": 2**-8,
    "critic_learning_rate": 2**-8,
    "temperature_learning_rate": 2**-8,
    "initial_temperature": 1.0,
    "adam_beta_1": 0.5,
    "temperature_gradient": "log_alpha",
    "target_entropy": -2.0,
    "actor_interval": 1,
    "critic_hidden_layers": (9, 6),
}
# The algorithm of SBX, the row, and what differs from it: SBX's actor of DroQ goes by the smaller critic, its TQC has
# two critics, and flax draws its dropout in another way than saclab.
CASES = {
    "SAC": ("SAC", "sac-auto/mlp", {}),
    "DroQ": ("SAC", "droq/layer_norm_mlp", {"critic_dropout": 0.0, "actor_reduction": "minimum"}),
    "TQC": ("TQC", "tqc/mlp", {"critics": 2, "critic_atoms": 4, "dropped_quantiles": 1}),
    "CrossQ": ("CrossQ", "crossq/batch_renorm_mlp", {}),
    "CrossQ past its warm-up": ("CrossQ", "crossq/batch_renorm_mlp", {}),
}


@pytest.mark.usefixtures("sixty_four_bits")
@pytest.mark.parametrize("name", CASES)
def test_one_update_equals_that_of_sbx(name, tmp_path, monkeypatch):
    algorithm, row, changes = CASES[name]
    settings = dataclasses.replace(VARIANT_CASES[row], **NUMBERS | changes)
    case = make_case(settings)
    state, generator = case.initial_state(seed=1), np.random.default_rng(2)
    state = cast(state, np.float64)
    state = state._replace(
        actor=state.actor._replace(weights=moved(settings.network, state.actor.weights, name, generator)),
        critic=state.critic._replace(weights=moved(settings.network_of_critic, state.critic.weights, name, generator)),
        targets=state.targets + 0.01 * generator.normal(size=state.targets.shape),
    )
    batch = jax.tree.map(jnp.float64, case.batch(generator))
    noise = generator.normal(size=(2, settings.batch_size, ACTION_SIZE))

    request = in_sbx(algorithm, settings, state) | {"noise": noise, "reward": batch.reward_terms[:, 0]}
    request |= {part: getattr(batch, part) for part in ("observation", "action", "next_observation", "terminated")}
    answer = answer_of_sbx(tmp_path, algorithm, settings, request)

    draws = list(noise)
    monkeypatch.setattr(Parts, "noise", lambda self, observation, key: draws.pop(0))
    numbers = cast(case.numbers, np.float64)
    after = case.learner.update(numbers, state, batch, context(0))
    ours = in_sbx(algorithm, settings, after) | {"log_alpha": after.temperature.weights}
    ours |= gradients_in_sbx(algorithm, settings, after)
    assert ours.keys() == answer.keys()
    for part, found in ours.items():
        np.testing.assert_allclose(found, answer[part], rtol=1e-7, atol=1e-9, err_msg=part)


def moved(network: str, vectors, name: str, generator) -> np.ndarray:
    """Parameters away from their start; running statistics far from a batch's, and counted past the warm-up."""
    vectors = np.array(vectors) + 0.1 * generator.normal(size=np.shape(vectors))
    if network == "batch_renorm_mlp":
        vectors = np.where(np.arange(vectors.shape[-1]) == vectors.shape[-1] - 1, 0, np.abs(vectors) + 0.05)
        vectors[..., -1] = 100_000 if "past" in name else 0
    return vectors


def answer_of_sbx(folder: Path, algorithm: str, settings, request: dict) -> dict[str, np.ndarray]:
    chosen = {
        "learning_rate": settings.actor_learning_rate,
        "qf_learning_rate": settings.critic_learning_rate,
        "gamma": settings.discount,
        "policy_delay": 1,
        "target_entropy": settings.target_entropy,
        "policy_kwargs": {
            "net_arch": {"pi": settings.hidden_layers, "qf": settings.layers_of_critic},
            "optimizer_kwargs": {"b1": settings.adam_beta_1},
        },
    }
    if algorithm != "CrossQ":
        chosen["tau"] = settings.polyak_rate
    if algorithm == "TQC":
        chosen["policy_kwargs"]["n_quantiles"] = settings.critic_atoms
        chosen["top_quantiles_to_drop_per_net"] = settings.dropped_quantiles
    if settings.network_of_critic == "layer_norm_mlp":
        chosen["policy_kwargs"]["layer_norm"] = True
    np.savez(folder / "request.npz", algorithm=algorithm, settings=json.dumps(chosen), **request)
    ran = subprocess.run(
        [PEERS, SCRIPT, folder / "request.npz", folder / "answer.npz"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return dict(np.load(folder / "answer.npz"))


def in_sbx(algorithm: str, settings, state) -> dict[str, np.ndarray]:
    """The networks of a learner under the names that they have in SBX's trees."""
    critic, targets = np.float64(state.critic.weights), np.float64(state.targets)
    outputs = settings.critic_atoms if settings.critic_head == "quantile" else 1
    sizes = (OBSERVATION_SIZE + ACTION_SIZE, *settings.layers_of_critic, outputs)
    kind = settings.network_of_critic
    every = {"critic": critic} | ({"target": targets[0]} if len(targets) else {})
    parts = actor_parts(settings, np.float64(state.actor.weights))
    for who, vectors in every.items():
        each = [parts_of(kind, vector, sizes) for vector in vectors]
        if algorithm == "TQC":
            parts |= {f"{who} {i} {part}": value for i, own in enumerate(each) for part, value in own.items()}
        else:
            wrapped = "VmapCritic_0" if algorithm == "CrossQ" else "VmapContinuousCritic_0"
            for part in each[0]:
                parts[f"{who} {part.replace('/', f'/{wrapped}/', 1)}"] = np.stack([own[part] for own in each])
    return parts


def gradients_in_sbx(algorithm: str, settings, state) -> dict[str, np.ndarray]:
    """Adam's first moments: the first step itself is the same for gradients of any size."""
    actor, critic = (trained._replace(weights=trained.moments.mu) for trained in (state.actor, state.critic))
    moments = in_sbx(algorithm, settings, state._replace(actor=actor, critic=critic, targets=state.targets[:0]))
    return {f"moment of {n.replace(' params/', ' ')}": x for n, x in moments.items() if "batch_stats" not in n}


def actor_parts(settings, vector: np.ndarray) -> dict[str, np.ndarray]:
    """SBX has a layer for the means and another one for the log standard deviations."""
    parts = parts_of(settings.network, vector, (OBSERVATION_SIZE, *settings.hidden_layers, 2 * ACTION_SIZE))
    last = len(settings.hidden_layers)
    for kind in ("kernel", "bias"):
        both = parts.pop(f"params/Dense_{last}/{kind}")
        means, deviations = np.split(both, 2, axis=-1)
        parts |= {f"params/Dense_{last}/{kind}": means, f"params/Dense_{last + 1}/{kind}": deviations}
    return {f"actor {name}": value for name, value in parts.items()}


def parts_of(network: str, vector: np.ndarray, sizes: tuple[int, ...]) -> dict[str, np.ndarray]:
    """One packed network under flax's names."""
    if network == "batch_renorm_mlp":
        return batch_renorm_parts(BatchNormPerceptron(sizes, renormalised=True).unpack(vector))
    parts = {}
    for number, (kernel, bias) in enumerate(Perceptron(sizes).unpack(vector)):
        parts |= {f"params/Dense_{number}/kernel": kernel, f"params/Dense_{number}/bias": bias}
    if network == "layer_norm_mlp":
        for number, (scale, shift) in enumerate(LayerNormPerceptron(sizes).affine(vector)):
            parts |= {f"params/LayerNorm_{number}/scale": scale, f"params/LayerNorm_{number}/bias": shift}
    return parts


def batch_renorm_parts(own: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    parts = {}
    for name, value in own.items():
        number, _, kind = name.partition(" ")
        if kind in ("kernel", "bias"):
            parts[f"params/Dense_{number}/{kind}"] = value
        elif kind == "affine":
            parts |= {f"params/BatchRenorm_{number}/{part}": value[i] for i, part in enumerate(("scale", "bias"))}
        elif kind == "running":
            statistics = {"mean": value[0], "var": value[1], "r_max": 3.0, "d_max": 5.0, "steps": own["updates"][0]}
            parts |= {f"batch_stats/BatchRenorm_{number}/{part}": np.float64(x) for part, x in statistics.items()}
    return parts
