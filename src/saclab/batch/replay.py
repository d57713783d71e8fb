"""The replay buffers of a group's runs, on their devices."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from saclab.batch.program import Program
from saclab.replay import RowLayout


class DeviceReplay:
    """A replay buffer for each slot of a program, filled with zeros."""

    def __init__(self, program: Program, capacity: int) -> None:
        self.capacity, self.layout = capacity, program.layout
        shape = (program.slots, capacity, program.layout.width)
        make = jax.jit(lambda: jax.numpy.zeros(shape, np.float32), out_shardings=program.sharding)
        self.rows: jax.Array = make()
        """f32[S, capacity, width]; used up and replaced whenever something is stored."""

    def load(self, slot: int, rows: np.ndarray) -> None:
        """Put the rows f32[capacity, width] of one slot in their place; they can be used again then."""
        self.rows = set_slot(self.rows, slot, rows).block_until_ready()

    def newest(self, added: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The rows f32[S, count, width] that were stored last, and the place i32[S] of their first."""
        first = (added - count) % self.capacity
        positions = (first + np.arange(count)) % self.capacity
        return np.asarray(self.rows[:, positions]), np.full(len(self.rows), first, np.int32)

    def slot(self, slot: int, added: int) -> SlotReplay:
        """The buffer of one slot as it is now, to be read before anything else is stored."""
        return SlotReplay(SlotRows(self.rows, slot), self.layout, self.capacity, added)


@dataclass(frozen=True)
class SlotRows:
    """The rows f32[capacity, width] of one slot; to index them means to fetch them from the device."""

    every: jax.Array
    slot: int

    def __getitem__(self, key: Any) -> np.ndarray:
        return np.asarray(self.every[self.slot, key])


@dataclass(frozen=True)
class SlotReplay:
    """The replay buffer of one slot, as far as a checkpoint has to read it."""

    rows: SlotRows
    layout: RowLayout
    capacity: int
    added: int

    @property
    def size(self) -> int:
        return min(self.added, self.capacity)


@partial(jax.jit, donate_argnums=0)
def set_slot(replay: jax.Array, slot: int, rows: np.ndarray) -> jax.Array:
    """f32[S, capacity, width] with the rows f32[capacity, width] of one slot put in their place."""
    return replay.at[slot].set(rows)
