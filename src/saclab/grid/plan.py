"""The runs of a comparison: variants × environments × seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from saclab.config import Config
from saclab.protocols import make_config
from saclab.training.run_folder import is_finished, run_path


class Cell(NamedTuple):
    """One run of the grid."""

    config: Config
    folder: Path

    @property
    def finished(self) -> bool:
        return is_finished(self.folder)


def make_grid(
    environments: Sequence[str],
    variants: Sequence[str],
    protocol: str,
    seeds: Sequence[int],
    runs: Path,
    environment_arguments: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> list[Cell]:
    """One cell per environment, seed and variant; all variants of a seed come before the next seed.

    So a grid that is stopped early holds whole comparisons of fewer seeds.

    Raises:
        UserError: for an unknown name or a value that cannot work.
    """
    configs = [
        make_config(environment, variant, protocol, seed, environment_arguments, overrides)
        for seed in seeds
        for environment in dict.fromkeys(environments)
        for variant in dict.fromkeys(variants)
    ]
    return [Cell(config, run_path(runs, config)) for config in configs]
