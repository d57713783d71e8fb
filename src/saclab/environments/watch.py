"""Say so when a call takes very long: it may never return, and nobody would know what is waited for."""

from __future__ import annotations

import logging
import threading
import time
import weakref

SECONDS = 60.0
"""A call that takes longer is told of."""
LOOK_SECONDS = 5.0
log = logging.getLogger("saclab.environments")
"""What a user should know of environments and no event tells; on standard error, unless it is sent elsewhere."""


class Watch:
    """What is waited for, one thing at a time; a thread of this process looks at it now and then.

    Who waits sets `waiting_for` before and clears it after, and counts: no clock is asked in a step.
    """

    def __init__(self, who: str) -> None:
        """Watch whatever `who` will be asked for."""
        self.who, self.waiting_for, self.count = who, "", 0
        self.seen, self.since, self.told = -1, 0.0, False
        with WATCHES_LOCK:
            WATCHES.add(self)
            if not any(thread.name == THREAD for thread in threading.enumerate()):
                threading.Thread(target=look_now_and_then, name=THREAD, daemon=True).start()

    def look(self, now: float) -> None:
        """Tell once of something that has been waited for since `SECONDS` ago or more."""
        count, waiting_for = self.count, self.waiting_for
        if not waiting_for or count != self.seen:
            self.seen, self.since, self.told = count if waiting_for else -1, now, False
        elif not self.told and now - self.since >= SECONDS:
            self.told = True
            log.warning(
                f"{self.who}: {waiting_for} has taken {now - self.since:.0f} seconds and is not done: the run waits "
                "for it; if it hangs, stop the run and mend the environment",
                extra={"stalled": True},
            )


THREAD = "saclab watches environments"
WATCHES: weakref.WeakSet[Watch] = weakref.WeakSet()
WATCHES_LOCK = threading.Lock()


def look_now_and_then() -> None:
    while True:
        time.sleep(LOOK_SECONDS)
        with WATCHES_LOCK:
            watches = list(WATCHES)
        for watch in watches:
            watch.look(time.monotonic())
        del watches
