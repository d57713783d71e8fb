"""saclab from Python: `saclab.train`, `saclab.events`, `saclab.resume`, `saclab.compare`."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from saclab.config import Config
from saclab.errors import UserError
from saclab.files import absolute, make_folder
from saclab.grid.launch import launch
from saclab.grid.plan import Cell, make_grid
from saclab.grid.resources import Resources, chosen_resources
from saclab.grid.tasks import RunStatus
from saclab.limits import require_minutes
from saclab.protocols import make_config
from saclab.report.runs import read_runs, two_versions
from saclab.signals import requests_from_signals
from saclab.trackers.asked import NOWHERE, Tracking
from saclab.training.events import Event
from saclab.training.requests import Requests
from saclab.training.run_folder import RunRecord, read_config, read_run, run_path
from saclab.variants import COMPARED

Show = Callable[[Iterable[Sequence[RunStatus]]], list[RunStatus]]
"""What consumes the stream of a grid's statuses and returns the last ones."""
TOLD_TO_STOP = "its worker was told to stop, not by this command; the same command goes on with it"
Q_BIAS_EPISODES = 2
"""Episodes for the Q bias in `reproduce`: the paper's hypothesis is that averaging lowers it."""


def train(
    environment: str,
    variant: str = "sac-auto",
    seed: int = 0,
    protocol: str = "standard",
    *,
    runs: Path | str = "runs",
    name: str | None = None,
    environment_arguments: Mapping[str, Any] | None = None,
    on_event: Callable[[Event], None] = lambda event: None,
    checkpoint_minutes: float = 10,
    **overrides: Any,
) -> RunRecord:
    """Train one run to its end, or go on with it where it stopped; Ctrl-C saves it and returns.

    Args:
        environment: Gymnasium id.
        variant: a key of `saclab.variants.VARIANTS`.
        seed: every random draw derives from it.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        runs: the folder that holds all runs.
        name: takes the variant's place in the run folder's path, for runs with other settings.
        environment_arguments: keyword arguments of the environment.
        on_event: called with each event of `saclab.training.events`.
        checkpoint_minutes: wall-clock time between checkpoints.
        **overrides: any setting of AlgorithmSettings or TrainingSettings.

    Returns:
        What the run folder holds; its `result` is None if the run was stopped before its end.

    Raises:
        UserError: for a name or value that cannot work, or a folder that holds a run with other settings.
    """
    config = make_config(environment, variant, protocol, seed, environment_arguments, overrides)
    return _train(config, run_path(Path(runs), config, name), on_event, checkpoint_minutes)


def events(
    environment: str,
    variant: str = "sac-auto",
    seed: int = 0,
    protocol: str = "standard",
    *,
    runs: Path | str = "runs",
    name: str | None = None,
    environment_arguments: Mapping[str, Any] | None = None,
    requests: Requests | None = None,
    checkpoint_minutes: float = 10,
    **overrides: Any,
) -> Generator[Event]:
    """Train one run as `train` does, event by event: what is done between two of them is up to the caller.

    A run goes on only while its events are taken. Who leaves the loop, or is thrown out by Ctrl-C, for which nothing is
    set up here, finds the run at its last checkpoint: the same call goes on from there, once the iterator is closed
    (`close()`) or forgotten. To stop and lose nothing, ask for it: `requests.stop = 1`, and take the events until there
    are none.

    Args:
        environment: Gymnasium id.
        variant: a key of `saclab.variants.VARIANTS`.
        seed: every random draw derives from it.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        runs: the folder that holds all runs.
        name: takes the variant's place in the run folder's path, for runs with other settings.
        environment_arguments: keyword arguments of the environment.
        requests: through which the run is asked to stop (`stop`) or to save (`save`); looked at after every step.
        checkpoint_minutes: wall-clock time between checkpoints.
        **overrides: any setting of AlgorithmSettings or TrainingSettings.

    Returns:
        An iterator of Started, then the others of `saclab.training.events`; of nothing if the run is finished.

    Raises:
        UserError: for a name or value that cannot work, or a folder that holds a run with other settings.
        TrainingFailed: if a number is not finite, the environment breaks, or nothing can be written.
    """
    from saclab.training.loop import train as training_events

    config = make_config(environment, variant, protocol, seed, environment_arguments, overrides)
    return training_events(config, run_path(absolute(Path(runs)), config, name), requests, checkpoint_minutes)


def resume(
    run: Path | str,
    on_event: Callable[[Event], None] = lambda event: None,
    checkpoint_minutes: float = 10,
    imports: Sequence[str] = (),
) -> RunRecord:
    """Go on with an unfinished run from its newest checkpoint.

    Args:
        run: the run folder.
        on_event: called with each event of `saclab.training.events`.
        checkpoint_minutes: wall-clock time between checkpoints.
        imports: packages that the run's environment may import.

    Raises:
        UserError: if `run` is not a run folder, or its environment would import a package not named.
    """
    from saclab.environments.wrappers import require_import_allowed

    config = read_config(Path(run))
    require_import_allowed(config.environment, config.training.wrappers, imports)
    return _train(config, Path(run), on_event, checkpoint_minutes)


