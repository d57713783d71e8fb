"""What each command takes, and which function it calls. No logic lives here.

Nothing slow is imported before a command runs, so that `saclab --help` answers at once.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, Suppress

from saclab.config import AlgorithmSettings, Config, TrainingSettings, field_names
from saclab.errors import NonFiniteError, SettingError, TrainingFailed
from saclab.protocols import PROTOCOLS
from saclab.variants import VARIANTS

if TYPE_CHECKING:
    from rich.console import Console

EXIT_USER_ERROR = 2
EXIT_FAILED = 1


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

    environment: Positional[str]
    """Gymnasium id, such as HalfCheetah-v4, or package.module:Name-v0 to import the package first."""
    algorithm: OmitArgPrefixes[AlgorithmSettings]
    training: OmitArgPrefixes[TrainingSettings]
    variant: str = "sac-auto"
    """See `saclab variants`."""
    protocol: str = "standard"
    """See `saclab protocols`."""
    seed: int = 0
    """Every random draw of the run derives from it."""
    name: str | None = None
    """Takes the variant's place in the run folder's path, for runs with other settings."""
    threads: int | None = None
    """Cores that XLA uses; None for all. Results depend on it in the last bits."""
    tensorboard: bool = False
    """Write TensorBoard event files into the run folder; needs the extra `tensorboard`."""
    wandb: str | None = None
    """Send the run to this project of Weights & Biases; needs the extra `wandb`."""
    where: OmitArgPrefixes[Where] = field(default_factory=Where)

    def __call__(self, console: Console) -> int:
        limit_threads(self.threads)
        from saclab.training.run_folder import run_path

        config = Config(
            self.environment, self.variant, self.protocol, self.seed, self.algorithm, self.training,
            parse_arguments(self.where.environment_arguments),
        )  # fmt: skip
        folder = run_path(self.where.runs, config, self.name)
        return train_and_show(config, folder, self.where.checkpoint_minutes, console, self.tensorboard, self.wandb)


@dataclass(frozen=True)
class Resume:
    """Continue a run from its newest checkpoint."""

    run: Positional[Path]
    """The run folder."""
    checkpoint_minutes: float = 10
    """Wall-clock time between checkpoints."""
    threads: int | None = None
    """Cores that XLA uses; None for as many as the run has used so far."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""

    def __call__(self, console: Console) -> int:
        from saclab.training.run_folder import read_config, read_last_session

        config = read_config(self.run)
        limit_threads(self.threads or read_last_session(self.run)["machine"]["threads"])
        from saclab.environments.make import require_import_allowed

        require_import_allowed(config.environment, self.imports)
        return train_and_show(config, self.run, self.checkpoint_minutes, console)


