"""The commands that look at what has been trained: evaluate, record, report; and the lists of what there is.

Nothing slow is imported before a command runs, so that `saclab --help` answers at once.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from saclab.errors import SettingError
from saclab.protocols import PROTOCOLS
from saclab.variants import VARIANTS

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a run's best policy on fresh episodes."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The run folder, a folder that holds a policy, or hf:user/name[@revision] of the Hugging Face Hub."""
    episodes: int = 20
    """How many episodes, stepped side by side."""
    seed: int = 1_000_000
    """Seed of the episodes' starts, another than in training, where the policy was chosen."""
    stochastic: bool = False
    """Sample actions in place of the mean action."""
    json: bool = False
    """Print one line of JSON."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""

    def __call__(self, console: Console) -> int:
        from saclab import playback
        from saclab.environments.foreign import prints_apart
        from saclab.signals import end_at_once_on_ctrl_c

        if self.episodes < 1:
            raise SettingError("episodes", self.episodes, "use at least 1")
        end_at_once_on_ctrl_c()
        with prints_apart():  # what is told is alone on standard output
            result = playback.evaluate(self.run, self.episodes, self.seed, not self.stochastic, self.imports)
        console.print(json.dumps(result._asdict()) if self.json else result.sentence(), soft_wrap=True, highlight=False)
        return 0


@dataclass(frozen=True)
class Record:
    """Film a run's best policy; needs no screen."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The run folder, a folder that holds a policy, or hf:user/name[@revision] of the Hugging Face Hub."""
    video: Path | None = None
    """File to write, .mp4 or .gif; None for video.mp4 beside the policy, where the report finds it, or for name.mp4
    here if the policy is the Hub's."""
    steps: int = 300
    """Environment steps to film at most."""
    seed: int = 1_000_000
    """Seed of the episode's start."""
    size: int = 320
    """Width and height in pixels."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""

    def __call__(self, console: Console) -> int:
        from saclab import playback
        from saclab.trained_policy import policy_folder

        path = self.video or beside(self.run, "mp4") or policy_folder(self.run) / "video.mp4"
        told = playback.record(self.run, path, self.steps, self.seed, self.size, self.imports)
        console.print(told, soft_wrap=True, markup=False)
        return 0


def beside(run: Path, ending: str) -> Path | None:
    """name.<ending> in the working directory for a policy of the Hub's, beside which nothing is written; else None."""
    from saclab import hub

    return Path(f"{hub.parsed(run).repository.partition('/')[2]}.{ending}") if hub.is_address(run) else None


@dataclass(frozen=True)
class Play:
    """Show a run's best policy in a window, episode after episode, until it is closed or Ctrl-C."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The run folder, a folder that holds a policy, or hf:user/name[@revision] of the Hugging Face Hub."""
    episodes: int | None = None
    """How many episodes; None for no end."""
    seed: int = 1_000_000
    """Seed of the episodes' starts, which are those of `evaluate`."""
    stochastic: bool = False
    """Sample actions in place of the mean action."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""

    def __call__(self, console: Console) -> int:
        from saclab.play import play

        if self.episodes is not None and self.episodes < 1:
            raise SettingError("episodes", self.episodes, "use at least 1")
        with suppress(KeyboardInterrupt):  # the way to end it
            played = play(self.run, self.episodes, self.seed, not self.stochastic, self.imports)
            for number, episode in enumerate(played, start=1):
                told = f"episode {number}: return {episode.total_reward:.1f} in {episode.length} steps"
                console.print(told, soft_wrap=True, highlight=False)
        return 0


@dataclass(frozen=True)
class Export:
    """Write a run's best policy as an ONNX file, for programs without saclab; needs the extra `onnx`.

    Inputs: observation [rows, O], and noise [rows, A], 0 if it is left out. Outputs: action, of the mean, and
    sampled_action; within the environment's bounds, and of its type.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The run folder, a folder that holds a policy, or hf:user/name[@revision] of the Hugging Face Hub."""
    out: Path | None = None
    """File to write; None for policy.onnx beside the policy, or for name.onnx here if that is the Hub's."""

    def __call__(self, console: Console) -> int:
        from saclab.onnx_export import export_onnx
        from saclab.trained_policy import policy_folder

        path = self.out or beside(self.run, "onnx") or policy_folder(self.run) / "policy.onnx"
        export_onnx(self.run, path)
        console.print(str(path), soft_wrap=True, markup=False, highlight=False)
        return 0


