"""saclab from Python: `saclab.train`, `saclab.resume`, `saclab.compare`, `saclab.load_policy`, `saclab.read_run`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from saclab.comparison.grid import Cell, make_grid
from saclab.comparison.launch import RunStatus, launch
from saclab.config import Config
from saclab.protocols import PROTOCOLS, make_config
from saclab.signals import requests_from_signals
from saclab.training.events import Event
from saclab.training.machine import usable_cores
from saclab.training.run_folder import RunRecord, read_config, read_run, run_path

COMPARED = ("sac", "sac-auto", "averaged", "averaged-auto")
"""The variants of a comparison, unless others are asked for."""
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
    threads: int = 1,
    runs: Path | str = "runs",
    report: Path | str | None = None,
    environment_arguments: Mapping[str, Any] | None = None,
    show: Callable[[Iterable[Sequence[RunStatus]]], list[RunStatus]] | None = None,
    checkpoint_minutes: float = 10,
    **overrides: Any,
) -> Comparison:
    """Train every variant on every environment with every seed, in worker processes, then write the report.

    Finished runs are skipped, unfinished ones resumed; a failed run does not stop the others.

    Args:
        environments: Gymnasium ids.
        variants: keys of `saclab.variants.VARIANTS`.
        seeds: how many (0, 1, …) or which; None for the protocol's own number.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        workers: runs at a time; None for one per core.
        threads: cores that each run uses.
        runs: the folder that holds all runs.
        report: the report's folder; None for `runs`/report.
        environment_arguments: keyword arguments of every environment.
        show: consumes the stream of statuses and returns the last ones, such as `saclab.display.show_grid`.
        checkpoint_minutes: wall-clock time between checkpoints.
        **overrides: any setting of AlgorithmSettings or TrainingSettings, for every run.

    Raises:
        UserError: for a name or value that cannot work; nothing has been started then.
    """
    cells = plan(environments, variants, seeds, protocol, runs, environment_arguments, overrides)
    workers = workers or max(1, len(usable_cores()) // threads)
    require_startable(cells, min(workers, len(cells)))
    with requests_from_signals() as requests:
        statuses = (show or last)(launch(cells, workers, threads, requests, checkpoint_minutes))
    failed = {status.cell.folder: status.message for status in statuses if status.status == "failed"}
    begun = [cell.folder for cell in cells if (cell.folder / "config.json").exists()]
    page = None
    if begun and not requests.stop:
        from saclab.comparison.report import write_report

        page = write_report(begun, Path(report) if report else Path(runs) / "report")
    return Comparison([read_run(folder) for folder in begun], failed, page, requests.stop)


def reproduce(
    environments: Sequence[str] = ("HalfCheetah-v4", "Humanoid-v4"),
    variants: Sequence[str] = COMPARED,
    seeds: int | Sequence[int] | None = None,
    updates: int | None = None,
    *,
    workers: int | None = None,
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
        workers: runs at a time, one core each; None for one per core.
        runs: the folder that holds all runs.
        report: the report's folder; None for `runs`/report.
        show: as in `compare`.
        tell: takes the forecast.
        checkpoint_minutes: wall-clock time between checkpoints.

    Raises:
        UserError: for a name or value that cannot work; nothing has been started then.
    """
    from saclab.comparison.forecast import forecast_hours

    overrides: dict[str, Any] = {"q_bias_episodes": Q_BIAS_EPISODES}
    if updates is not None:
        overrides["max_updates"] = updates
    cells = plan(environments, variants, seeds, "paper", runs, {}, overrides)
    workers = workers or len(usable_cores())
    require_startable(cells, min(workers, len(cells)))
    left = sum(not cell.finished for cell in cells)
    if left:
        tell(f"{left} of {len(cells)} runs to do; a few updates of each kind are measured to forecast the time …")
        hours = forecast_hours(cells, workers, threads=1)
        about = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.0f} minutes"
        tell(f"forecast: about {about} with {workers} worker(s); stop at any time, the same command goes on")
    return compare(
        environments, variants, seeds, "paper", workers=workers, runs=runs, report=report, show=show,
        checkpoint_minutes=checkpoint_minutes, **overrides,
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


def require_startable(cells: Sequence[Cell], at_once: int) -> None:
    """Raise UserError before anything is started if an environment, a folder or the memory will not do."""
    from saclab.environments.make import environment_spec, make_environment
    from saclab.replay import RowLayout, require_memory
    from saclab.training.journal import require_same_config

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
        require_memory(cell.config.training.replay_capacity, layout, at_once)


def last(stream: Iterable[Sequence[RunStatus]]) -> list[RunStatus]:
    """Let the grid run without showing it; the last statuses."""
    *_, statuses = stream
    return list(statuses)
