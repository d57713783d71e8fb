"""The command that searches for settings.

Nothing slow is imported before it runs, so that `saclab --help` answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from saclab.cli.training import Given, parse_arguments

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class How:
    workers: int | None = None
    """Runs at a time; None for one per core, or on Ray as many as the cluster has room for."""
    threads: int | None = None
    """Cores that XLA uses for each run, or for a run group; None for one, or for all. Results depend on it in the last
    bits."""
    batch: int | None = None
    """Runs of one trial that are trained together, as one run group, one trial at a time; 0 for each alone, None for 16
    on an accelerator, else 0."""
    launcher: Literal["local", "ray"] = "local"
    """Processes on this machine, or a Ray cluster whose machines share the tune's folder; needs the extra `ray`."""
    ray_address: str | None = None
    """Where the cluster answers; None for RAY_ADDRESS, else the one on this machine, else one that is started."""
    ray_cpus: float | None = None
    """Cores that Ray sets aside for each run; None for threads."""
    ray_gpus: float = 0.0
    """GPUs, or the part of one, that Ray sets aside for each run; 0 trains on cores."""
    checkpoint_minutes: float = 10
    """Wall-clock time between checkpoints; it does not change any result."""
    environment_arguments: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"reset_noise_scale": 0.0}'."""


@dataclass(frozen=True)
class Tune:
    """Search for better settings of a variant with Optuna, then write a page; needs the extra `tune`.

    The first trial has the variant's own settings, if they lie in the space. The same command goes on after a stop. The
    settings shown below are the protocol's; one that is given holds for every trial and is not searched.
    """

    environment: Positional[Annotated[str, arg(metavar="ENVIRONMENT")]]
    """Gymnasium id, such as HalfCheetah-v4, or package.module:Name-v0 to import the package first."""
    algorithm: Given
    training: Given
    variant: str = "sac-auto"
    """See `saclab variants`."""
    protocol: str = "standard"
    """See `saclab protocols`."""
    trials: int = 50
    """How many, those before a stop counted in."""
    seeds: int = 1
    """Runs of each trial, whose mean is its worth; their seeds are counted from first_seed."""
    first_seed: int = 0
    """The other seeds follow it."""
    objective: Literal["mean", "final", "steps", "seconds"] = "mean"
    """Evaluation return: its mean over training, or that of the last; or the way until an evaluation reaches score."""
    score: float | None = None
    """The evaluation return that objectives steps and seconds are about."""
    space: Path | None = None
    """TOML file that changes what is searched: `discount = [0.9, 0.99]`, `polyak_rate = {low = 0.001, high = 0.1, log =
    true}`, `batch_size = false` to leave it, `defaults = false` to search nothing else."""
    no_pruning: bool = False
    """Train every trial to its end, in place of giving up those that look bad."""
    search_seed: int = 0
    """What the trials' settings are drawn from."""
    out: Path | None = None
    """Folder of the tune; None for tune/<environment>/<variant>."""
    how: OmitArgPrefixes[How] = field(default_factory=How)

    def __call__(self, console: Console) -> int:
        from saclab.cli import display
        from saclab.grid.resources import chosen_resources
        from saclab.tuning.tune import tune

        how = self.how
        resources = chosen_resources(
            how.workers, how.threads, how.batch, how.launcher, how.ray_address, how.ray_cpus, how.ray_gpus
        )
        result = tune(
            self.environment, self.variant, self.protocol, self.trials,
            seeds=range(self.first_seed, self.first_seed + self.seeds), objective=self.objective, score=self.score,
            space=self.space, pruning=not self.no_pruning, search_seed=self.search_seed, out=self.out,
            environment_arguments=parse_arguments(how.environment_arguments), resources=resources,
            checkpoint_minutes=how.checkpoint_minutes, show=lambda stream: display.show_tune(stream, console),
            **self.algorithm, **self.training,
        )  # fmt: skip
        return display.show_tuned(result, console)