@dataclass(frozen=True)
class Share:
    """Put a run's best policy on the Hugging Face Hub, with a model card; needs the extra `hub`.

    What is sent is listed first: the policy, config.json and result.json without what tells of this machine,
    evaluations.csv, a film, the card.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The run folder."""
    repository: Positional[Annotated[str, arg(metavar="USER/NAME")]]
    """user/name on the Hub; made if there is none."""
    folder: Path | None = None
    """Write there what would be sent, for a look at it, and send nothing."""
    private: bool = False
    """Make the repository so that only its owner sees it."""
    license: str | None = None
    """For the card: an identifier of the Hub's, such as mit."""
    video: bool = False
    """Film an episode anew; else best/video.mp4 is taken, if there is one of this policy."""
    onnx: bool = False
    """Add the policy as an ONNX file; needs the extra `onnx` too."""
    episodes: int = 20
    """How many fresh episodes the card's score is of."""
    seed: int = 1_000_000
    """Seed of their starts, another than in training, where the policy was chosen."""
    imports: tuple[str, ...] = ()
    """Packages that the run's environment may import; a run folder alone is not trusted to name one."""
    paths_too: bool = False
    """Publish paths of this machine that are among the settings or the environment's arguments."""

    def __call__(self, console: Console) -> int:
        from dataclasses import asdict

        from saclab.sharing.share import share

        def tell(text: str) -> None:
            console.print(text, soft_wrap=True, markup=False, highlight=False)

        tell(share(**asdict(self), tell=tell))
        return 0


@dataclass(frozen=True)
class Report:
    """Write the comparison of finished and unfinished runs: a page, figures, tables."""

    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="[RUN ...]")]]
    """Run folders, or folders that hold some."""
    out: Path = Path("report")
    """Folder to write to."""
    strict: bool = False
    """Refuse if a folder cannot be read, or holds the same run as another, in place of leaving it out."""
    allow_mixed: bool = False
    """Show runs that differ in more than variant, name and seed as well, labelled by what differs, never pooled."""

    def __call__(self, console: Console) -> int:
        from saclab.report.report import write_report
        from saclab.training.run_folder import find_runs

        def tell(text: str) -> None:
            console.print(text, soft_wrap=True, markup=False, highlight=False)

        page = write_report(find_runs(self.runs or (Path("runs"),)), self.out, self.allow_mixed, self.strict, tell)
        console.print(f"report: {page.resolve()}", soft_wrap=True, markup=False)
        return 0


@dataclass(frozen=True)
class Watch:
    """Show the report's page in the browser while its runs go on; what you have chosen on it stays chosen."""

    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="[RUN ...]")]]
    """Run folders, or folders that hold some."""
    port: int = 8642
    """Of this machine's own address, 127.0.0.1; 0 for any that is free."""
    every: float = 10.0
    """Seconds in which the page is made at most once; it is made only while somebody looks and runs change."""
    allow_mixed: bool = False
    """Show runs that differ in more than variant, name and seed as well, labelled by what differs, never pooled."""

    def __call__(self, console: Console) -> int:
        from saclab.report.watch import WatchedPage, server_of

        if not self.every >= 0:
            raise SettingError("every", self.every, "use 0 or more seconds")
        with server_of(WatchedPage(self.runs or (Path("runs"),), self.every, self.allow_mixed), self.port) as server:
            console.print(f"http://127.0.0.1:{server.server_port}/  Ctrl-C ends it; the runs go on", soft_wrap=True)
            server.serve_forever()
        return 0


@dataclass(frozen=True)
class Variants:
    """List the variants of SAC."""

    def __call__(self, console: Console) -> int:
        from saclab.cli import display

        console.print(display.variants_table(VARIANTS))
        return 0


@dataclass(frozen=True)
class Protocols:
    """List the training protocols."""

    def __call__(self, console: Console) -> int:
        from saclab.cli import display

        rows = {name: (row.description, display.settings_of(row)) for name, row in PROTOCOLS.items()}
        console.print(display.catalogue(rows))
        return 0
