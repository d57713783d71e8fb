"""The command line: reads the words, runs the command, turns errors into exit statuses."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from saclab.cli.commands import (
    EXIT_USER_ERROR,
    Compare,
    Evaluate,
    Protocols,
    Record,
    Report,
    Reproduce,
    Resume,
    Train,
    Variants,
)
from saclab.errors import UserError
from saclab.protocols import make_config
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
    except UserError as error:
        print(f"saclab: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    except KeyboardInterrupt:  # outside training, where there is nothing to save
        return EXIT_STATUS[signal.SIGINT]


def parse(arguments: Sequence[str]) -> Any:
    """The command that the words ask for, its settings by default those of its environment, variant and protocol.

    The three are guessed first, so that --help shows the values that a run would have; if the whole line then says
    something else, such as after `--seed 3 Humanoid-v4`, it is parsed again with what it said.
    """
    words = [word for word in arguments[1:] if not word.startswith("-")]
    variant, protocol = (option_value(arguments, name) for name in ("variant", "protocol"))
    guess = (words[0] if words else "HalfCheetah-v4", variant or "sac-auto", protocol or "standard")
    command = parse_with_defaults(arguments, *guess)
    if isinstance(command, Train) and guess != (said := (command.environment, command.variant, command.protocol)):
        command = parse_with_defaults(arguments, *said)
    return command


def parse_with_defaults(arguments: Sequence[str], environment: str, variant: str, protocol: str) -> Any:
    config = make_config(environment, variant, protocol)
    given = frozenset(word[2:].partition("=")[0].replace("-", "_") for word in arguments if word.startswith("--"))
    train = Train(tyro.MISSING, config.algorithm, config.training)
    compare = Compare(tyro.MISSING, config.algorithm, config.training, given=given)
    commands: Any = (
        Annotated[Train, subcommand("train", default=train)]
        | Annotated[Compare, subcommand("compare", default=compare)]
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


def option_value(arguments: Sequence[str], name: str) -> str | None:
    """The value of --name in either of its forms, before the whole line is parsed."""
    for index, word in enumerate(arguments):
        if word == f"--{name}" and index + 1 < len(arguments):
            return arguments[index + 1]
        if word.startswith(f"--{name}="):
            return word.partition("=")[2]
    return None
