"""The commands that train, and what they call.

Nothing slow is imported before a command runs, so that `saclab --help` answers at once.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from saclab.config import Config
from saclab.errors import SettingError
from saclab.limits import require_threads
from saclab.protocols import make_config
from saclab.trackers.asked import Tracking
from saclab.variants import COMPARED

if TYPE_CHECKING:
    from rich.console import Console

    from saclab.training.events import Event

Given = Mapping[str, Any]
"""The settings that were given, by name; `saclab.cli.settings` makes an option of each."""


@dataclass(frozen=True)
class Where:
    runs: Path = Path("runs")
    """Folder that holds all runs."""
    checkpoint_minutes: float = 10
    """Wall-clock time between checkpoints; it does not change any result."""
    environment_arguments: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"reset_noise_scale": 0.0}'."""


@dataclass(frozen=True)
class Train:
    """Train one run; finds and continues it if it was stopped. Every setting below can be changed."""

    environment: Positional[Annotated[str, arg(metavar="ENVIRONMENT")]]
    """Gymnasium id, such as HalfCheetah-v4, or package.module:Name-v0 to import the package first."""
    algorithm: Given
    training: Given
    variant: str = "sac-auto"
    """See `saclab variants`."""
    protocol: str = "standard"
    """See `saclab protocols`."""
    seed: int = 0
    """Every random draw of the run derives from it."""
    name: str | None = None
    """Takes the variant's place in the run folder's path, for runs with other settings; the report shows them as an arm
    of this name."""
    threads: int | None = None
    """Cores that XLA uses; None for all. Results depend on it in the last bits."""
    tracking: OmitArgPrefixes[Tracking] = field(default_factory=Tracking)
    where: OmitArgPrefixes[Where] = field(default_factory=Where)

    def __call__(self, console: Console) -> int:
        limit_threads(self.threads)
        from saclab.training.run_folder import run_path

        config = make_config(
            self.environment, self.variant, self.protocol, self.seed,
            parse_arguments(self.where.environment_arguments), {**self.algorithm, **self.training},
        )  # fmt: skip
        folder = run_path(self.where.runs, config, self.name)
        return train_and_show(config, folder, self.where.checkpoint_minutes, console, self.tracking)


@dataclass(frozen=True)
class Resume:
    """Continue a run from its newest checkpoint."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The run folder."""
    checkpoint_minutes: float = 10
    """Wall-clock time between checkpoints."""
    threads: int | None = None
    """Cores that XLA uses; None for as many as the run has used so far."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""
    tracking: OmitArgPrefixes[Tracking] = field(default_factory=Tracking)

    def __call__(self, console: Console) -> int:
        from saclab.training.run_folder import read_config, read_last_session

        config = read_config(self.run)
        limit_threads(self.threads or read_last_session(self.run).machine.threads)
        from saclab.environments.wrappers import require_import_allowed

        require_import_allowed(config.environment, config.training.wrappers, self.imports)
        return train_and_show(config, self.run, self.checkpoint_minutes, console, self.tracking)


@dataclass(frozen=True)
class Compare:
    """Train every variant on every environment with every seed, then write a report.

    Finished runs are skipped, unfinished ones continued. The settings shown below are those of the protocol; one
    that is given is changed in every run.
    """

    environments: Positional[Annotated[tuple[str, ...], arg(metavar="[ENVIRONMENT ...]")]]
    """Gymnasium ids."""
    algorithm: Given
    training: Given
    variants: tuple[str, ...] = COMPARED
    """See `saclab variants`."""
    protocol: str = "standard"
    """See `saclab protocols`."""
    seeds: int | None = None
    """How many seeds, counted from first_seed; None for the protocol's own number."""
    first_seed: int = 0
    """The other seeds follow it."""
    name: str | None = None
    """Takes the variant's place in the run folders' paths, for one variant with other settings; the report shows them
    as an arm of this name."""
    sweep: UseAppendAction[tuple[str, ...]] = ()
    """Values of a setting of the algorithm, such as polyak_rate=0.001,0.005 or "hidden_layers=256 256,512 512"; once
    for each setting. Every combination is an arm, whose name tells it; that of the variant's own values is the
    variant."""
    workers: int | None = None
    """Runs at a time; of a run group, the processes that step its environments. None for one per core, or on Ray as
    many tasks as the cluster has room for."""
    threads: int | None = None
    """Cores that XLA uses for each run, or for a run group; None for one, or for all. Results depend on it in the last
    bits."""
    batch: int | None = None
    """Runs of the same structure that are trained together, as one run group, their replay buffers on the device; 0 for
    each alone, None for 16 on an accelerator, else 0. It changes no setting; --acting-delay 1 makes it faster."""
    launcher: Literal["local", "ray"] = "local"
    """Processes on this machine, or a Ray cluster whose machines share the runs' folder; needs the extra `ray`."""
    ray_address: str | None = None
    """Where the cluster answers; None for RAY_ADDRESS, else the one on this machine, else one that is started."""
    ray_cpus: float | None = None
    """Cores that Ray sets aside for each run, or for a run group; None for threads."""
    ray_gpus: float = 0.0
    """GPUs, or the part of one, that Ray sets aside for each run, or for a run group; 0 trains on cores."""
    report: Path | None = None
    """Folder of the report; None for report in the runs' folder."""
    tracking: OmitArgPrefixes[Tracking] = field(default_factory=Tracking)
    where: OmitArgPrefixes[Where] = field(default_factory=Where)

    def __call__(self, console: Console) -> int:
        from saclab import api
        from saclab.cli import display
        from saclab.grid.plan import seed_numbers
        from saclab.grid.sweep import parse_sweep

        if not self.environments:
            raise SettingError("environments", (), "name at least one, such as: saclab compare HalfCheetah-v4")
        result = api.compare(
            self.environments, self.variants, seed_numbers(self.seeds, self.protocol, self.first_seed), self.protocol,
            workers=self.workers, threads=self.threads, batch=self.batch, runs=self.where.runs, name=self.name,
            sweep=parse_sweep(self.sweep), report=self.report,
            tell=lambda text: console.print(text, soft_wrap=True, highlight=False, markup=False),
            environment_arguments=parse_arguments(self.where.environment_arguments),
            show=lambda stream: display.show_grid(stream, console),
            checkpoint_minutes=self.where.checkpoint_minutes, launcher=self.launcher, ray_address=self.ray_address,
            ray_cpus=self.ray_cpus, ray_gpus=self.ray_gpus, tracking=self.tracking, **self.algorithm, **self.training,
        )  # fmt: skip
        return display.show_comparison(result, console)


