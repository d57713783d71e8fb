"""From a run's events to trackers: what is sent, and what becomes of a tracker that breaks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Protocol

from saclab.errors import in_words
from saclab.training import events


class Tracker(Protocol):
    """What takes a run's numbers."""

    def check(self) -> None:
        """Whether it can be used at all; raises UserError if not."""

    def open(self, started: events.Started) -> None:
        """Begin with a run, or go on with a resumed one."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take numbers by name, of an environment step."""

    def close(self, finished: bool) -> None:
        """Nothing comes any more: the run is at its end, or was stopped and may go on."""


def scalars(event: events.Event) -> tuple[dict[str, float], int] | None:
    """The numbers of an event worth a curve, and the environment step; None if it has none."""
    match event:
        case events.UpdatesLogged():
            return {f"losses/{name}": value for name, value in event.means.items()}, event.steps
        case events.EpisodeEnded():
            values = {"return": event.total_reward, "running_average": event.running_average, "length": event.length}
            return {f"training/{name}": float(value) for name, value in values.items()}, event.steps
        case events.Evaluated():
            returns = event.total_rewards
            values = {"mean_return": returns.mean(), "minimum": returns.min(), "maximum": returns.max()}
            return {f"evaluation/{name}": float(value) for name, value in values.items()}, event.steps
    return None


@dataclass
class Feed:
    """What a tracker gets of a run. One that breaks gets nothing more: the run is worth more than its curves."""

    tracker: Tracker
    going: bool = False
    """Whether it has been opened and takes numbers."""

    @property
    def kind(self) -> str:
        return type(self.tracker).__name__

    def take(self, event: events.Event) -> str:
        """Pass an event on; what went wrong, or nothing."""
        match event:
            case events.Started():
                return self._open(event)
            case events.Finished():
                return self.close(finished=True)
            case events.Interrupted() | events.Failed():
                return self.close(finished=False)
        if not self.going or (found := scalars(event)) is None:
            return ""
        try:
            self.tracker.log(*found)
        except Exception as error:
            self.going = False
            return f"{self.kind} gets nothing more, and the run goes on: {in_words(error)}"
        return ""

    def _open(self, started: events.Started) -> str:
        try:
            self.tracker.open(started)
        except Exception as error:
            return f"{self.kind} cannot be used, and the run goes on without it: {in_words(error)}"
        self.going = True
        return ""

    def close(self, finished: bool) -> str:
        """Nothing comes any more; what went wrong, or nothing. Once is enough."""
        if not self.going:
            return ""
        self.going = False
        try:
            self.tracker.close(finished)
        except Exception as error:
            return f"{self.kind} did not get the run's last numbers: {in_words(error)}"
        return ""


def track_runs(
    stream: Iterable[tuple[int, events.Event]], trackers: Sequence[Sequence[Tracker]]
) -> Iterator[tuple[int, events.Event]]:
    """Pass on the events of runs, each with the place of its run, and send their numbers to the trackers of each.

    What goes wrong is warned of. A service that has failed one run gets nothing more of the others either: they are
    stepped together, and would wait for it one after the other.
    """
    feeds = [[Feed(tracker) for tracker in of_run] for of_run in trackers]
    failed = set[str]()
    try:
        for run, event in stream:
            for feed in feeds[run]:
                if feed.kind not in failed and (told := feed.take(event)):
                    failed.add(feed.kind)
                    yield run, events.Warned(told)
            yield run, event
    finally:
        for feed in chain.from_iterable(feeds):  # of runs that broke, or that nobody goes on with
            if feed.kind not in failed:
                feed.close(finished=False)


def track(stream: Iterable[events.Event], trackers: Sequence[Tracker]) -> Iterator[events.Event]:
    """Pass on the events of one run, as `track_runs` does."""
    for _, event in track_runs(((0, event) for event in stream), [trackers]):
        yield event