@dataclass(frozen=True)
class Compare:
    """Train every variant on every environment with every seed, then write a report.

    Finished runs are skipped, unfinished ones continued. The settings shown below are those of the protocol; one
    that is given is changed in every run.
    """

    environments: Positional[tuple[str, ...]]
    """Gymnasium ids."""
    algorithm: OmitArgPrefixes[AlgorithmSettings]
    training: OmitArgPrefixes[TrainingSettings]
    variants: tuple[str, ...] = ("sac", "sac-auto", "averaged", "averaged-auto")
    """See `saclab variants`."""
    protocol: str = "standard"
    """See `saclab protocols`."""
    seeds: int | None = None
    """How many seeds, counted from first_seed; None for the protocol's own number."""
    first_seed: int = 0
    """The other seeds follow it."""
    workers: int | None = None
    """Runs at a time; of a batch, the processes that step its environments. None for one per core, or on Ray as many
    tasks as the cluster has room for."""
    threads: int | None = None
    """Cores that XLA uses for each run, or for a batch; None for one, or for all. Results depend on it in the last
    bits."""
    batch: int | None = None
    """Runs of the same structure that are trained as one batch, their replay buffers on the device; 0 for each alone.
    None for 16 on an accelerator, else 0. Changes no setting of a run; --acting-delay 1 makes a batch faster."""
    launcher: Literal["local", "ray"] = "local"
    """Processes on this machine, or a Ray cluster whose machines share the runs' folder; needs the extra `ray`."""
    ray_address: str | None = None
    """Of the cluster; None for RAY_ADDRESS, else the one that runs on this machine, else one that is started."""
    ray_cpus: float | None = None
    """Cores that Ray sets aside for each run, or for a batch; None for threads."""
    ray_gpus: float = 0.0
    """GPUs, or the part of one, that Ray sets aside for each run, or for a batch; 0 trains on cores."""
    report: Path | None = None
    """Folder of the report; None for report in the runs' folder."""
    where: OmitArgPrefixes[Where] = field(default_factory=Where)
    given: Suppress[frozenset[str]] = frozenset()
    """Names of the settings that stand on the command line."""

    def __call__(self, console: Console) -> int:
        from saclab import api
        from saclab.cli import display

        if not self.environments:
            raise SettingError("environments", (), "name at least one, such as: saclab compare HalfCheetah-v4")
        count = self.seeds if self.seeds is not None else PROTOCOLS[self.protocol].seeds
        if count < 1:
            raise SettingError("seeds", count, "use at least 1")
        settings: tuple[Any, ...] = (self.algorithm, self.training)
        overrides = {
            name: getattr(part, name) for part in settings for name in field_names(type(part)) if name in self.given
        }
        result = api.compare(
            self.environments, self.variants, range(self.first_seed, self.first_seed + count), self.protocol,
            workers=self.workers, threads=self.threads, batch=self.batch, runs=self.where.runs, report=self.report,
            tell=lambda text: console.print(text, soft_wrap=True, highlight=False),
            environment_arguments=parse_arguments(self.where.environment_arguments),
            show=lambda stream: display.show_grid(stream, console),
            checkpoint_minutes=self.where.checkpoint_minutes, launcher=self.launcher, ray_address=self.ray_address,
            ray_cpus=self.ray_cpus, ray_gpus=self.ray_gpus, **overrides,
        )  # fmt: skip
        return display.show_comparison(result, console)


@dataclass(frozen=True)
class Reproduce:
    """Run the paper's whole experiment and write its report: say first how long it will take, resume what has begun."""

    environments: tuple[str, ...] = ("HalfCheetah-v4", "Humanoid-v4")
    """Gymnasium ids."""
    variants: tuple[str, ...] = ("sac", "sac-auto", "averaged", "averaged-auto")
    """See `saclab variants`."""
    seeds: int | None = None
    """How many seeds; None for the protocol's own number."""
    updates: int | None = None
    """Fewer updates than the paper's; the report says that it is scaled down."""
    workers: int | None = None
    """Runs at a time, one core each; of a batch, the processes that step its environments. None for one per core."""
    batch: int | None = None
    """Runs of the same structure that are trained as one batch; 0 for each alone, None for 16 on an accelerator."""
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
            tell=lambda text: console.print(text, soft_wrap=True), checkpoint_minutes=self.checkpoint_minutes,
        )  # fmt: skip
        return display.show_comparison(result, console)


