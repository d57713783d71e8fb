"""A Minari data set as transitions of an environment. No code that it names is imported or run."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Tuple
from gymnasium.wrappers import FlattenObservation

from saclab.environments.checked import CheckedEnvironment
from saclab.environments.vector import Transitions
from saclab.environments.wrappers import FlattenAction
from saclab.errors import SettingError, UserError, in_words
from saclab.extras import required
from saclab.records import JSON_BYTES, read_bytes

FLATTENING: Any = (FlattenObservation, FlattenAction)
ROUNDING = 1e-6


class DataSet(NamedTuple):
    """The newest transitions of a data set, episode after episode. N of `Transitions` is their number."""

    transitions: Transitions
    total: int
    """Transitions in the data set."""
    notes: list[str]
    """What the user should know."""


def read_data_set(name: str, environment: CheckedEnvironment, most: int) -> DataSet:
    """The last transitions of a data set on this machine.

    Args:
        name: its id, below MINARI_DATASETS_PATH or ~/.minari/datasets, or an absolute path.
        environment: what a run is trained on; its observations and actions may be flattened ones.
        most: how many transitions are wanted.

    Raises:
        UserError: if the package Minari is missing, there is no such data set, it cannot be read, its spaces are not
            the environment's, or a number in it is not finite.
    """
    minari = required("minari", "minari", "prefill minari:…")
    folder = data_folder(name)
    with reading(name):
        require_spaces_told(name, folder)
        data = minari.MinariDataset(folder)
        reader = EpisodeReader(name, data, environment)
        episodes, count = [], 0
        for episode in data.iterate_episodes(data.episode_indices[::-1]):
            if count >= most:
                break
            episodes.append(reader.transitions(episode))
            count += len(episodes[-1].terminated)
        total = int(data.total_steps)
    if not count:
        raise refused(name, "it holds no transitions")
    with reading(name):
        joined = Transitions(*map(np.concatenate, zip(*reversed(episodes), strict=True)))
    return DataSet(Transitions(*(part[-most:] for part in joined)), total, reader.notes())


def data_folder(name: str) -> Path:
    """Where the files of a data set lie; raises SettingError if there are none."""
    home = os.environ.get("MINARI_DATASETS_PATH") or os.path.expanduser("~/.minari/datasets")
    folder = Path(home) / name
    for found in (folder / "data", folder):
        if (found / "metadata.json").is_file():
            return found
    way_out = f"there is no data set in {folder}"
    if not name.startswith("/"):
        way_out += f": fetch it with minari download {name}, or set MINARI_DATASETS_PATH to where it lies"
    raise refused(name, way_out)


@contextmanager
def reading(name: str) -> Iterator[None]:
    """Turn whatever Minari raises into a SettingError."""
    try:
        yield
    except UserError:
        raise
    except MemoryError as error:
        raise no_memory(name) from error
    except Exception as error:
        raise refused(name, f"Minari cannot read it ({in_words(error)})") from error


def no_memory(name: str) -> SettingError:
    return refused(name, "there is no memory for its transitions: take fewer, with --prefill-transitions")


def refused(name: str, reason: str) -> SettingError:
    return SettingError("prefill", f"minari:{name}", reason)


def require_spaces_told(name: str, folder: Path) -> None:
    """Refuse a data set without spaces: Minari would make its environment to learn them, which runs code."""
    told = json.loads(read_bytes(folder / "metadata.json", JSON_BYTES))
    for space in ("observation_space", "action_space"):
        if not isinstance(told.get(space), str):
            raise refused(name, f"its metadata do not tell its {space}: write it anew with a newer Minari")


class EpisodeReader:
    """The episodes of a data set as transitions of an environment."""

    def __init__(self, name: str, data: Any, environment: CheckedEnvironment) -> None:
        """Compare their spaces; raises SettingError if they do not fit."""
        self.name, self.data, self.environment, self.spec = name, data, environment, environment.spec
        inner: Any = environment.environment
        while isinstance(inner, FLATTENING):
            inner = inner.env
        self.observation_space = in_order_of(data.observation_space, inner.observation_space)
        self.action_space = data.action_space
        self.clipped = 0
        if not isinstance(self.action_space, Box):
            raise self._unlike("action", inner.action_space)
        if flat_size(self.observation_space) != self.spec.observation_size:
            raise self._unlike("observation", inner.observation_space)
        if flat_size(self.action_space) != self.spec.action_size:
            raise self._unlike("action", inner.action_space)
        self._require_same_bounds()

    def _require_same_bounds(self) -> None:
        """Refuse actions on another scale, such as those recorded through RescaleAction: they would do other things."""
        low, high = self.action_space.low.reshape(-1), self.action_space.high.reshape(-1)
        if not (np.allclose(low, self.spec.action_low) and np.allclose(high, self.spec.action_high)):
            raise refused(
                self.name,
                f"its actions lie between {low} and {high}, and those of {self.environment.name} between "
                f"{self.spec.action_low} and {self.spec.action_high}: record it anew without a wrapper that rescales "
                "actions, or train in an environment registered with that wrapper",
            )

    def _unlike(self, what: str, here: Any) -> SettingError:
        there = getattr(self.data, f"{what}_space")
        return refused(self.name, f"its {what} space is {there}, and that of {self.environment.name} is {here}")

    def transitions(self, episode: Any) -> Transitions:
        """Those of one episode. Its last step leads to its last observation, terminal or not."""
        steps = len(episode.rewards)
        seen = flattened(self.observation_space, episode.observations, steps + 1)
        taken = self.spec.normalise_action(flattened(self.action_space, episode.actions, steps))
        with np.errstate(over="ignore"):
            rewards = np.asarray(episode.rewards).reshape(steps, 1).astype(np.float32)
            seen, taken = seen.astype(np.float32), taken.astype(np.float32)
        parts = {"action": taken, "reward": rewards, "observation": seen}
        for name, part in parts.items():
            for step in np.flatnonzero(~np.isfinite(part).all(axis=1)):
                raise refused(self.name, f"the {name} number {step} of episode {episode.id} is not finite")
        self.clipped += int((np.abs(taken) > 1 + ROUNDING).any(axis=1).sum())
        terminated = np.asarray(episode.terminations).reshape(steps).astype(bool)
        return Transitions(seen[:-1], np.clip(taken, -1, 1), rewards, seen[1:], terminated)

    def notes(self) -> list[str]:
        """What the user should know of the data set."""
        found, origin = [], self.data.env_spec
        if origin is not None and origin.id != self.environment.name.rpartition(":")[2]:
            found.append(f"the data set {self.name} is one of {origin.id}, and this run's is {self.environment.name}")
        if self.clipped:
            found.append(
                f"{self.clipped} action(s) of the data set {self.name} lay outside the bounds of "
                f"{self.environment.name}, and were clipped to them"
            )
        return found


def in_order_of(space: Space[Any], other: Space[Any]) -> Space[Any]:
    """A Dict with its entries in the order of another one of the same names, in which they are flattened."""
    if isinstance(space, Dict) and isinstance(other, Dict) and space.spaces.keys() == other.spaces.keys():
        ordered = Dict()
        ordered.spaces = {name: in_order_of(space[name], inner) for name, inner in other.spaces.items()}
        return ordered
    return space


def flat_size(space: Space[Any]) -> int | None:
    """Numbers in a value of the space, flattened; None for one that is not made of Boxes."""
    match space:
        case Box():
            return int(np.prod(space.shape))
        case Dict() | Tuple():
            parts = space.spaces.values() if isinstance(space, Dict) else space.spaces
            sizes = [flat_size(part) for part in parts]
            return None if None in sizes else sum(size for size in sizes if size is not None)
    return None


def flattened(space: Space[Any], values: Any, steps: int) -> np.ndarray:
    """The values of some steps as [steps, size], as Gymnasium's FlattenObservation has them."""
    match space:
        case Dict():
            parts = [flattened(part, values[name], steps) for name, part in space.spaces.items()]
            return np.concatenate(parts, axis=1)
        case Tuple():
            parts = [flattened(part, value, steps) for part, value in zip(space.spaces, values, strict=True)]
            return np.concatenate(parts, axis=1)
    array = np.asarray(values)
    if array.shape != (steps, *(space.shape or ())):
        raise ValueError(f"an episode has values of shape {array.shape} where {(steps, *(space.shape or ()))} is due")
    return array.reshape(steps, -1)
