"""What the processes that an environment forks must not hold on to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

KEPT: set[int] = set()
"""File descriptors of this process alone."""


@contextmanager
def kept_from_children(descriptor: int) -> Iterator[None]:
    """Give no process that is forked meanwhile this file descriptor.

    A pipe ends, and a lock is let go of, when the last process that has it is gone: whoever waits for this one would
    wait for those as well, which may outlive it.
    """
    close_in_children()
    KEPT.add(descriptor)
    try:
        yield
    finally:
        KEPT.discard(descriptor)


@lru_cache(maxsize=1)
def close_in_children() -> None:
    """From now on a child has an empty file in the place of each of KEPT, so that no other gets its number."""

    def forget() -> None:
        if not KEPT:
            return
        nothing = os.open(os.devnull, os.O_RDWR)
        for descriptor in KEPT:
            os.dup2(nothing, descriptor, inheritable=False)
        os.close(nothing)

    os.register_at_fork(after_in_child=forget)
