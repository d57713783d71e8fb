"""saclab from Python: `saclab.train`, `saclab.resume`, `saclab.compare`, `saclab.load_policy`, `saclab.read_run`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from saclab.config import Config, require
from saclab.grid import ray
from saclab.grid.launch import launch
from saclab.grid.plan import Cell, make_grid
from saclab.grid.tasks import RunStatus
from saclab.machine import accelerator, usable_cores
from saclab.protocols import PROTOCOLS, make_config
from saclab.signals import requests_from_signals
from saclab.training.events import Event
from saclab.training.run_folder import RunRecord, read_config, read_run, run_path

COMPARED = ("sac", "sac-auto", "averaged", "averaged-auto")
"""The variants of a comparison, unless others are asked for."""
BATCH_ON_ACCELERATOR = 16
"""Runs of a batch, unless another number is asked for."""
Q_BIAS_EPISODES = 2
"""With each test of `reproduce`: the paper's hypothesis is that averaging lowers the bias."""


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
    from saclab.environments.make import require_import_allowed

    config = read_config(Path(run))
    require_import_allowed(config.environment, imports)
    return _train(config, Path(run), on_event, checkpoint_minutes)


def _train(config: Config, folder: Path, on_event: Callable[[Event], None], checkpoint_minutes: float) -> RunRecord:
    from saclab.training.loop import train as training_events

    with requests_from_signals() as requests:
        for event in training_events(config, folder, requests, checkpoint_minutes):
            on_event(event)
    return read_run(folder)


class Comparison(NamedTuple):
    runs: list[RunRecord]
    """The runs that have begun, finished or not."""
    failed: dict[Path, str]
    """Run folder -> what went wrong."""
    report: Path | None
    """The report's page; None if no run has anything to show."""
    interrupted: int = 0
    """The signal that stopped the grid, or 0."""


