"""The command line: reads the words, runs the command, turns errors into exit statuses."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, Any, Union

import tyro
from tyro.conf import subcommand

from saclab.cli.results import Evaluate, Export, Play, Protocols, Record, Report, Share, Variants, Watch
from saclab.cli.settings import with_absolute_paths, with_settings
from saclab.cli.streams import output_lost, use_lasting_streams
from saclab.cli.training import Compare, Reproduce, Resume, Train
from saclab.cli.tuning import Tune
from saclab.errors import for_terminal
from saclab.exits import EXIT_FAILED, end_after
from saclab.other_names import require_own_names


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit status.

    0: done. 1: a run failed, or what there was to show could not be written (a closed pipe is no failure). 2: bad
    input, a number that is not finite counted in. 129, 130, 143: saved and stopped by SIGHUP, SIGINT or SIGTERM.
    """
    use_lasting_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        status = run(arguments or ["--help"])
    except SystemExit as end:  # of the parser, which has said why
        status = end.code if isinstance(end.code, int) else EXIT_FAILED if end.code else 0
    except BaseException as error:
        status, line = end_after(error)
        print(for_terminal(error, line), file=sys.stderr)
    return status or (EXIT_FAILED if output_lost() else 0)


def run(arguments: Sequence[str]) -> int:
    """Run the command that the words ask for; its exit status."""
    if list(arguments) == ["--version"]:
        print(f"saclab {version('saclab')}")
        return 0
    if not sys.stderr.isatty():
        os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    command = with_absolute_paths(parse(arguments))
    from rich.console import Console

    return int(command(Console()))


COMMANDS: dict[str, type] = {
    "train": Train,
    "compare": Compare,
    "tune": Tune,
    "reproduce": Reproduce,
    "resume": Resume,
    "report": Report,
    "watch": Watch,
    "evaluate": Evaluate,
    "record": Record,
    "play": Play,
    "export": Export,
    "share": Share,
    "variants": Variants,
    "protocols": Protocols,
}
WITH_SETTINGS = ("train", "compare", "tune")
"""The commands that have an option for each setting of a run."""


def parse(arguments: Sequence[str]) -> Any:
    """The command that the words ask for."""
    name, *words = arguments
    if name in WITH_SETTINGS:
        require_own_names(words)
    if name in COMMANDS:  # what is said of a wrong word is about this command, and not about all that have one like it
        return tyro.cli(command_of(name, arguments), prog=f"saclab {name}", args=words)
    every: Any = Union[*(Annotated[command_of(each, arguments), subcommand(each)] for each in COMMANDS)]
    description = "A laboratory for Soft Actor-Critic: train its variants, compare them, reproduce the paper."
    return tyro.cli(every, prog="saclab", description=description, args=list(arguments))


def command_of(name: str, arguments: Sequence[str]) -> type:
    """A command as the parser takes it."""
    command = COMMANDS[name]
    return with_settings(command, arguments) if name in WITH_SETTINGS else command