@dataclass(frozen=True)
class Reproduce:
    """Run the paper's whole experiment and write its report: say first how long it will take, resume what has begun."""

    environments: tuple[str, ...] = ("HalfCheetah-v4", "Humanoid-v4")
    """Gymnasium ids."""
    variants: tuple[str, ...] = COMPARED
    """See `saclab variants`."""
    seeds: int | None = None
    """How many seeds; None for the protocol's own number."""
    updates: int | None = None
    """Fewer updates than the paper's; the report says that it is scaled down."""
    workers: int | None = None
    """Runs at a time, one core each; of a run group, the processes that step its environments. None: one per core."""
    batch: int | None = None
    """Runs of the same structure that are trained as one run group; 0 for each alone, None for 16 on an accelerator."""
    report: Path | None = None
    """Folder of the report; None for report in the runs' folder."""
    runs: Path = Path("runs")
    """Folder that holds all runs."""
    checkpoint_minutes: float = 10
    """Wall-clock time between checkpoints."""

    def __call__(self, console: Console) -> int:
        from saclab import api
        from saclab.cli import display

        result = api.reproduce(
            self.environments, self.variants, self.seeds, self.updates, workers=self.workers, batch=self.batch,
            runs=self.runs,
            report=self.report, show=lambda stream: display.show_grid(stream, console),
            tell=lambda text: console.print(text, soft_wrap=True, markup=False),
            checkpoint_minutes=self.checkpoint_minutes,
        )  # fmt: skip
        return display.show_comparison(result, console)


def parse_arguments(text: str) -> dict[str, Any]:
    """Keyword arguments of an environment from JSON; raises SettingError for anything but an object."""
    try:
        values = msgspec.json.decode(text.encode(errors="surrogatepass"))
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise SettingError("environment_arguments", text, f"not JSON ({error}); write '{{\"key\": 1.0}}'") from error
    if not isinstance(values, dict):
        raise SettingError("environment_arguments", text, "write a JSON object, such as '{\"key\": 1.0}'")
    return values


def limit_threads(threads: int | None) -> None:
    """Hold XLA and NumPy to a number of cores; works only before they are first imported."""
    from saclab.machine import thread_limits

    require_threads(threads)
    if threads is not None:
        os.environ.update(thread_limits(threads))


def train_and_show(
    config: Config, folder: Path, checkpoint_minutes: float, console: Console, tracking: Tracking
) -> int:
    """Train in this process with a progress bar."""
    from saclab.cli import display
    from saclab.signals import EXIT_STATUS, requests_from_signals
    from saclab.trackers.feed import track
    from saclab.training.loop import train
    from saclab.training.run_folder import is_finished

    finished = is_finished(folder)
    if finished:
        untold = "; nothing is sent to a tracker" if tracking.any else ""
        console.print(f"{folder} is finished already; its results are kept{untold}", soft_wrap=True, markup=False)
    with requests_from_signals(process_ends=True) as requests:
        stream: Iterable[Event] = train(config, folder, requests, checkpoint_minutes)
        if tracking.any and not finished:
            stream = track(stream, tracking.usable(config, folder))
        for _ in display.show_run(stream, console):
            pass
        if requests.stop:
            console.print(f"saved; continue with: saclab resume {folder}", soft_wrap=True, markup=False)
            return EXIT_STATUS[requests.stop]
    return 0
