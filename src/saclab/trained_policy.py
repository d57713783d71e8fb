"""A trained policy on disk, and in a user's hands."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import safetensors.numpy

from saclab.algorithm.policy import make_policy
from saclab.config import Config, from_plain
from saclab.environments.make import EnvironmentSpec
from saclab.errors import UserError
from saclab.files import replace_file, write_json
from saclab.hub import download, is_address
from saclab.records import JSON_BYTES, UNREADABLE, Damaged, PolicyDescription, is_there, read_bytes, read_json
from saclab.settings import AlgorithmSettings

ACTION_TYPES = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
ARRAYS, DESCRIPTION = "policy.safetensors", "policy.json"
CHECKSUM = "checksum"
"""An array among the others, u8[32]: in their file, so that a crash between the two files leaves a policy that is
whole. Policies of before November 2026 have none."""
POLICY_BYTES = {DESCRIPTION: JSON_BYTES, ARRAYS: 2**32}
"""The files of a policy, and what somebody else's may have at most."""
RETRAIN = "train again, or resume the run if it is unfinished"


class TrainedPolicy:
    """Acts in the environment's own units, on NumPy alone; `predict` has Stable-Baselines3's signature."""

    def __init__(self, settings: AlgorithmSettings, spec: EnvironmentSpec, parameters: np.ndarray, seed: int = 0):
        self.settings = settings
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
    description = PolicyDescription(
        environment=config.environment,
        environment_arguments=config.environment_arguments,
        observation_size=spec.observation_size,
        action_size=spec.action_size,
        algorithm=dataclasses.asdict(config.algorithm),
        wrappers=config.training.wrappers,
        **facts,
    )
    arrays = {"actor": actor, "action_low": spec.action_low, "action_high": spec.action_high}
    arrays[CHECKSUM] = checksum(arrays, description)
    replace_file(folder / ARRAYS, safetensors.numpy.save(arrays))
    write_json(folder / DESCRIPTION, description)


def checksum(arrays: dict[str, np.ndarray], description: PolicyDescription) -> np.ndarray:
    """SHA-256, u8[32], of the arrays and of what is needed to use them; not of the facts told beside them."""
    used = msgspec.structs.replace(description, mean_return=None, episode=None)
    content = safetensors.numpy.save(arrays) + json.dumps(msgspec.to_builtins(used), sort_keys=True).encode()
    return np.frombuffer(hashlib.sha256(content).digest(), np.uint8)


def on_disk(run: Path | str) -> Path:
    """The folder of a run; for hf:user/name[@revision] that of its policy, downloaded if need be.

    Raises:
        UserError: if there is no such model on the Hugging Face Hub, or it cannot be reached.
    """
    return download(run, POLICY_BYTES) if is_address(run) else Path(run)


def policy_folder(run: Path) -> Path:
    """Where the policy of a run lies: `best` in a run folder, or the folder itself if it holds one."""
    return run if is_there(run / DESCRIPTION) or not is_folder(run / "best") else run / "best"


def is_folder(path: Path) -> bool:
    return is_there(path) and path.is_dir()


def read_description(run: Path) -> PolicyDescription:
    """policy.json: the environment the policy is for, and its settings; raises Damaged."""
    path = policy_folder(run) / DESCRIPTION
    try:
        return read_json(path, PolicyDescription)
    except Damaged as error:
        raise Damaged(path, error.reason, RETRAIN) from error


def load_policy(run: Path | str) -> TrainedPolicy:
    """The best policy of a run, from its folder, from its `best` folder, or from the Hugging Face Hub.

    Args:
        run: the folder; or hf:user/name, or hf:user/name@revision, which need the extra `hub`.

    Raises:
        UserError: if there is none, its files are damaged, or the Hub cannot be reached.
    """
    folder = policy_folder(on_disk(run))
    if not is_folder(folder):
        raise UserError(f"there is no folder {run}: give that of a run, or its best policy's")
    if not is_there(folder / ARRAYS):
        raise UserError(f"{run} holds no policy yet: the first is kept after the run's first evaluation")
    description = read_description(folder)
    try:
        arrays = safetensors.numpy.load(read_bytes(folder / ARRAYS))
        require_checksum(arrays, description)
        sizes = description.observation_size, description.action_size
        policy = TrainedPolicy(
            from_plain(AlgorithmSettings, description.algorithm),
            EnvironmentSpec(*sizes, arrays["action_low"], arrays["action_high"]), arrays["actor"],
        )  # fmt: skip
        require_arrays(policy)
    except (safetensors.SafetensorError, AttributeError, KeyError, TypeError, UserError, *UNREADABLE) as error:
        reason = error.reason if isinstance(error, Damaged) else error
        raise UserError(f"the policy in {folder} is damaged ({reason}): {RETRAIN}") from error
    return policy


def require_checksum(arrays: dict[str, np.ndarray], description: PolicyDescription) -> None:
    """Raise ValueError for arrays that no policy has, or that are not those that were saved with this description."""
    found = arrays.pop(CHECKSUM, None)
    if unknown := arrays.keys() - {"actor", "action_low", "action_high"}:
        raise ValueError(f"{ARRAYS} has an array {min(unknown)!r} that no policy has")
    if found is not None and not np.array_equal(found, checksum(arrays, description)):
        raise ValueError(f"{ARRAYS} and {DESCRIPTION} do not match their checksum")


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
