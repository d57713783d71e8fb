"""The command line: reads the words, runs the command, turns errors into exit statuses."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from saclab.cli.results import Evaluate, Protocols, Record, Report, Variants
from saclab.cli.settings import with_settings
from saclab.cli.training import EXIT_FAILED, EXIT_USER_ERROR, Compare, Reproduce, Resume, Train
from saclab.errors import NonFiniteError, TrainingFailed, UserError, for_terminal
from saclab.signals import EXIT_STATUS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit status.

    0: done. 1: a run failed. 2: bad input, a number that is not finite counted in. 130, 143: saved and stopped by
    SIGINT or SIGTERM.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = parse(arguments or ["--help"])
        from rich.console import Console

        return int(command(Console()))
    except (UserError, TrainingFailed) as error:
        print(for_terminal(error), file=sys.stderr)
        return EXIT_USER_ERROR if isinstance(error, UserError | NonFiniteError) else EXIT_FAILED
    except KeyboardInterrupt:  # outside training, where there is nothing to save
        return EXIT_STATUS[signal.SIGINT]


def parse(arguments: Sequence[str]) -> Any:
    """The command that the words ask for."""
    train, compare = with_settings(Train, arguments), with_settings(Compare, arguments)
    commands: Any = (
        Annotated[train, subcommand("train")]
        | Annotated[compare, subcommand("compare")]
        | Annotated[Reproduce, subcommand("reproduce")]
        | Annotated[Resume, subcommand("resume")]
        | Annotated[Report, subcommand("report")]
        | Annotated[Evaluate, subcommand("evaluate")]
        | Annotated[Record, subcommand("record")]
        | Annotated[Variants, subcommand("variants")]
        | Annotated[Protocols, subcommand("protocols")]
    )
    description = "A laboratory for Soft Actor-Critic: train its variants, compare them, reproduce the paper."
    return tyro.cli(commands, prog="saclab", description=description, args=list(arguments))
