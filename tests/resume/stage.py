"""A run with two checkpoints, ready to be damaged; and the tools to sign what has been changed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import safetensors.numpy

from saclab.training import loop
from saclab.training.checkpoint import newest_first
from saclab.training.events import Started

from .helpers import finish, small_config, stop_at

FIRST, SECOND = 100, 130


class Stage:
    """A run with checkpoints at FIRST and SECOND, copied for each test."""

    def __init__(self, folder: Path) -> None:
        self.config = small_config("Pendulum-v1", environments=2, max_steps=150)
        self.saved, self.straight = folder / "saved", folder / "straight"
        finish(self.config, self.straight)
        stop_at(FIRST, self.config, self.saved)
        stop_at(SECOND, self.config, self.saved)

    def continue_from(self, folder: Path) -> Started:
        """What a session tells as it begins; no step is made."""
        events = loop.train(self.config, folder)
        started = next(events)
        events.close()
        assert isinstance(started, Started)
        return started


def newest(folder: Path) -> Path:
    return newest_first(folder / "checkpoints")[0]


def older(folder: Path) -> Path:
    return newest_first(folder / "checkpoints")[1]


def sign(path: Path, manifest: object) -> None:
    """Write a manifest with the checksum that belongs to it."""
    content = manifest if isinstance(manifest, bytes) else json.dumps(manifest).encode()
    (path / "manifest.json").write_bytes(content)
    (path / "manifest.sha256").write_text(hashlib.sha256(content).hexdigest() + "\n")


def put(path: Path, name: str, content: bytes) -> None:
    """Put a file into a checkpoint as if saclab had written it: with its size and checksum."""
    (path / name).write_bytes(content)
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["files"].setdefault(name, {})
    manifest["files"][name] |= {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    sign(path, manifest)


def change_arrays(path: Path, name: str, **changes: np.ndarray | None) -> None:
    arrays = safetensors.numpy.load((path / name).read_bytes()) | changes
    put(path, name, safetensors.numpy.save({key: array for key, array in arrays.items() if array is not None}))
