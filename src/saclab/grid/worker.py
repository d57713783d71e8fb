"""The runs of one task in a process of their own: a run alone, or a run group.

The task comes as JSON on standard input; each event goes out as a line of JSON that names the run by its place.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saclab.config import Config
from saclab.exits import end_after
from saclab.signals import die_with
from saclab.training.lock import wait_until_free

if TYPE_CHECKING:
    from saclab.training.events import Event
    from saclab.training.requests import Requests


def main() -> int:
    """Train the runs; exit status 0 if they finished or were stopped on request, else that of `saclab train`."""
    task, answers = json.load(sys.stdin), os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what an environment prints must not end up among the answers
    if task["cores"]:
        os.sched_setaffinity(0, task["cores"])  # before JAX starts its threads, which inherit it
    if task["launcher"]:
        die_with(task["launcher"])
    for run in task["runs"]:
        wait_until_free(Path(run["folder"]), task["patience"])
    from saclab.signals import requests_from_signals

    with requests_from_signals(process_ends=True) as requests:

        def tell(run: int, **message: object) -> None:
            try:
                print(json.dumps({"run": run, **message}), file=answers, flush=True)
            except BrokenPipeError:  # the launcher is gone: nobody would look after these runs
                requests.stop = requests.stop or 1

        going_on = set(range(len(task["runs"])))
        try:
            for run, event in events(task, requests):
                for message in messages(event):
                    tell(run, **message)
                    if message["event"] in ("finished", "failed"):
                        going_on.discard(run)
        except Exception as error:
            status, line = end_after(error)
            for run in going_on:
                tell(run, event="failed", message=line)
            return status
    return 0


def events(task: dict[str, Any], requests: Requests) -> Iterator[tuple[int, Event]]:
    """The events of the task's runs, each with the place of its run."""
    configs = [Config.from_dict(run["config"]) for run in task["runs"]]
    folders = [Path(run["folder"]) for run in task["runs"]]
    if task["slots"]:
        from saclab.batch.loop import train_batch

        yield from train_batch(
            configs, folders, requests, task["checkpoint_minutes"], task["slots"], task["workers"]
        )  # fmt: skip
    else:
        from saclab.training.loop import train

        for event in train(configs[0], folders[0], requests, task["checkpoint_minutes"]):
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
            yield {"event": "evaluated", "mean_return": float(event.total_rewards.mean()), "updates": event.updates}
        case Finished():
            yield {"event": "finished", "reason": event.reason}
        case Failed(message=message):
            yield {"event": "failed", "message": message}
        case Interrupted():
            yield {"event": "interrupted"}


if __name__ == "__main__":
    sys.exit(main())
