"""Turn signals into requests to a run, so that it ends or saves between two steps and never inside one."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from types import FrameType
from typing import IO

from saclab.training.requests import Requests

EXIT_STATUS: dict[int, int] = {number: 128 + number for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
"""The signals that stop a run, and the exit status of a command that stopped because of one."""
SECONDS_TO_OBEY = 8.0
"""A process that was asked to stop and saves nothing for so long is ended."""
POLL_SECONDS = 0.1
LAST_WORDS = (
    f"saclab: asked to stop, and {SECONDS_TO_OBEY:g} seconds later neither saving nor at the end (a compilation, a "
    "step that takes long, or reading what the run begins with): ended. Nothing that was saved is lost, "
    "and the same command goes on from there\n"
)
SHOW_CURSOR = b"\x1b[?25h"  # a live display has hidden it
LOG_END = 65536  # bytes
PR_SET_PDEATHSIG = 1  # of Linux's prctl.h


@contextmanager
def requests_from_signals(process_ends: bool = False) -> Iterator[Requests]:
    """Requests that SIGINT, SIGTERM and SIGHUP (save and stop) and SIGUSR1 (save and go on) fill in.

    A second signal changes nothing, so it is harmless during a save. A SIGHUP that is ignored, as `nohup` has it, stays
    ignored. Outside the main thread, where Python cannot handle signals, the requests stay as they are.

    Args:
        process_ends: a process that was asked to stop ends right after this. A signal that comes still later, while
            Python shuts down, must not change its exit status; and if it does not get to save, it is ended all the
            same, within `SECONDS_TO_OBEY`: what it would have saved, the next one computes again.
    """
    requests = Requests()

    def stop(number: int, frame: FrameType | None) -> None:
        requests.stop = requests.stop or number

    def save(number: int, frame: FrameType | None) -> None:
        requests.save = True

    if threading.current_thread() is not threading.main_thread():
        yield requests
        return
    handlers: dict[int, Callable[[int, FrameType | None], None]] = {**dict.fromkeys(EXIT_STATUS, stop)}
    handlers[signal.SIGUSR1] = save
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        del handlers[signal.SIGHUP]
    with ExitStack() as stack:
        if process_ends:
            stack.enter_context(obeyed_in_time(requests))
        previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        try:
            yield requests
        finally:
            for number, handler in previous.items():
                signal.signal(number, signal.SIG_IGN if process_ends and requests.stop else handler)


@contextmanager
def obeyed_in_time(requests: Requests) -> Iterator[None]:
    """End this process if it was asked to stop and does not get there.

    Python handles a signal in the main thread, between two of its instructions: not while XLA compiles, nor in the
    middle of a step. But the number of each signal is also written to a file descriptor at once, and another thread
    reads it there. Only code that never lets go of the interpreter's lock can hold that up.
    """
    keep_from_children()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    previous = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=end_unless_obeyed, args=(reading, requests), daemon=True, name="stop").start()
    try:
        yield
    finally:
        if not requests.stop:  # otherwise what is left to do, such as closing environments, must not take long either
            signal.set_wakeup_fd(previous)
            os.close(writing)


@lru_cache(maxsize=1)
def keep_from_children() -> None:
    """Signals to processes that an environment forks are none to this one."""

    def forget() -> None:
        with suppress(ValueError):  # where only another thread than the main one could
            signal.set_wakeup_fd(-1)

    os.register_at_fork(after_in_child=forget)


def end_unless_obeyed(descriptor: int, requests: Requests) -> None:
    """Wait for a signal to stop, then for the end of this process as long as something is being saved."""
    number = 0
    while number not in EXIT_STATUS:
        if not (content := os.read(descriptor, 1)):
            os.close(descriptor)
            return
        number = content[0]
    waited = 0.0  # counted, not read off a clock: a process that was suspended has not had this time
    while waited < SECONDS_TO_OBEY:
        time.sleep(POLL_SECONDS)
        waited = 0.0 if requests.saving else waited + POLL_SECONDS
    with suppress(OSError):
        if sys.stdout is not None and sys.stdout.isatty():
            os.write(1, SHOW_CURSOR)
        os.write(2, LAST_WORDS.encode())
    os._exit(EXIT_STATUS[number])


def die_with(parent: int) -> None:
    """Have this process killed at the moment in which the process that started it dies.

    On Linux; other systems leave it alive until it next has something to say to that process.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it was dead before this was asked for
        sys.exit(f"the process that started this one, {parent}, is gone")


def end_of(log: IO[str]) -> str:
    """The last lines of a log: that of a process whose environment prints at every step is long."""
    log.seek(max(0, log.seek(0, os.SEEK_END) - LOG_END))
    return log.read()


def how_it_ended(code: int, errors: str) -> str:
    """The end of a process in words, with its last ones.

    Args:
        code: its exit status, below 0 for a signal.
        errors: what it has written to its standard error.
    """
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
    last_words = [line.strip() for line in errors.splitlines() if line.strip()][-1:]
    return ": ".join([how, *last_words])


def end_at_once_on_ctrl_c() -> None:
    """Let Ctrl-C end this process, which has nothing to save; a KeyboardInterrupt can be lost in JAX's callbacks."""

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, b"saclab: interrupted\n")
        os._exit(EXIT_STATUS[signal.SIGINT])

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, end)
