"""What the scripts of the planned experiments start: each is run with a program that only tells its words."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

from saclab.cli.main import parse
from saclab.config import Config
from saclab.protocols import make_config

EXAMPLES = Path(__file__).parents[1] / "examples"
TELLING = '#!/usr/bin/env bash\nprintf "%s\\n" "${*@Q}"\n'
"""One write a command: two of them share a log."""


def commands_of(script: str, *words: str, folder: Path, keeping: bool = False) -> list[Any]:
    """The parsed commands that `examples/<script>/run.sh` starts; without the runs that are kept, if told so."""
    experiment = folder / "examples" / script
    experiment.mkdir(parents=True)
    shutil.copy(EXAMPLES / "experiment.sh", experiment.parent)
    shutil.copy(EXAMPLES / script / "run.sh", experiment)
    if keeping:
        (experiment / "runs").symlink_to(EXAMPLES / script / "runs")
    program, log = folder / "saclab", folder / "runs" / "log.txt"
    program.write_text(TELLING)
    program.chmod(0o755)
    environment = os.environ | {"SACLAB": str(program)}
    subprocess.run([experiment / "run.sh", folder / "runs", *words], check=True, env=environment, timeout=600)
    return [parse(shlex.split(line)) for line in log.read_text().splitlines()]


def config_of(command: Any) -> Config:
    """The configuration of a run that a command trains."""
    given = {**command.algorithm, **command.training}
    return make_config(command.environment, command.variant, command.protocol, command.seed, overrides=given)
