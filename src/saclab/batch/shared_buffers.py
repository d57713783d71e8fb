"""The arrays through which the processes of a run group exchange steps: shared memory that no crash leaves behind."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from saclab.replay import RowLayout


class Sizes(NamedTuple):
    runs: int
    environments: int
    """Environments of each run."""
    layout: RowLayout
    """Columns of a transition."""


class SharedBuffers:
    """N = runs × environments; the environments of run r are at [r · environments, (r + 1) · environments)."""

    def __init__(self, sizes: Sizes, file_descriptor: int | None = None) -> None:
        """Shared memory filled with zeros, or that of another process."""
        self.sizes = sizes
        total = sizes.runs * sizes.environments
        layout = sizes.layout
        shapes: dict[str, tuple[tuple[int, ...], type]] = {
            "total_reward": ((total,), np.float64),
            "length": ((total,), np.int64),
            "action": ((total, layout.action_size), np.float32),
            "row": ((total, layout.width), np.float32),
            "observation": ((total, layout.observation_size), np.float32),
            "ended": ((total,), np.bool_),
            "terminated": ((total,), np.bool_),
            "active": ((sizes.runs,), np.bool_),
            "stop": ((1,), np.bool_),
        }
        size = sum(math.prod(shape) * np.dtype(kind).itemsize for shape, kind in shapes.values())
        if file_descriptor is None:
            # A file without a name: the system takes it back when the last process has ended, however it ends.
            shared = Path("/dev/shm")
            with tempfile.TemporaryFile(dir=shared if shared.is_dir() else None) as file:
                file_descriptor = os.dup(file.fileno())
            os.ftruncate(file_descriptor, size)
        self.file_descriptor = file_descriptor
        memory, offset = mmap.mmap(file_descriptor, size), 0
        arrays: dict[str, np.ndarray] = {}
        for name, (shape, kind) in shapes.items():
            arrays[name] = np.frombuffer(memory, kind, math.prod(shape), offset).reshape(shape)
            offset += arrays[name].nbytes
        self.action = arrays["action"]
        """f32[N, A] in [-1, 1], to the workers; everything else but `active` and `stop` comes from them."""
        self.row = arrays["row"]
        """f32[N, width]: the transitions of the last step, packed as in the replay buffer."""
        self.observation = arrays["observation"]
        """f32[N, O]: what the policy sees next."""
        self.ended = arrays["ended"]
        """bool[N]: an episode ended in the last step, of this total_reward and length, terminated or truncated."""
        self.total_reward = arrays["total_reward"]
        self.length = arrays["length"]
        self.terminated = arrays["terminated"]
        self.active = arrays["active"]
        """bool[runs]: the others are not stepped."""
        self.stop = arrays["stop"]
        """bool[1]: break off the evaluation."""

    def close(self) -> None:
        os.close(self.file_descriptor)
