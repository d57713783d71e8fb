"""A worker's process, as every launcher starts it. Imports nothing slow: the processes of a cluster load it too."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from saclab.signals import end_of


class WorkerProcess:
    """A process that trains one task, out of reach of the terminal's Ctrl-C: its launcher tells it when to stop."""

    def __init__(
        self,
        task: Mapping[str, Any],
        environment: Mapping[str, str],
        directory: str = ".",
        dies_with_launcher: bool = False,
    ) -> None:
        """Start it.

        Args:
            task: what `Task.to_dict` gives.
            environment: the variables in which it differs from this process.
            directory: where it starts, if there is such a folder: packages of environments are found there.
            dies_with_launcher: kill it with this process; otherwise it then saves and stops.
        """
        log = Path(task["runs"][0]["folder"]) / "worker.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        self.log = log.open("w+", errors="replace")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "saclab.grid.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            cwd=directory if os.path.isdir(directory) else None,
            env=os.environ | dict(environment),
            start_new_session=True,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with suppress(BrokenPipeError):  # it is dead already: `ended` will say how
            launcher = os.getpid() if dies_with_launcher else None
            self.process.stdin.write(json.dumps({**task, "launcher": launcher}).encode())
            self.process.stdin.close()
        self.output: IO[bytes] = self.process.stdout
        self.silent = False
        """Whether it has closed its output."""
        self.unread = b""

    def read(self) -> list[dict[str, Any]]:
        """Wait until it says something, or has closed its output; its messages."""
        content = os.read(self.output.fileno(), 65536)
        self.silent = not content
        *lines, self.unread = (self.unread + content).split(b"\n")
        return [json.loads(line) for line in lines]

    def ended(self) -> tuple[int, str]:
        """Exit status, and the end of what it has written to its standard error, once it is silent."""
        code = self.process.wait()
        self.output.close()
        with self.log:
            return code, end_of(self.log)

    def poll(self, seconds: float) -> dict[str, Any]:
        """All that a launcher on another machine asks for: the messages of the next seconds, and the end if it comes.

        Its `code` and `errors` are those of `ended`, or None while the process goes on.
        """
        messages: list[dict[str, Any]] = []
        deadline = time.monotonic() + seconds
        while not self.silent and (left := deadline - time.monotonic()) > 0:
            if select.select([self.output], [], [], left)[0]:
                messages += self.read()
        code, errors = self.ended() if self.silent else (None, None)
        return {"messages": messages, "code": code, "errors": errors}

    def stop(self) -> None:
        """Tell it to save and stop; it goes on until it is silent."""
        self.process.send_signal(signal.SIGTERM)

    def finish(self) -> None:
        """Tell it to save and stop, and wait until it has."""
        self.stop()
        while not self.silent:
            self.read()
        self.process.wait()
