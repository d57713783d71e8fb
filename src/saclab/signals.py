"""Turn signals into requests to a run, so that it ends or saves between two steps and never inside one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from saclab.training.requests import Requests

EXIT_STATUS: dict[int, int] = {signal.SIGINT: 130, signal.SIGTERM: 143}
"""Exit statuses of a command that saved and stopped because of a signal."""


@contextmanager
def requests_from_signals(process_ends: bool = False) -> Iterator[Requests]:
    """Requests that SIGINT and SIGTERM (save and stop) and SIGUSR1 (save and go on) fill in.

    A second signal changes nothing, so it is harmless during a save. Outside the main thread, where Python cannot
    handle signals, the requests stay as they are.

    Args:
        process_ends: a process that was asked to stop ends right after this; a signal that comes still later, while
            Python shuts down, must not change its exit status.
    """
    requests = Requests()

    def stop(number: int, frame: FrameType | None) -> None:
        requests.stop = requests.stop or number

    def save(number: int, frame: FrameType | None) -> None:
        requests.save = True

    if threading.current_thread() is not threading.main_thread():
        yield requests
        return
    handlers = {signal.SIGINT: stop, signal.SIGTERM: stop, signal.SIGUSR1: save}
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield requests
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_IGN if process_ends and requests.stop else handler)


def how_it_ended(code: int, errors: str) -> str:
    """The end of a process in words, with its last ones.

    Args:
        code: its exit status, below 0 for a signal.
        errors: what it has written to its standard error.
    """
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
    last_words = [line.strip() for line in errors.splitlines() if line.strip()][-1:]
    return ": ".join([how, *last_words])
