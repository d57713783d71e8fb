"""One update by SBX, for test_sbx.py, which runs this in the environment that has it: `make peers`.

    python sbx_update.py REQUEST.npz ANSWER.npz

The request holds the algorithm's name, its settings as JSON, a batch, two draws of noise, and parameters by their names
in SBX's trees: `actor params/Dense_0/kernel`, `critic …`, `target …`; those of TQC, whose critics are two trees, under
`critic 0 …` and so on. The answer holds the same names after the update, Adam's first
moments as `moment of …`, and `log_alpha`.
"""

from __future__ import annotations

import functools
import json
import sys
from typing import Any

import flax.linen as nn
import gymnasium
import jax
import numpy as np
import optax
import sbx.common.policies
import torch
from flax.traverse_util import flatten_dict, unflatten_dict
from sbx import SAC, TQC, CrossQ
from sbx.common.distributions import TanhTransformedDistribution
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

STATES = {"SAC": {"critic": "qf_state"}, "CrossQ": {"critic": "qf_state"}}
STATES["TQC"] = {"critic 0": "qf1_state", "critic 1": "qf2_state"}


class Shapes(gymnasium.Env):
    """An environment that only tells the sizes of its spaces."""

    def __init__(self, observations: int, actions: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,))
        self.action_space = gymnasium.spaces.Box(-1, 1, (actions,))


def tree(request: dict[str, np.ndarray], prefix: str) -> dict[str, Any]:
    """The parameters whose names begin so."""
    found = {name.removeprefix(prefix + " "): array for name, array in request.items() if name.startswith(prefix + " ")}
    return unflatten_dict(found, sep="/")


def leaves(prefix: str, parameters: Any) -> dict[str, np.ndarray]:
    return {f"{prefix} {name}": np.asarray(array) for name, array in flatten_dict(parameters, sep="/").items()}


def given_sample(noise: list[np.ndarray]) -> Any:
    def sample(self: Any, seed: Any) -> Any:
        normal = self.distribution
        return self.bijector.forward(normal.mean() + normal.stddev() * noise.pop(0))

    return sample


def replaced(state: Any, request: dict[str, np.ndarray], name: str) -> Any:
    """A train state with the request's parameters, and moments of Adam that fit them."""
    parameters = tree(request, name)
    statistics = parameters.pop("batch_stats", None)
    parameters = parameters["params"] if statistics is not None else parameters
    changes = {"params": parameters, "opt_state": state.tx.init(parameters)}
    if statistics is not None:
        changes["batch_stats"] = statistics
    if any(key.startswith(name.replace("critic", "target") + " ") for key in request) and name.startswith("critic"):
        changes["target_params"] = tree(request, name.replace("critic", "target"))
    return state.replace(**changes)


def parameters_of(state: Any) -> dict[str, Any]:
    if hasattr(state, "batch_stats"):
        return {"params": state.params, "batch_stats": state.batch_stats}
    return state.params


def gradients_of(name: str, state: Any) -> dict[str, np.ndarray]:
    """Adam's first moments: the first step itself is the same for gradients of any size."""
    moments = leaves(name, optax.tree_utils.tree_get(state.opt_state, "mu"))
    return {f"moment of {part.replace(' params/', ' ')}": array for part, array in moments.items()}


def main(request_file: str, answer_file: str) -> None:
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_disable_jit", True)  # so that noise is drawn in the order of the update
    request = dict(np.load(request_file))
    algorithm, settings = str(request.pop("algorithm")), json.loads(str(request.pop("settings")))
    # PyTorch's, as DroQ's authors have it; flax's own is 1e-6.
    sbx.common.policies.nn.LayerNorm = functools.partial(nn.LayerNorm, epsilon=1e-5)
    TanhTransformedDistribution.sample = given_sample(list(request["noise"]))
    batch = [torch.from_numpy(request[name]) for name in ("observation", "action", "next_observation")]
    batch += [torch.from_numpy(request[name])[:, None] for name in ("terminated", "reward")]

    environment = Shapes(batch[0].shape[1], batch[1].shape[1])
    model = {"SAC": SAC, "TQC": TQC, "CrossQ": CrossQ}[algorithm]("MlpPolicy", environment, buffer_size=10, **settings)
    model.set_logger(Logger(None, []))
    model.replay_buffer.sample = lambda *arguments, **named: ReplayBufferSamples(*batch, None)
    states = STATES[algorithm]
    model.policy.actor_state = replaced(model.policy.actor_state, request, "actor")
    for name, attribute in states.items():
        setattr(model.policy, attribute, replaced(getattr(model.policy, attribute), request, name))
    model.train(gradient_steps=1, batch_size=len(batch[0]))

    answer = {}
    for name, attribute in ({"actor": "actor_state"} | states).items():
        state = getattr(model.policy, attribute)
        answer |= leaves(name, parameters_of(state)) | gradients_of(name, state)
        if hasattr(state, "target_params"):
            answer |= leaves(name.replace("critic", "target"), state.target_params)
    (log_alpha,) = jax.tree.leaves(model.ent_coef_state.params)
    np.savez(answer_file, log_alpha=np.asarray(log_alpha), **answer)


if __name__ == "__main__":
    main(*sys.argv[1:])
