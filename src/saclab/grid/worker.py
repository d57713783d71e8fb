"""The runs of one task in a process of their own: a run alone, or a run group.

The task comes as JSON on standard input; each event goes out as a line of JSON that names the run by its place.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saclab.config import Config
from saclab.environments.foreign import prints_apart
from saclab.environments.watch import log
from saclab.errors import RunBroken
from saclab.exits import end_after
from saclab.signals import die_with
from saclab.trackers.asked import Tracking, trackers_of
from saclab.training.lock import InUse, wait_until_free

if TYPE_CHECKING:
    from saclab.training.events import Event
    from saclab.training.requests import Requests


def main() -> int:
    """Train the runs; exit status 0 if they finished or were stopped on request, else that of `saclab train`."""
    task = json.load(sys.stdin)
    if task["cores"]:
        os.sched_setaffinity(0, task["cores"])  # before JAX starts its threads, which inherit it
    if task["launcher"]:
        die_with(task["launcher"])
    for run in task["runs"]:
        wait_until_free(Path(run["folder"]), task["patience"])
    from saclab.signals import requests_from_signals
    from saclab.training.run_folder import is_finished

    with requests_from_signals(process_ends=True) as requests, prints_apart() as answers:

        def tell(run: int, **message: object) -> None:
            try:
                write_line(answers, {"run": run, **message})
            except BrokenPipeError:  # the launcher is gone: nobody would look after these runs
                requests.stop = requests.stop or 1

        log.addHandler(logging.StreamHandler())
        log.addHandler(Teller(tell))
        going_on = {place for place, run in enumerate(task["runs"]) if not is_finished(Path(run["folder"]))}
        try:
            for run, event in events(task, requests):
                for message in messages(event):
                    tell(run, **message)
                    if message["event"] in ("finished", "failed"):
                        going_on.discard(run)
        except Exception as error:
            status, line = end_after(error)
            for run in going_on:
                what = "in_use" if isinstance(error, InUse) else "failed"
                tell(run, event=what, message=line, broken=isinstance(error, RunBroken))
            return status
    return 0


LINE = threading.Lock()  # a thread that watches environments speaks too


def write_line(answers: int, message: Mapping[str, object]) -> None:
    content = memoryview(json.dumps(message).encode() + b"\n")
    with LINE:
        while content:
            content = content[os.write(answers, content) :]


class Teller(logging.Handler):
    """Tells the launcher what is logged of environments."""

    def __init__(self, tell: Callable[..., None]) -> None:
        super().__init__()
        self.tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        stalled = getattr(record, "stalled", False)
        self.tell(0, event="stalled" if stalled else "warned", message=record.getMessage())


def events(task: dict[str, Any], requests: Requests) -> Iterator[tuple[int, Event]]:
    """The events of the task's runs, each with the place of its run; trackers get their numbers."""
    from saclab.trackers.feed import track_runs

    runs = [(Config.from_dict(run["config"]), Path(run["folder"])) for run in task["runs"]]
    trackers = trackers_of(Tracking(**task["tracking"]), runs)
    return track_runs(trained(task, runs, requests), trackers)


def trained(
    task: dict[str, Any], runs: Sequence[tuple[Config, Path]], requests: Requests
) -> Iterator[tuple[int, Event]]:
    """The events of runs while they are trained."""
    if task["slots"]:
        from saclab.batch.loop import train_batch

        configs, folders = [config for config, _ in runs], [folder for _, folder in runs]
        yield from train_batch(
            configs, folders, requests, task["checkpoint_minutes"], task["slots"], task["workers"]
        )  # fmt: skip
    else:
        from saclab.training.loop import train

        for event in train(*runs[0], requests, task["checkpoint_minutes"]):
            yield 0, event


def messages(event: Event) -> Iterator[dict[str, object]]:
    """What the launcher is told of an event."""
    from saclab.training.events import Evaluated, Failed, Finished, Interrupted, Progress, Started, Warned

    match event:
        case Started(notes=(_ratio, *notes)):
            for note in notes:
                yield {"event": "warned", "message": note}
        case Warned(message=message):
            yield {"event": "warned", "message": message}
        case Progress():
            yield {"event": "progress", **event._asdict()}
        case Evaluated():
            mean_return = float(event.total_rewards.mean())
            yield {"event": "evaluated", "evaluation": event.evaluation, "mean_return": mean_return}
        case Finished():
            yield {"event": "finished", "reason": event.reason}
        case Failed(message=message):
            yield {"event": "failed", "message": message, "broken": True}
        case Interrupted():
            yield {"event": "interrupted"}


if __name__ == "__main__":
    sys.exit(main())
