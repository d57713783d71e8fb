"""Commands one after the other in one process, for tests that do not need a process each."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest


class Told(NamedTuple):
    status: int
    output: str
    errors: str


@contextmanager
def one_process(*how: str) -> Iterator[tuple[bool, Callable[..., Told]]]:
    """Whether permissions bind the process, and what runs a command in it, in a folder."""
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("one_process.py")), *how],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None

    def run(*arguments: str | Path, folder: str | Path = "/") -> Told:
        print(json.dumps([str(folder), [str(word) for word in arguments]]), file=process.stdin, flush=True)
        return Told(**json.loads(process.stdout.readline()))

    yield json.loads(process.stdout.readline()), run
    process.communicate()
    assert process.returncode == 0


@pytest.fixture(scope="module")
def saclab_again() -> Iterator[Callable[..., Told]]:
    """Run a command in a process that has run others."""
    with one_process() as (_, run):
        yield run


@pytest.fixture(scope="module")
def saclab_confined() -> Iterator[Callable[..., Told]]:
    """The same in a process that permissions bind, whoever runs the tests."""
    with one_process("confined") as (bound, run):
        if not bound:
            pytest.skip("this process may read everything, and cannot give up the right to")
        yield run
