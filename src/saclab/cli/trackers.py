"""Experiment trackers: they read a run's events and nothing else. Both are optional extras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from saclab.config import Config
from saclab.extras import required
from saclab.training import events

Log = Callable[[Mapping[str, float], int], None]
"""(name -> value, environment step) -> None."""


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


def track(
    stream: Iterable[events.Event], start: Callable[[events.Started], tuple[Log, Callable[[], None]]]
) -> Iterator[events.Event]:
    """Pass a run's events on, and send their numbers to a tracker that `start` opens: its log and its close."""
    log: Log | None = None
    close: Callable[[], None] | None = None
    try:
        for event in stream:
            if isinstance(event, events.Started):
                log, close = start(event)
            elif log is not None and (found := scalars(event)) is not None:
                log(*found)
            yield event
    finally:
        if close is not None:
            close()


def tensorboard(stream: Iterable[events.Event]) -> Iterator[events.Event]:
    """Write event files into the run folder's `tensorboard`; a resumed run takes back what it had logged too far.

    Raises:
        UserError: if the extra is not installed.
    """
    writer_type = required("tensorboardX", "tensorboard", "--tensorboard").SummaryWriter

    def start(event: events.Started) -> tuple[Log, Callable[[], None]]:
        writer = writer_type(str(event.run / "tensorboard"), purge_step=event.resumed_at_step + 1)

        def log(values: Mapping[str, float], step: int) -> None:
            for name, value in values.items():
                writer.add_scalar(name, value, step)

        return log, writer.close

    return track(stream, start)


def wandb(stream: Iterable[events.Event], project: str, config: Config, folder: Path) -> Iterator[events.Event]:
    """Send a run to Weights & Biases, under an id made of its folder, so that a resumed run goes on there.

    Raises:
        UserError: if the extra is not installed.
    """
    module = required("wandb", "wandb", "--wandb")

    def start(event: events.Started) -> tuple[Log, Callable[[], None]]:
        name = "-".join(folder.parts[-4:])
        folder.mkdir(parents=True, exist_ok=True)
        run = module.init(project=project, name=name, id=name, resume="allow", config=config.to_dict(), dir=str(folder))
        return (lambda values, step: run.log(dict(values), step=step)), run.finish

    return track(stream, start)
