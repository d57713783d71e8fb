"""The command that trains a run anew."""

from __future__ import annotations

import json
import shlex
from typing import Any

from saclab.config import Config, flatten
from saclab.errors import UserError
from saclab.protocols import own_config

IDENTITY = ("environment", "variant", "protocol", "seed", "environment_arguments")
"""What stands in the command anyway."""


def train_command(config: Config, name: str | None = None) -> str:
    """`saclab train …` for this configuration, quoted for a shell; only what its defaults do not say is spelled out.

    For a variant or protocol that this version does not know, every setting is spelled out.

    Args:
        config: of the run.
        name: takes the variant's place in the run folder's path.
    """
    words = ["saclab", "train", config.environment, "--variant", config.variant]
    words += ["--protocol", config.protocol, "--seed", str(config.seed)]
    if name is not None:
        words += ["--name", name]
    if config.environment_arguments:
        words += ["--environment-arguments", json.dumps(config.environment_arguments)]
    try:
        default = own_config(
            config.environment, config.variant, config.protocol, config.seed, config.environment_arguments
        )
        settings = {name: here for name, (here, _) in config.differences(default).items()}
    except UserError:
        settings = {name: value for name, value in flatten(config.to_dict()).items() if name not in IDENTITY}
    for name, value in settings.items():
        words += ["--" + name.replace("_", "-"), *flag_values(value)]
    return shlex.join(words)


def flag_values(value: Any) -> list[str]:
    """A setting as the command line takes it."""
    return [str(item) for item in value] if isinstance(value, list | tuple) else [str(value)]
