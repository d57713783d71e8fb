"""One run in a process of its own: the configuration comes on standard input, events go out as lines of JSON."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from saclab.config import Config
from saclab.errors import TrainingFailed, UserError


def main() -> int:
    """Train the run; exit status 0 if it finished or was stopped on request, 2 for a user's error, 1 for any other."""
    task = json.load(sys.stdin)
    if task["cores"]:
        os.sched_setaffinity(0, task["cores"])  # before JAX starts its threads, which inherit it
    from saclab.signals import requests_from_signals
    from saclab.training.events import Evaluated, Finished, Interrupted, Progress, Started, Warned
    from saclab.training.loop import train
    from saclab.training.requests import Requests

    def tell(requests: Requests, **message: object) -> None:
        try:
            print(json.dumps(message), flush=True)
        except BrokenPipeError:  # the launcher is gone: nobody would look after this run
            requests.stop = requests.stop or 1

    with requests_from_signals(process_ends=True) as requests:
        try:
            config = Config.from_dict(task["config"])
            for event in train(config, Path(task["folder"]), requests, task["checkpoint_minutes"]):
                match event:
                    case Started(notes=(_ratio, *notes)):
                        for note in notes:
                            tell(requests, event="warned", message=note)
                    case Warned(message=message):
                        tell(requests, event="warned", message=message)
                    case Progress():
                        tell(requests, event="progress", **event._asdict())
                    case Evaluated():
                        mean, updates = float(event.total_rewards.mean()), event.updates
                        tell(requests, event="evaluated", mean_return=mean, updates=updates)
                    case Finished():
                        tell(requests, event="finished", reason=event.reason)
                    case Interrupted():
                        tell(requests, event="interrupted")
        except (UserError, TrainingFailed) as error:
            tell(requests, event="failed", message=str(error))
            return 2 if isinstance(error, UserError) else 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
