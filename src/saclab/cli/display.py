"""What the terminal shows while runs go on: live bars on a terminal, plain lines in a file or a pipe."""

from __future__ import annotations

import dataclasses
import shlex
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table

from saclab.api import Comparison
from saclab.grid.rate import RateMeter
from saclab.grid.tasks import RunStatus
from saclab.protocols import Protocol
from saclab.signals import EXIT_STATUS
from saclab.training import events
from saclab.variants import Variant

if TYPE_CHECKING:
    from saclab.tuning.tune import Tuned
    from saclab.tuning.tuner import Tune

PLAIN_SECONDS = 20  # between two lines of a grid's progress that goes to a file or a pipe


def duration(seconds: float | None) -> str:
    """1:02:03, or a dash if it is not known."""
    if seconds is None:
        return "–"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"


def show_run(stream: Iterable[events.Event], console: Console) -> Iterator[events.Event]:
    """Pass a run's events on, and show them: a bar with rate and time left, one line per evaluation."""
    columns = (BarColumn(bar_width=30), TaskProgressColumn(), TextColumn("{task.description}"))
    meter, evaluation_return = RateMeter(), None
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("random steps", total=1.0)
        for event in stream:
            match event:
                case events.Started():
                    where = f"resumed at step {event.resumed_at_step}" if event.resumed_at_step else "started"
                    console.print(f"{escape(str(event.run))} {where}", soft_wrap=True)
                    for note in event.notes:
                        console.print(f"  {escape(note)}", soft_wrap=True)
                case events.Progress():
                    meter.enter(event.seconds, event.fraction, event.updates)
                    bar.update(task, completed=event.fraction, description=(
                        f"step {event.steps:,} · update {event.updates:,} · {meter.updates_per_second:.0f} updates/s · "
                        f"{duration(meter.seconds_left)} left · evaluation return {number(evaluation_return)}"
                    ))  # fmt: skip
                case events.Evaluated():
                    evaluation_return = float(event.total_rewards.mean())
                    spread = float(event.total_rewards.std())
                    console.print(
                        f"step {event.steps:>9,}  update {event.updates:>9,}  episode {event.episodes:>6,}  "
                        f"evaluation return {evaluation_return:9.1f} ± {spread:.1f} over {len(event.total_rewards)}"
                        + ("  best" if event.best else "")
                        + f"  ({meter.updates_per_second:.0f} updates/s, {duration(meter.seconds_left)} left)",
                        soft_wrap=True,
                    )
                case events.Warned():
                    console.print(f"warning: {escape(event.message)}", soft_wrap=True)
                case events.Finished():
                    console.print(
                        f"finished: {event.reason}; {event.steps:,} steps, {event.updates:,} updates, "
                        f"{event.episodes:,} episodes; best evaluation return {event.best_return:.1f}, "
                        f"last {event.final_return:.1f}",
                        soft_wrap=True,
                    )
            yield event


def show_grid(stream: Iterable[Sequence[RunStatus]], console: Console) -> list[RunStatus]:
    """Show a grid of runs until its end; the last statuses."""
    statuses: Sequence[RunStatus] = ()
    told: dict[Path, int] = {}
    last_line = 0.0
    with Live(console=console, refresh_per_second=4, transient=True, auto_refresh=console.is_terminal) as live:
        for statuses in stream:
            tell_warnings(statuses, told, console)
            if console.is_terminal:
                live.update(grid_table(statuses, rows=max(5, console.height - 6)))
            elif time.monotonic() - last_line > PLAIN_SECONDS:
                last_line = time.monotonic()
                console.print(grid_line(statuses), soft_wrap=True)
    console.print(grid_table(statuses, rows=len(statuses)))
    return list(statuses)


def tell_warnings(statuses: Sequence[RunStatus], told: dict[Path, int], console: Console) -> None:
    """Say what has been warned of since the last time; `told` is run folder -> how many were told."""
    for status in statuses:
        for warning in status.warnings[told.get(status.cell.folder, 0) :]:
            console.print(f"warning: {run_name(status)}: {warning}", markup=False, soft_wrap=True)
        told[status.cell.folder] = len(status.warnings)


def run_name(status: RunStatus) -> str:
    """Environment, variant or the name in its place, and seed."""
    config, folder = status.cell
    return f"{config.environment} {folder.parts[-3]} seed {config.seed}"


def grid_line(statuses: Sequence[RunStatus]) -> str:
    """One plain line: how many runs are done, and where the running ones are."""
    finished = sum(status.status == "finished" for status in statuses)
    running = [
        f"{run_name(status)}: {status.fraction:.0%}, {status.meter.updates_per_second:.0f} updates/s, "
        f"{duration(status.meter.seconds_left)} left, evaluation return {number(status.evaluation_return)}"
        for status in statuses
        if status.status == "running"
    ]
    running += [f"{run_name(status)}: {status.state}, which trains it" for status in statuses if status.elsewhere]
    return escape(f"{finished} of {len(statuses)} runs finished | " + " | ".join(running))


