"""Call an environment's code, which is anybody's: it may raise anything, change the process, or never return."""

from __future__ import annotations

import contextvars
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from saclab.children import kept_from_children
from saclab.environments.watch import Watch
from saclab.errors import RunBroken, in_words, traceback_of

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


class Calls:
    """Calls into the code of one environment.

    It runs in a context of its own: what it tells NumPy of floating-point errors (`np.seterr`) holds for itself alone.
    """

    def __init__(self, name: str) -> None:
        """`name` is the environment's id."""
        self.name = name
        self.context = contextvars.copy_context()
        self.watch = Watch(f"environment {name}")

    def __call__(self, what: str, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Any:
        """What `function` gives.

        Args:
            what: of the environment is called, such as "step".
            function: what does it.
            *arguments: of the function.
            **options: of the function, by name.

        Raises:
            RunBroken: whatever it raises, with the traceback.
        """
        watch = self.watch
        watch.waiting_for = what
        try:
            return self.context.run(function, *arguments, **options)
        except BaseException as error:
            if meant_for_saclab(error):
                raise
            raise self.raised(what, error) from error
        finally:
            watch.waiting_for = ""
            watch.count += 1

    def run(self, what: str, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Any:
        """The same; what it raises is raised."""
        try:
            return self(what, function, *arguments, **options)
        except RunBroken as broken:
            error = broken.__cause__ or broken
        raise error

    def raised(self, what: str, error: BaseException) -> RunBroken:
        """What a run is told of an error in its environment's own code."""
        message = f"environment {self.name} raised an error in {what}: {in_words(error)}"
        return RunBroken(message, traceback=traceback_of(error))


def meant_for_saclab(error: BaseException) -> bool:
    """Whether an error that came up in an environment's code is Ctrl-C; where saclab handles that, it is its own."""
    return isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is signal.default_int_handler


@contextmanager
def prints_apart() -> Iterator[int]:
    """A descriptor of what was standard output, which is standard error meanwhile: environments may print anything."""
    sys.stdout.flush()
    own = os.dup(1)
    os.dup2(2, 1)
    try:
        with kept_from_children(own):
            yield own
    finally:
        sys.stdout.flush()
        os.dup2(own, 1)
        os.close(own)


@contextmanager
def signals_kept() -> Iterator[None]:
    """Put back the signal handlers that an environment replaces: a run must hear when it is told to stop."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None and signal.getsignal(number) != handler:
                signal.signal(number, handler)