def compare(
    environments: Sequence[str],
    variants: Sequence[str] = COMPARED,
    seeds: int | Sequence[int] | None = None,
    protocol: str = "standard",
    *,
    workers: int | None = None,
    threads: int | None = None,
    batch: int | None = None,
    runs: Path | str = "runs",
    report: Path | str | None = None,
    environment_arguments: Mapping[str, Any] | None = None,
    show: Callable[[Iterable[Sequence[RunStatus]]], list[RunStatus]] | None = None,
    tell: Callable[[str], None] = lambda text: None,
    checkpoint_minutes: float = 10,
    launcher: Literal["local", "ray"] = "local",
    ray_address: str | None = None,
    ray_cpus: float | None = None,
    ray_gpus: float = 0.0,
    **overrides: Any,
) -> Comparison:
    """Train every variant on every environment with every seed, in worker processes, then write the report.

    Finished runs are skipped, unfinished ones resumed; a failed run does not stop the others.

    Args:
        environments: Gymnasium ids.
        variants: keys of `saclab.variants.VARIANTS`.
        seeds: how many (0, 1, …) or which; None for the protocol's own number.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        workers: runs at a time; of a batch, the processes that step its environments. None for one per core, or on
            Ray as many tasks as the cluster has room for.
        threads: cores that XLA uses for each run, or for a batch; None for one, or for all.
        batch: how many runs of the same structure are trained as one batch; 0 for each alone, None for 16 where there
            is an accelerator. Then acting_delay is 1, unless it is given.
        runs: the folder that holds all runs; on Ray, one that all machines share.
        report: the report's folder; None for `runs`/report.
        environment_arguments: keyword arguments of every environment.
        show: consumes the stream of statuses and returns the last ones, such as `saclab.cli.display.show_grid`.
        tell: takes what the user should know before it starts.
        checkpoint_minutes: wall-clock time between checkpoints.
        launcher: "local" for processes on this machine, "ray" for a Ray cluster, which needs the extra `ray`.
        ray_address: of the cluster; None for RAY_ADDRESS, else the one that runs on this machine, else a new one.
        ray_cpus: cores that Ray sets aside for each run; None for `threads`.
        ray_gpus: GPUs, or the part of one, that Ray sets aside for each run; 0 trains on cores.
        **overrides: any setting of AlgorithmSettings or TrainingSettings, for every run.

    Raises:
        UserError: for a name or value that cannot work, or a missing extra; nothing has been started then.
    """
    require(workers is None or workers >= 1, "workers", workers, "use at least 1")
    batch = chosen_batch(batch, launcher, ray_gpus)
    if batch:
        overrides = {"acting_delay": 1} | overrides
    cores = len(usable_cores())
    threads = threads or (cores if batch and launcher == "local" else max(1, int(ray_cpus or 1)))
    cluster = ray.chosen_cluster(launcher, threads, ray_address, ray_cpus, ray_gpus)
    cells = plan(environments, variants, seeds, protocol, runs, environment_arguments, overrides)
    if batch:
        tell(batch_note(cells, batch))
    with requests_from_signals() as requests:
        if cluster is None:
            workers = workers or (cores if batch else max(1, cores // threads))
            require_startable(cells, min(batch or workers, len(cells)), "--batch" if batch else "--workers")
            stream = launch(cells, workers, threads, requests, checkpoint_minutes, batch)
        else:
            require_startable(cells, 0, "--workers")  # the memory of its machines is not this one's
            stream = ray.launch(cells, workers, threads, requests, checkpoint_minutes, batch, cluster)
        statuses = (show or last)(stream)
    return compared(statuses, Path(report) if report else Path(runs) / "report", requests.stop)


def compared(statuses: Sequence[RunStatus], report: Path, interrupted: int) -> Comparison:
    """What came of a grid, with its report in a folder unless the grid was interrupted."""
    failed = {status.cell.folder: status.message for status in statuses if status.status == "failed"}
    begun = [status.cell.folder for status in statuses if (status.cell.folder / "config.json").exists()]
    page = None
    if begun and not interrupted:
        from saclab.report.report import write_report

        page = write_report(begun, report)
    return Comparison([read_run(folder) for folder in begun], failed, page, interrupted)


def chosen_batch(batch: int | None, launcher: str = "local", ray_gpus: float = 0.0) -> int:
    """How many runs make a batch; None leaves it to where they are trained. Raises SettingError for a negative one."""
    if batch is None:
        return BATCH_ON_ACCELERATOR if (ray_gpus > 0 if launcher == "ray" else accelerator()) else 0
    require(batch >= 0, "batch", batch, "use a number of runs, or 0 to train each alone")
    return batch


def batch_note(cells: Sequence[Cell], batch: int) -> str:
    """What a user should know of a grid that is trained in batches."""
    from saclab.grid.groups import batches
    from saclab.training.starts import ratio_note

    unfinished = [cell for cell in cells if not cell.finished]
    groups = batches(unfinished, batch)
    sizes = ", ".join(str(len(group.members)) for group in groups) or "none to do"
    training = cells[0].config.training
    behind = "waits for the updates" if training.acting_delay == 0 else "is one round of updates behind"
    return (
        f"batches of {sizes} run(s), each with the machine to itself; the policy that acts {behind} (acting_delay "
        f"{training.acting_delay}); {ratio_note(cells[0].config)}"
    )


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
    show: Callable[[Iterable[Sequence[RunStatus]]], list[RunStatus]] | None = None,
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
        tell: takes the forecast.
        checkpoint_minutes: wall-clock time between checkpoints.

    Raises:
        UserError: for a name or value that cannot work; nothing has been started then.
    """
    from saclab.grid.forecast import forecast_hours

    overrides: dict[str, Any] = {"q_bias_episodes": Q_BIAS_EPISODES}
    if updates is not None:
        overrides["max_updates"] = updates
    batch = chosen_batch(batch)
    if batch:
        overrides["acting_delay"] = 1
    cells = plan(environments, variants, seeds, "paper", runs, {}, overrides)
    cores = len(usable_cores())
    workers = workers or cores
    require_startable(cells, min(batch or workers, len(cells)), "--batch" if batch else "--workers")
    left = sum(not cell.finished for cell in cells)
    if left:
        tell(f"{left} of {len(cells)} runs to do; a few updates of each kind are measured to forecast the time …")
        hours = forecast_hours(cells, workers, cores if batch else 1, batch)
        about = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.0f} minutes"
        tell(f"forecast: about {about} with {workers} worker(s); stop at any time, the same command goes on")
    return compare(
        environments, variants, seeds, "paper", workers=workers, batch=batch, runs=runs, report=report, show=show,
        tell=tell, checkpoint_minutes=checkpoint_minutes, **overrides,
    )  # fmt: skip


def plan(
    environments: Sequence[str],
    variants: Sequence[str],
    seeds: int | Sequence[int] | None,
    protocol: str,
    runs: Path | str,
    environment_arguments: Mapping[str, Any] | None,
    overrides: Mapping[str, Any],
) -> list[Cell]:
    """The grid of a comparison; raises UserError for a name or value that cannot work."""
    if seeds is None:
        seeds = PROTOCOLS[protocol].seeds if protocol in PROTOCOLS else 1
    numbers = range(seeds) if isinstance(seeds, int) else seeds
    return make_grid(environments, variants, protocol, numbers, Path(runs), environment_arguments, overrides)


def require_startable(cells: Sequence[Cell], at_once: int, fewer: str) -> None:
    """Raise UserError before anything is started if an environment, a folder or the memory will not do.

    Args:
        cells: the grid.
        at_once: runs whose replay buffers are filled together.
        fewer: the option that would lower their number.
    """
    from saclab.environments.make import environment_spec, make_environment
    from saclab.replay import RowLayout, require_memory
    from saclab.training.starts import require_same_config

    checked = set()
    for cell in cells:
        if (cell.folder / "config.json").exists():
            require_same_config(cell.folder, cell.config)
        if cell.config.environment in checked:
            continue
        checked.add(cell.config.environment)
        environment = make_environment(cell.config.environment, cell.config.environment_arguments)
        spec = environment_spec(cell.config.environment, environment)
        environment.close()
        layout = RowLayout(spec.observation_size, spec.action_size)
        if fewer == "--workers" or not accelerator():  # else the buffers lie on the device, and the batch looks at it
            require_memory(cell.config.training.replay_capacity, layout, at_once, fewer)


def last(stream: Iterable[Sequence[RunStatus]]) -> list[RunStatus]:
    """Let the grid run without showing it; the last statuses."""
    *_, statuses = stream
    return list(statuses)