def _train(config: Config, folder: Path, on_event: Callable[[Event], None], checkpoint_minutes: float) -> RunRecord:
    from saclab.training.loop import train as training_events

    folder = absolute(folder)
    with requests_from_signals() as requests:
        for event in training_events(config, folder, requests, checkpoint_minutes):
            on_event(event)
    return read_run(folder)


class Comparison(NamedTuple):
    runs: list[RunRecord]
    """The runs that have begun and can be read, finished or not."""
    failed: dict[Path, str]
    """Run folder -> what went wrong, or why it cannot be read; likewise the report's, if there could be none."""
    report: Path | None
    """The report's page; None if no run has anything to show, or there could be none."""
    interrupted: int = 0
    """The signal that stopped the grid, or 0."""


def compare(
    environments: Sequence[str],
    variants: Sequence[str] = COMPARED,
    seeds: int | Sequence[int] | None = None,
    protocol: str = "standard",
    *,
    workers: int | None = None, threads: int | None = None, batch: int | None = None,
    runs: Path | str = "runs",
    name: str | None = None,
    sweep: Mapping[str, Sequence[Any]] | None = None,
    report: Path | str | None = None,
    environment_arguments: Mapping[str, Any] | None = None,
    show: Show | None = None,
    tell: Callable[[str], None] = lambda text: None,
    checkpoint_minutes: float = 10,
    launcher: Literal["local", "ray"] = "local",
    ray_address: str | None = None,
    ray_cpus: float | None = None,
    ray_gpus: float = 0.0,
    tracking: Tracking = NOWHERE,
    **overrides: Any,
) -> Comparison:  # fmt: skip
    """Train every variant on every environment with every seed, in worker processes, then write the report.

    Args:
        environments: Gymnasium ids.
        variants: keys of `saclab.variants.VARIANTS`.
        seeds: how many (0, 1, …) or which; None for the protocol's own number.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        workers: runs at a time, or a run group's processes for environments; None for one per core, or Ray's room.
        threads: cores that XLA uses for each run, or for a run group; None for one, or for all.
        batch: runs of one structure that are trained as one run group; 0: each alone, None: 16 on an accelerator.
        runs: the folder that holds all runs: finished ones are skipped, unfinished ones resumed, other processes'
            waited for, and a failed one stops no other; on Ray, one that all machines share.
        name: takes the variant's place in the paths, for one variant with other settings: an arm of the report.
        sweep: setting of the algorithm -> values; each combination is an arm of the report.
        report: the report's folder; None for `runs`/report.
        environment_arguments: keyword arguments of every environment.
        show: consumes the stream of statuses and returns the last ones, such as `saclab.cli.display.show_grid`.
        tell: takes what the user should know before it starts, and at the end the report's summary.
        checkpoint_minutes: wall-clock time between checkpoints.
        launcher: "local" for processes on this machine, "ray" for a Ray cluster, which needs the extra `ray`.
        ray_address: where the cluster answers; None for RAY_ADDRESS, else the one on this machine, else a new one.
        ray_cpus: cores that Ray sets aside for each run; None for `threads`.
        ray_gpus: GPUs, or the part of one, that Ray sets aside for each run; 0 trains on cores.
        tracking: the trackers that the runs' numbers are sent to.
        **overrides: any setting of AlgorithmSettings or TrainingSettings, for every run.

    Raises:
        UserError: for a name or value that cannot work, or a missing extra; nothing has been started then.
    """
    resources = chosen_resources(workers, threads, batch, launcher, ray_address, ray_cpus, ray_gpus)
    cells = make_grid(environments, variants, protocol, seeds, runs, environment_arguments, overrides, name, sweep)
    resources.require_startable(cells)
    return _compare(cells, resources, report or Path(runs) / "report", show, tell, checkpoint_minutes, tracking)


def _compare(
    cells: Sequence[Cell],
    resources: Resources,
    report: Path | str,
    show: Show | None,
    tell: Callable[[str], None],
    checkpoint_minutes: float,
    tracking: Tracking = NOWHERE,
) -> Comparison:
    require_minutes(checkpoint_minutes)
    for reason in two_versions({cell.config.environment: None for cell in cells}):
        raise UserError(f"{reason}: compare them apart, each with a --report of its own")
    for cell in [cell for cell in cells if not cell.finished][:1]:
        tracking.usable(*cell)  # said before anything is started; and MLflow's experiment is made by one process
    report = absolute(report)
    make_folder(cells[0].folder.parents[3], "--runs")  # said once, and not by each run
    if note := resources.note(cells):
        tell(note)
    with requests_from_signals() as requests:
        stream = launch(cells, resources.pool(checkpoint_minutes, tracking), requests, resources.batch)
        statuses = (show or last)(reporting(stream, report, tell))
    return compared(statuses, report, requests.stop, tell)


