"""Processes that an environment forks hold nothing of the one that forked them, and may outlive it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from saclab.training.lock import locked

FORKS = """
import os, signal, sys, time
from pathlib import Path
from saclab.environments.foreign import prints_apart
from saclab.training.lock import locked
with locked(Path(sys.argv[1])), prints_apart() as answers:
    child = os.fork()
    if child == 0:
        sys.stdin.close(); os.close(0); os.close(1)
        time.sleep(60)
        os._exit(0)
    os.write(answers, f"{child}\\n".encode())
    time.sleep(0.2)
    os._exit(1)
"""


@contextmanager
def orphan(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A dead process whose child is still there."""
    process = subprocess.Popen([sys.executable, "-c", FORKS, folder], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    try:
        assert process.wait(60) == 1
        os.kill(child, 0)
        yield process
    finally:
        os.kill(child, signal.SIGKILL)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system forks no processes")
def test_an_orphan_keeps_neither_the_run_folder_nor_the_pipe(tmp_path):
    with orphan(tmp_path) as process:
        with locked(tmp_path):
            pass
        assert select.select([process.stdout], [], [], 10)[0], "the pipe is at its end"
        assert process.stdout.read() == b""
