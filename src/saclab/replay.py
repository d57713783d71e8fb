"""A uniform ring buffer of transitions, one packed row each: one gather and one transfer make a batch."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

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


def layout_of(spec: EnvironmentSpec, settings: AlgorithmSettings) -> RowLayout:
    """The columns of a run's transitions."""
    return RowLayout(spec.observation_size, spec.action_size, len(settings.reward_terms) + 1)


class ReplayBuffer:
    """The last `capacity` transitions."""

    def __init__(self, capacity: int, layout: RowLayout) -> None:
        """Memory is taken from the system as rows are filled, not before."""
        self.layout = layout
        self.rows = np.zeros((capacity, layout.width), np.float32)
        """f32[capacity, width]; row i holds transition number i, i + capacity, …"""
        self.added = 0
        """Transitions added since the start of the run."""

    @property
    def capacity(self) -> int:
        return len(self.rows)

    @property
    def size(self) -> int:
        """Transitions held."""
        return min(self.added, self.capacity)

    def add(self, transitions: Transitions) -> None:
        """Store N transitions in place of the oldest ones."""
        rows = self.layout.pack(transitions)
        positions = np.arange(self.added, self.added + len(rows)) % self.capacity
        self.rows[positions] = rows
        self.added += len(rows)

    def sample(self, generator: np.random.Generator, batch_size: int) -> np.ndarray:
        """f32[batch_size, width], each row drawn uniformly and independently."""
        rows: np.ndarray = self.rows[draw(generator, self.size, batch_size)]
        return rows


def draw(generator: np.random.Generator, size: int, batch_size: int) -> np.ndarray:
    """i64[batch_size]: rows of a buffer that holds `size` transitions, drawn uniformly and independently."""
    return generator.integers(0, size, batch_size)


def replay_bytes(capacity: int, layout: RowLayout) -> int:
    """Memory of a full buffer."""
    return capacity * layout.width * np.dtype(np.float32).itemsize