def reporting(
    stream: Iterable[Sequence[RunStatus]], report: Path, tell: Callable[[str], None]
) -> Iterator[Sequence[RunStatus]]:
    """Pass a grid's statuses on; once nothing is left but runs that hang, write the report of the others."""
    hangs = False
    for statuses in stream:
        left = [status for status in statuses if status.status in ("running", "waiting")]
        before, hangs = hangs, bool(left) and all(status.stalled for status in left)
        if hangs and not before:
            told = f"nothing goes on but {len(left)} run(s) that hang; until they do or are stopped: report: "
            try:
                tell(f"{told}{write_page(read_begun(statuses)[0], report)}")
            except UserError as error:  # what goes on is worth more
                tell(f"{told}none ({error})")
        yield statuses


def read_begun(statuses: Sequence[RunStatus]) -> tuple[list[RunRecord], dict[Path, str]]:
    """The runs of a grid that have begun, and the reasons why some of their folders cannot be read."""
    folders = [status.cell.folder for status in statuses]
    return read_runs([folder for folder in folders if (folder / "config.json").exists()])


def write_page(runs: Sequence[RunRecord], report: Path, tell: Callable[[str], None] = lambda text: None) -> Path | None:
    """Write the report of runs, one process at a time, and tell its summary; None if there are none."""
    from saclab.report.report import write_report

    if not runs:
        return None
    return write_report([run.path for run in runs], report, tell=tell)


def compared(
    statuses: Sequence[RunStatus], report: Path, interrupted: int, tell: Callable[[str], None] = lambda text: None
) -> Comparison:
    """What came of a grid, with its report in a folder unless the grid was interrupted."""
    failed = {status.cell.folder: status.message for status in statuses if status.status == "failed"}
    runs, damaged = read_begun(statuses)
    if interrupted:
        return Comparison(runs, damaged | failed, None, interrupted)
    stopped = {status.cell.folder: TOLD_TO_STOP for status in statuses if status.status == "interrupted"}
    try:
        page, none = write_page(runs, report, tell), {}
    except UserError as error:  # the runs are there, and what is said of them is worth more
        page, none = None, {report: f"no report: {error}"}
    return Comparison(runs, damaged | failed | stopped | none, page)


def reproduce(
    environments: Sequence[str] = ("HalfCheetah-v4", "Humanoid-v4"),
    variants: Sequence[str] = COMPARED,
    seeds: int | Sequence[int] | None = None,
    updates: int | None = None,
    *,
    workers: int | None = None,
    batch: int | None = None,
    runs: Path | str = "runs",
    report: Path | str | None = None,
    show: Show | None = None,
    tell: Callable[[str], None] = print,
    checkpoint_minutes: float = 10,
) -> Comparison:
    """The paper's experiment: a comparison under its protocol, with a forecast of the hours before it starts.

    Args:
        environments: Gymnasium ids.
        variants: keys of `saclab.variants.VARIANTS`.
        seeds: how many (0, 1, …) or which; None for the protocol's own number.
        updates: fewer updates than the paper's; the report says that it is scaled down.
        workers: as in `compare`.
        batch: as in `compare`.
        runs: the folder that holds all runs.
        report: the report's folder; None for `runs`/report.
        show: as in `compare`.
        tell: takes the forecast, and at the end the report's summary.
        checkpoint_minutes: wall-clock time between checkpoints.

    Raises:
        UserError: for a name or value that cannot work; nothing has been started then.
    """
    from saclab.grid.forecast import forecast_hours

    overrides: dict[str, Any] = {"q_bias_episodes": Q_BIAS_EPISODES}
    if updates is not None:
        overrides["max_updates"] = updates
    resources = chosen_resources(workers, None, batch)
    assert resources.workers is not None
    cells = make_grid(environments, variants, "paper", seeds, runs, {}, overrides)
    resources.require_startable(cells)
    left = sum(not cell.finished for cell in cells)
    if left:
        tell(f"{left} of {len(cells)} runs to do; a few updates of each kind are measured to forecast the time …")
        hours = forecast_hours(cells, resources.workers, resources.threads, resources.batch)
        about = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.0f} minutes"
        tell(f"forecast: about {about} with {resources.workers} worker(s); stop at any time, the same command goes on")
    return _compare(cells, resources, report or Path(runs) / "report", show, tell, checkpoint_minutes)


def last(stream: Iterable[Sequence[RunStatus]]) -> list[RunStatus]:
    """Let the grid run without showing it; the last statuses."""
    *_, statuses = stream
    return list(statuses)