@dataclass(frozen=True)
class Evaluate:
    """Test a run's best policy on fresh episodes."""

    run: Positional[Path]
    """The run folder, or a folder that holds a policy."""
    episodes: int = 20
    """Test episodes, stepped side by side."""
    seed: int = 1_000_000
    """Of the episodes' starts; other than in training, where the policy was chosen."""
    stochastic: bool = False
    """Sample actions in place of the mean action."""
    json: bool = False
    """Print one line of JSON."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""

    def __call__(self, console: Console) -> int:
        from saclab import playback

        if self.episodes < 1:
            raise SettingError("episodes", self.episodes, "use at least 1")
        result = playback.evaluate(self.run, self.episodes, self.seed, not self.stochastic, self.imports)
        console.print(json.dumps(result._asdict()) if self.json else result.sentence(), soft_wrap=True, highlight=False)
        return 0


@dataclass(frozen=True)
class Record:
    """Film a run's best policy; needs no screen."""

    run: Positional[Path]
    """The run folder."""
    video: Path | None = None
    """File to write; None for best/video.mp4 in the run folder, where the report finds it."""
    steps: int = 300
    """Environment steps to film at most."""
    seed: int = 1_000_000
    """Of the episode's start."""
    size: int = 320
    """Width and height in pixels."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""

    def __call__(self, console: Console) -> int:
        from saclab import playback

        path = self.video or self.run / "best" / "video.mp4"
        told = playback.record(self.run, path, self.steps, self.seed, self.size, self.imports)
        console.print(told, soft_wrap=True, markup=False)
        return 0


@dataclass(frozen=True)
class Report:
    """Write the comparison of finished and unfinished runs: a page, figures, tables."""

    runs: Positional[tuple[Path, ...]]
    """Run folders, or folders that hold some."""
    out: Path = Path("report")
    """Folder to write to."""
    allow_mixed: bool = False
    """Show runs that differ in more than variant and seed side by side, labelled by what differs, never pooled."""

    def __call__(self, console: Console) -> int:
        from saclab.report.report import write_report
        from saclab.training.run_folder import find_runs

        page = write_report(find_runs(self.runs or (Path("runs"),)), self.out, allow_mixed=self.allow_mixed)
        console.print(f"report: {page.resolve()}", soft_wrap=True, markup=False)
        return 0


@dataclass(frozen=True)
class Variants:
    """List the variants of SAC."""

    def __call__(self, console: Console) -> int:
        from saclab.cli import display

        console.print(display.catalogue({name: (row.description, row.settings) for name, row in VARIANTS.items()}))
        return 0


@dataclass(frozen=True)
class Protocols:
    """List the training protocols."""

    def __call__(self, console: Console) -> int:
        from saclab.cli import display

        rows = {name: (row.description, display.changed_settings(row.settings)) for name, row in PROTOCOLS.items()}
        console.print(display.catalogue(rows))
        return 0


def parse_arguments(text: str) -> dict[str, Any]:
    """Keyword arguments of an environment from JSON; raises SettingError for anything but an object."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise SettingError("environment_arguments", text, f"not JSON ({error}); write '{{\"key\": 1.0}}'") from error
    if not isinstance(values, dict):
        raise SettingError("environment_arguments", text, "write a JSON object, such as '{\"key\": 1.0}'")
    return values


def limit_threads(threads: int | None) -> None:
    """Hold XLA and NumPy to a number of cores; works only before they are first imported."""
    from saclab.machine import thread_limits

    if threads is not None:
        if threads < 1:
            raise SettingError("threads", threads, "use at least 1")
        os.environ.update(thread_limits(threads))


def train_and_show(
    config: Config,
    folder: Path,
    checkpoint_minutes: float,
    console: Console,
    tensorboard: bool = False,
    wandb_project: str | None = None,
) -> int:
    """Train in this process with a progress bar."""
    from saclab.cli import display, trackers
    from saclab.signals import EXIT_STATUS, requests_from_signals
    from saclab.training.loop import train
    from saclab.training.run_folder import is_finished

    if is_finished(folder):
        console.print(f"{folder} is finished already; its results are kept", soft_wrap=True, markup=False)
    with requests_from_signals(process_ends=True) as requests:
        stream = train(config, folder, requests, checkpoint_minutes)
        if tensorboard:
            stream = trackers.tensorboard(stream)
        if wandb_project is not None:
            stream = trackers.wandb(stream, wandb_project, config, folder)
        try:
            for _ in display.show_run(stream, console):
                pass
        except TrainingFailed as error:
            print(f"saclab: {error}", file=sys.stderr)
            return EXIT_USER_ERROR if isinstance(error, NonFiniteError) else EXIT_FAILED
        if requests.stop:
            console.print(f"saved; continue with: saclab resume {folder}", soft_wrap=True, markup=False)
            return EXIT_STATUS.get(requests.stop, EXIT_FAILED)
    return 0
