"""What the device engine is made of: the program, and the replay buffers that checkpoints are read into."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import jax
import numpy as np

from saclab.batch.engine import DeviceEngine
from saclab.batch.program import Program
from saclab.batch.replay import DeviceReplay
from saclab.config import Config
from saclab.memory import require_memory
from saclab.replay import ReplayBuffer, layout_of
from saclab.settings import structure
from saclab.training.checkpoint import Checkpoint, read_checkpoint
from saclab.training.engine import spec_of
from saclab.training.snapshot import Start

program_of = lru_cache(maxsize=4)(Program)  # groups of one grid mostly have the same one


class DeviceBuilder:
    """An `EngineBuilder` of a run group."""

    def __init__(self, configs: Sequence[Config], slots: int, workers: int) -> None:
        """Make room for its replay buffers.

        Args:
            configs: those of the runs, all with the same `config.group_key`.
            slots: how many runs the compiled program has room for, if more than these.
            workers: processes that step the environments.

        Raises:
            UserError: if the environment cannot be trained on, or the runs do not fit in memory.
        """
        self.configs, self.workers = configs, workers
        training, self.spec = configs[0].training, spec_of(configs[0])
        self.layout = layout_of(self.spec, configs[0].algorithm)
        self.program = program_of(
            structure(configs[0].algorithm), self.layout, training.parallel_environments, max(slots, len(configs))
        )
        self.slots = self.program.slots
        require_memory(configs[0], self.layout, self.slots, "--batch", memory_of_devices(self.program))
        self.replay = DeviceReplay(self.program, training.replay_capacity)

    def read(self, run: int, path: Path) -> Checkpoint:
        buffer = ReplayBuffer(self.replay.capacity, self.layout)
        checkpoint = read_checkpoint(path, buffer)
        self.replay.load(run, buffer.rows)
        return checkpoint

    def fill(self, run: int, rows: np.ndarray) -> None:
        buffer = ReplayBuffer(self.replay.capacity, self.layout)
        buffer.add_rows(rows)
        self.replay.load(run, buffer.rows)

    def build(self, starts: Sequence[Start]) -> DeviceEngine:
        return DeviceEngine(starts, self.spec, self.program, self.replay, self.workers)


def memory_of_devices(program: Program) -> int | None:
    """Bytes that JAX may use on all devices together; None where they share the machine's memory."""
    limits = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in program.mesh.devices.flat]
    return None if jax.default_backend() == "cpu" or 0 in limits else sum(limits)
