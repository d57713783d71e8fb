"""Save a checkpoint in a process that dies at its n-th system call, for every n; tell what can be loaded then.

A program of its own, as it forks; it prints one line of JSON per death. Each write of a file is made in two halves, so
that files are cut short too.
"""

from __future__ import annotations

import io
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from saclab.environments.vector import Transitions
from saclab.replay import ReplayBuffer, RowLayout
from saclab.training import checkpoint as checkpoints
from saclab.training.checkpoint import Checkpoint, save_checkpoint
from saclab.training.common_checkpoint import load_newest_checkpoint
from saclab.training.manifest import Moment

LAYOUT, CAPACITY = RowLayout(2, 1), 40
CALLS = ("open", "mkdir", "rename", "replace", "link", "unlink", "rmdir", "fsync", "close", "scandir", "stat")
DEAD = 9


def buffer_at(step: int) -> ReplayBuffer:
    """As after `step` transitions, whose numbers tell which they are."""
    replay = ReplayBuffer(CAPACITY, LAYOUT)
    for number in range(step):
        column = np.full((1, 1), number, np.float32)
        replay.add(Transitions(column.repeat(2, 1), column, column, column.repeat(2, 1), np.array([False])))
    return replay


def save(folder: Path, step: int) -> None:
    learner = {".actor": np.full(3, step, np.float32)}
    save_checkpoint(folder, Moment(step), Checkpoint({"learner": learner}, {"step": step}), buffer_at(step))


def loaded_step(folder: Path) -> int | None:
    """The step of the checkpoint that a restart would continue from, checked to be whole; None if there is none."""
    replay = ReplayBuffer(CAPACITY, LAYOUT)
    warnings: list[str] = []
    loaded = load_newest_checkpoint(folder, replay, warnings.append)
    assert warnings == [], warnings
    if loaded is None:
        return None
    step = int(loaded.state["step"])
    expected = buffer_at(step)
    assert replay.added == expected.added
    np.testing.assert_array_equal(replay.rows[: replay.size], expected.rows[: expected.size])
    np.testing.assert_array_equal(loaded.groups["learner"][".actor"], np.full(3, step, np.float32))
    return step


class Calls:
    """Counts the calls that reach the system, and ends the process before the one with the fatal number."""

    def __init__(self, fatal: int, pipe: int) -> None:
        self.fatal, self.pipe, self.number = fatal, pipe, 0

    def count(self, name: str) -> None:
        if self.number == self.fatal:
            os.write(self.pipe, name.encode())
            os._exit(DEAD)
        self.number += 1

    def counted(self, name: str, function: Callable) -> Callable:
        def call(*arguments: object, **options: object) -> object:
            self.count(name)
            return function(*arguments, **options)

        return call

    def install(self) -> None:
        for name in CALLS:
            setattr(os, name, self.counted(name, getattr(os, name)))
        real_open, calls = io.open, self

        def open_counted(self: Path, *arguments: object, **options: object) -> object:
            calls.count("open a file")
            file = real_open(self, *arguments, **options)
            return Halves(file, calls) if file.writable() else file

        Path.open = open_counted


class Halves:
    """A file that is written in two halves, each of which reaches the system at once."""

    def __init__(self, file: io.BufferedWriter, calls: Calls) -> None:
        self.file, self.calls = file, calls

    def write(self, content: bytes) -> None:
        for half in (content[: len(content) // 2], content[len(content) // 2 :]):
            self.calls.count("write")
            self.file.write(half)
            self.file.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self.file, name)

    def __enter__(self) -> Halves:
        return self

    def __exit__(self, *error: object) -> None:
        self.calls.count("close a file")
        self.file.close()


def die_at(fatal: int, folder: Path, step: int) -> str | None:
    """Save in a process that dies at the call with that number; the call's name, None if the save was done before."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        Calls(fatal, writer).install()
        save(folder, step)
        os._exit(0)
    os.close(writer)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with os.fdopen(reader) as pipe:
        name = pipe.read()
    assert status in (0, DEAD), status
    return name if status == DEAD else None


def main(root: Path) -> None:
    checkpoints.SEGMENT_ROWS = 8
    for before in ((), (50, 55)):  # the first save, and one that links from another and removes it
        fatal, name = 0, ""
        while name is not None:
            folder = root / f"{len(before)}-{fatal}"
            for step in before:
                save(folder, step)
            name = die_at(fatal, folder, 60)
            loaded = loaded_step(folder)
            save(folder, 63)  # what was left is in nobody's way
            print(json.dumps({
                "old": before[-1] if before else None, "died_at": name, "loaded": loaded,
                "then": loaded_step(folder), "left": sorted(path.name for path in folder.iterdir()),
            }))  # fmt: skip
            fatal += 1


if __name__ == "__main__":
    in_memory = Path("/dev/shm")  # where fsync costs nothing
    with tempfile.TemporaryDirectory(dir=in_memory if os.access(in_memory, os.W_OK) else None) as root:
        main(Path(root))