def grid_table(statuses: Sequence[RunStatus], rows: int) -> Table:
    """One line per run, the running ones first where not all fit."""
    table = Table(box=None, header_style="bold")
    table.add_column("run", overflow="fold")
    for title in ("state", "done", "updates/s", "left", "evaluation return"):
        table.add_column(title, justify="right", no_wrap=True)
    order = {"running": 0, "failed": 1, "waiting": 2, "interrupted": 2, "finished": 3}
    shown = statuses if len(statuses) <= rows else sorted(statuses, key=lambda status: order[status.status])[:rows]
    colours = {"failed": "red", "running": "cyan", "finished": "green"}
    for status in shown:
        table.add_row(
            escape(run_name(status)), f"[{colours.get(status.status, 'default')}]{status.state}[/]",
            f"{status.fraction:.0%}", f"{status.meter.updates_per_second:.0f}", duration(status.meter.seconds_left),
            number(status.evaluation_return),
        )  # fmt: skip
    if len(shown) < len(statuses):
        table.add_row(f"… and {len(statuses) - len(shown)} more")
    return table


def show_comparison(result: Comparison, console: Console) -> int:
    """Say what failed and where the report lies; the exit status."""
    for folder, message in result.failed.items():
        console.print(f"failed: {folder}: {message}", markup=False, soft_wrap=True)
    if result.interrupted:
        console.print("saved; the same command continues where it stopped")
        return EXIT_STATUS.get(result.interrupted, 1)
    if result.report:
        console.print(f"report: {result.report.resolve()}", markup=False, soft_wrap=True)
    return 1 if result.failed else 0


def show_tune(stream: Iterable[Tune], console: Console) -> Tune:
    """Show a tune until its end: a line for each trial that ends, the runs under way on a terminal; its last state."""
    from saclab.tuning.text import beginning, trial_line

    told, warned, last_line, state = set[int](), dict[Path, int](), time.monotonic(), None
    begun = False
    with Live(console=console, refresh_per_second=4, transient=True, auto_refresh=console.is_terminal) as live:
        for state in stream:
            if not begun:
                begun = True
                console.print(beginning(state), markup=False, highlight=False, soft_wrap=True)
            for trial in state.ended:
                if trial.number not in told | state.ended_before:
                    told.add(trial.number)
                    console.print(trial_line(trial, state.plan), markup=False, highlight=False, soft_wrap=True)
            runs = [run for trial in state.open for run in trial.runs]
            tell_warnings(runs, warned, console)
            if console.is_terminal:
                live.update(grid_table(runs, rows=max(5, console.height - 6)))
            elif time.monotonic() - last_line > PLAIN_SECONDS:
                last_line = time.monotonic()
                console.print(f"{len(state.ended)} of {state.trials} trials ended | {grid_line(runs)}", soft_wrap=True)
    assert state is not None
    return state


def show_tuned(result: Tuned, console: Console) -> int:
    """Say what a tune has found, and where its page lies; the exit status."""
    if result.best is not None:
        own = "" if result.own_value is None else f", against {result.own_value:.4g} of the variant's own settings"
        told = f"best: {result.value:.4g}{own}; judge it on seeds that no trial had:"
        console.print(told if result.commands else "nothing better than the variant's own settings was found")
        for words in result.commands:
            console.print(f"  {shlex.join(words)}", markup=False, highlight=False, soft_wrap=True)
    elif result.trials:
        console.print("no trial has come to its end, or to the score with all of its runs")
    if result.page is not None:
        console.print(f"page: {result.page}", markup=False, soft_wrap=True)
    for number, why in result.hindered.items():
        console.print(
            f"trial {number} was stopped: {why}; the same command goes on with it", markup=False, soft_wrap=True
        )
    if result.interrupted:
        console.print("saved; the same command continues where it stopped")
        return EXIT_STATUS.get(result.interrupted, 1)
    return 1 if result.hindered else 0


def catalogue(rows: Mapping[str, tuple[str, Mapping[str, Any]]]) -> Table:
    """Names with their description and settings."""
    table = Table(box=None, show_header=False, padding=(0, 2, 1, 0))
    for name, (description, settings) in rows.items():
        listed = ", ".join(f"{key} {value}" for key, value in settings.items())
        table.add_row(
            f"[bold]{escape(name)}[/]", escape(description) + (f"\n[dim]{escape(listed)}[/]" if listed else "")
        )
    return table


def variants_table(variants: Mapping[str, Variant]) -> Table:
    """Each variant with its axes, its source and what it costs."""
    table = Table("variant", "cost", "what it is, its settings, its source", box=None, padding=(0, 2, 1, 0))
    for name, row in variants.items():
        told = [escape(row.description)]
        for where, settings in {"": row.settings, **row.by_environment}.items():
            if settings:
                listed = ", ".join(f"{key} {value}" for key, value in settings.items())
                told.append(f"[dim]{escape(f'{where}*: {listed}' if where else listed)}[/]")
        told.append(f"[dim]{escape(f'source: {row.source}')}[/]")
        table.add_row(f"[bold]{escape(name)}[/]", "" if row.cost is None else f"{row.cost:.3g}×", "\n".join(told))
    table.caption = "cost: time of an environment step with its updates on HalfCheetah-v4, one core; sac is 1×"
    return table


def settings_of(protocol: Protocol) -> dict[str, Any]:
    """What a protocol sets, by name, what it holds a variant to, and what differs by environment."""
    of_training = {name: value for name, value in dataclasses.asdict(protocol.settings).items() if value is not None}
    held = {f"{name} at most": most for name, most in protocol.ceilings.items()}
    elsewhere = {
        f"on {prefix}* {name}": value
        for prefix, here in protocol.by_environment.items()
        for name, value in here.items()
    }
    return of_training | protocol.algorithm | held | elsewhere
