"""A trained policy on disk, and in a user's hands."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from saclab.algorithm.policy import make_policy
from saclab.config import Config
from saclab.environments.make import EnvironmentSpec
from saclab.errors import UserError
from saclab.files import replace_file, write_json
from saclab.settings import AlgorithmSettings, algorithm_from_json

ACTION_TYPES = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
ARRAYS, DESCRIPTION = "policy.safetensors", "policy.json"


class TrainedPolicy:
    """Acts in the environment's own units, on NumPy alone; `predict` has Stable-Baselines3's signature."""

    def __init__(self, settings: AlgorithmSettings, spec: EnvironmentSpec, parameters: np.ndarray, seed: int = 0):
        self.policy = make_policy(settings, spec.observation_size, spec.action_size)
        self.spec = spec
        self.parameters = parameters
        self.generator = np.random.default_rng(seed)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions within the environment's bounds, and `state` as it came.

        Args:
            observation: [O], or [N, O] for a batch.
            state: unused; a policy without memory has none.
            episode_start: unused.
            deterministic: tanh of the mean, or a sample of the policy.

        Raises:
            UserError: if the observation's size is not the policy's.
        """
        observation = np.asarray(observation, np.float32)
        size = self.spec.observation_size
        if observation.ndim not in (1, 2) or observation.shape[-1] != size:
            raise UserError(f"observation has shape {observation.shape}, and this policy takes [{size}] or [N, {size}]")
        action = self.normalised_action(np.atleast_2d(observation), deterministic)
        return self.spec.scale_action(action).reshape(*observation.shape[:-1], self.spec.action_size), state

    def normalised_action(self, observation: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """Actions f32[N, A] in [-1, 1] for f32[N, O]."""
        if deterministic:
            action: np.ndarray = self.policy.mode(self.parameters, observation)
            return action
        noise = self.generator.standard_normal((len(observation), self.spec.action_size), np.float32)
        action = self.policy.act(self.parameters, observation, noise)
        return action


def save_policy(folder: Path, config: Config, spec: EnvironmentSpec, actor: np.ndarray, facts: dict[str, Any]) -> None:
    """Write a policy with what is needed to use it; `facts` are told beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {"actor": actor, "action_low": spec.action_low, "action_high": spec.action_high}
    replace_file(folder / ARRAYS, safetensors.numpy.save(arrays))
    description = {
        "environment": config.environment,
        "environment_arguments": config.environment_arguments,
        "observation_size": spec.observation_size,
        "action_size": spec.action_size,
        "algorithm": dataclasses.asdict(config.algorithm),
        **facts,
    }
    write_json(folder / DESCRIPTION, description)


def policy_folder(run: Path) -> Path:
    """Where the policy of a run lies: `best` in a run folder, or the folder itself."""
    return run / "best" if (run / "best").is_dir() else run


def read_description(run: Path) -> dict[str, Any]:
    """policy.json: the environment the policy is for, and its settings; raises UserError if it is damaged."""
    path = policy_folder(run) / DESCRIPTION
    try:
        description: dict[str, Any] = json.loads(path.read_text())
        if not isinstance(description["environment"], str) or not isinstance(
            description["environment_arguments"], dict
        ):
            raise TypeError("it names no environment")
    except (OSError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged ({error}): train again, or resume the run if it is unfinished") from error
    return description


def load_policy(run: Path | str) -> TrainedPolicy:
    """The best policy of a run, from its folder or from its `best` folder.

    Raises:
        UserError: if there is none, or its files are damaged.
    """
    folder = policy_folder(Path(run))
    if not folder.is_dir():
        raise UserError(f"there is no folder {run}: give that of a run, or its best policy's")
    if not (folder / ARRAYS).is_file():
        raise UserError(f"{run} holds no policy yet: the first is kept after the run's first evaluation")
    description = read_description(folder)
    try:
        arrays = safetensors.numpy.load((folder / ARRAYS).read_bytes())
        settings = algorithm_from_json(description["algorithm"])
        sizes = int(description["observation_size"]), int(description["action_size"])
        policy = TrainedPolicy(
            settings, EnvironmentSpec(*sizes, arrays["action_low"], arrays["action_high"]), arrays["actor"]
        )
        require_arrays(policy)
    except (safetensors.SafetensorError, OSError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"the policy in {folder} is damaged ({error}): train again, or resume the run if it is unfinished"
        ) from error
    return policy


def require_arrays(policy: TrainedPolicy) -> None:
    """Raise ValueError unless the arrays are those of the policy's sizes."""
    spec = policy.spec
    expected = {
        "actor": (policy.parameters, (policy.policy.network.size,), "f4"),
        "action_low": (spec.action_low, (spec.action_size,), ACTION_TYPES),
        "action_high": (spec.action_high, (spec.action_size,), spec.action_low.dtype.str[1:]),
    }
    for name, (array, shape, kinds) in expected.items():
        if array.shape != shape or array.dtype.str[1:] not in kinds or not np.isfinite(array).all():
            raise ValueError(f"{name} is not {list(shape)} finite numbers of type {kinds}")
