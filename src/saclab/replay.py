"""A uniform ring buffer of transitions, one packed row each: one gather and one transfer make a batch."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from saclab.algorithm.networks.network import Array
from saclab.algorithm.types import Batch
from saclab.environments.make import EnvironmentSpec
from saclab.environments.vector import Transitions
from saclab.settings import AlgorithmSettings


class RowLayout(NamedTuple):
    """The named columns of a row, in which a transition lies as 32-bit numbers."""

    observation_size: int
    action_size: int
    reward_terms: int = 1
    """What the reward is the weighted sum of; 1 is the reward itself."""

    @property
    def columns(self) -> dict[str, int]:
        """Name -> width, in their order: the fields of Transitions and Batch."""
        return {
            "observation": self.observation_size,
            "action": self.action_size,
            "reward_terms": self.reward_terms,
            "next_observation": self.observation_size,
            "terminated": 1,
        }

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return sum(self.columns.values())

    def pack(self, transitions: Transitions) -> np.ndarray:
        """f32[N, width]."""
        *columns, terminated = transitions
        rows: np.ndarray = np.concatenate([*columns, terminated[:, None]], axis=1)
        return rows.astype(np.float32, copy=False)

    def unpack(self, rows: Array) -> Batch:
        """A batch from f32[B, width], NumPy or JAX."""
        ends = accumulate(self.columns.values())
        parts = {
            name: rows[:, end - width : end] for (name, width), end in zip(self.columns.items(), ends, strict=True)
        }
        return Batch(**parts | {"terminated": parts["terminated"][:, 0]})

    def unpack_windows(self, windows: Array, steps: Array, discount: Array) -> Batch:
        """A batch of windows f32[B, n, width], of which the first `steps` i32[B] transitions of each count.

        A row goes from the first observation to the last next one; each of its reward terms is the sum over
        i of γⁱ times that of transition i.
        """
        size, longest, _ = windows.shape
        places = jnp.arange(longest)
        weight = jnp.where(places < steps[:, None], discount**places, 0)
        first = self.unpack(windows[:, 0])
        last = self.unpack(windows[jnp.arange(size), steps - 1])
        terms = self.unpack(windows.reshape(size * longest, -1)).reward_terms.reshape(size, longest, -1)
        return Batch(
            first.observation, first.action, jnp.sum(weight[:, :, None] * terms, axis=1), last.next_observation,
            last.terminated, steps.astype(jnp.float32),
        )  # fmt: skip


def layout_of(spec: EnvironmentSpec, settings: AlgorithmSettings) -> RowLayout:
    """The columns of a run's transitions."""
    return RowLayout(spec.observation_size, spec.action_size, len(settings.terms_of_reward) + 1)


class Windows(NamedTuple):
    """How rows that follow each other in an episode are found in a ring of rows.

    Rows lie as they were stored, those of one step of all environments side by side, so the next row of an episode lies
    as many places on as there are environments. It belongs to the same episode if it begins with the observation at
    which the row before ended. (Where an episode starts in the very state in which a time limit cut the one before,
    going on is right as well: what follows a state does not depend on how it was reached.)
    """

    layout: RowLayout
    longest: int
    """n: transitions in a window at most."""
    environments: int

    def gather(self, rows: Array, drawn: Array, end: Array) -> tuple[Array, Array]:
        """The windows that begin at some rows, NumPy or JAX.

        Args:
            rows: f32[capacity, width], a ring.
            drawn: i[B], places of their first rows.
            end: i[], the place behind the newest row.

        Returns:
            f32[B, n, width], and how many transitions of each count, i[B]: up to a terminal state, to a time limit, to
            the newest row.
        """
        xp = rows.__array_namespace__()
        capacity = len(rows)
        ahead = xp.arange(self.longest) * self.environments
        windows = rows[(drawn[:, None] + ahead) % capacity]
        size = len(drawn)
        batch = self.layout.unpack(windows.reshape(size * self.longest, -1))
        observation = batch.observation.reshape(size, self.longest, -1)
        next_observation = batch.next_observation.reshape(size, self.longest, -1)
        ended = batch.terminated.reshape(size, self.longest) > 0
        stored = ahead <= ((end - 1 - drawn) % capacity)[:, None]
        follows = xp.all(observation[:, 1:] == next_observation[:, :-1], axis=2) & ~ended[:, :-1] & stored[:, 1:]
        return windows, 1 + xp.sum(xp.cumprod(follows.astype(xp.int32), axis=1), axis=1)

    def packed(self, rows: np.ndarray, drawn: np.ndarray, end: int) -> np.ndarray:
        """What `gather` finds, f32[B, n · width + 1]: one array on the way to a device."""
        windows, steps = self.gather(rows, drawn, np.int64(end))
        return np.concatenate([windows.reshape(len(drawn), -1), steps[:, None]], axis=1, dtype=np.float32)


class ReplayBuffer:
    """The last `capacity` transitions."""

    def __init__(self, capacity: int, layout: RowLayout) -> None:
        """Memory is taken from the system as rows are filled, not before."""
        self.layout = layout
        self.rows = np.zeros((capacity, layout.width), np.float32)
        """f32[capacity, width]; row i holds transition number i, i + capacity, …"""
        self.added = 0
        """Transitions added since the start of the run, those that it began with counted in."""

    @property
    def capacity(self) -> int:
        return len(self.rows)

    @property
    def size(self) -> int:
        """Transitions held."""
        return min(self.added, self.capacity)

    def add(self, transitions: Transitions) -> None:
        """Store N transitions in place of the oldest ones."""
        self.add_rows(self.layout.pack(transitions))

    def add_rows(self, rows: np.ndarray) -> None:
        """Store packed transitions f32[N, width], at most `capacity`, in place of the oldest ones."""
        positions = np.arange(self.added, self.added + len(rows)) % self.capacity
        self.rows[positions] = rows
        self.added += len(rows)

    def sample(self, generator: np.random.Generator, batch_size: int) -> np.ndarray:
        """f32[batch_size, width], each row drawn uniformly and independently."""
        rows: np.ndarray = self.rows[draw(generator, self.size, batch_size)]
        return rows

    def sample_windows(self, generator: np.random.Generator, batch_size: int, windows: Windows) -> np.ndarray:
        """f32[batch_size, n · width + 1]: windows that begin at rows drawn as by `sample`, and how long each is."""
        return windows.packed(self.rows, draw(generator, self.size, batch_size), self.added % self.capacity)


def draw(generator: np.random.Generator, size: int, batch_size: int) -> np.ndarray:
    """i64[batch_size]: rows of a buffer that holds `size` transitions, drawn uniformly and independently."""
    return generator.integers(0, size, batch_size)


def replay_bytes(capacity: int, layout: RowLayout) -> int:
    """Memory of a full buffer."""
    return capacity * layout.width * np.dtype(np.float32).itemsize
