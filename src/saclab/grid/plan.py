"""The runs of a comparison: variants × environments × seeds, and whether they can be begun."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from saclab.config import Config
from saclab.errors import SettingError, require
from saclab.files import absolute, same_directory
from saclab.grid.sweep import swept_arms
from saclab.protocols import make_config, own_config, protocol_row
from saclab.training.run_folder import is_finished, run_path

if TYPE_CHECKING:
    from saclab.environments.make import EnvironmentSpec
    from saclab.replay import RowLayout


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
    seeds: int | Sequence[int] | None,
    runs: Path | str,
    environment_arguments: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    name: str | None = None,
    sweep: Mapping[str, Sequence[Any]] | None = None,
) -> list[Cell]:
    """One cell per environment, seed, variant and swept arm; all arms of a seed come before the next seed.

    So a grid that is stopped early holds whole comparisons of fewer seeds.

    Args:
        environments: Gymnasium ids.
        variants: keys of `saclab.variants.VARIANTS`.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        seeds: as `seed_numbers` takes them.
        runs: the folder that holds all runs.
        environment_arguments: keyword arguments of every environment.
        overrides: settings of every run by name.
        name: takes the variant's place in the run folders' paths; for one variant only.
        sweep: setting of the algorithm -> its values; each combination is an arm, whose name tells them; that of the
            variant's own values is the variant.

    Raises:
        UserError: for an unknown name or a value that cannot work.
    """
    variants = tuple(dict.fromkeys(variants))
    require(
        name is None or len(variants) == 1, "name", name,
        f"it is the name of one variant with other settings, and here are {len(variants)}: choose one with --variants",
    )  # fmt: skip
    for setting in sorted({*(sweep or {})} & {*(overrides or {})}):
        raise SettingError("sweep", setting, "it is given for all runs as well: leave out one of the two")
    arms, cells = list(swept_arms(sweep or {})), []
    for seed, environment, variant, arm in product(
        seed_numbers(seeds, protocol), dict.fromkeys(environments), variants, arms
    ):
        plain = own_config(environment, variant, protocol, seed, environment_arguments, overrides)
        config = make_config(
            environment, variant, protocol, seed, environment_arguments, {**(overrides or {}), **arm.settings}
        )
        own_name = name if config == plain else (name or variant) + arm.suffix
        cells.append(Cell(config, run_path(absolute(runs), config, own_name)))
    return cells


def seed_numbers(seeds: int | Sequence[int] | None, protocol: str, first: int = 0) -> Sequence[int]:
    """The seeds of a comparison.

    Args:
        seeds: how many, or which; None for the protocol's own number.
        protocol: a key of `saclab.protocols.PROTOCOLS`.
        first: the first of them, where it is said how many.

    Raises:
        UserError: for an unknown protocol, or no seed at all.
    """
    own = protocol_row(protocol).seeds
    seeds = own if seeds is None else seeds
    numbers = range(first, first + seeds) if isinstance(seeds, int) else seeds
    require(len(numbers) >= 1, "seeds", seeds, "use at least 1")
    return numbers


@same_directory()
def require_startable(cells: Sequence[Cell], at_once: int, fewer: str, here: bool = True) -> None:
    """Raise UserError before anything is started if an environment, a folder or the memory will not do.

    The runs of one environment need not be of one size: a variant's row may say another capacity of the replay buffer,
    other networks or reward terms. The memory must do for as many of the largest as there are at once.

    Args:
        cells: the grid.
        at_once: runs that this machine's memory must hold together; 0 if they are trained elsewhere or on a device.
        fewer: the option that would lower their number.
        here: whether they are trained on this machine, which then must have what they begin with.
    """
    from saclab.environments.checked import CheckedEnvironment
    from saclab.memory import needed_memory, require_memory
    from saclab.replay import layout_of
    from saclab.training.starts import require_same_config

    specs: dict[str, EnvironmentSpec] = {}
    needed: dict[int, tuple[Config, RowLayout]] = {}
    for cell in cells:
        config = cell.config
        if (cell.folder / "config.json").exists():
            require_same_config(cell.folder, config)
        if (key := environment_key(config)) not in specs:
            environment = CheckedEnvironment(
                config.environment, config.environment_arguments, wrappers=config.training.wrappers
            )
            specs[key] = environment.spec
            environment.close()
        layout = layout_of(specs[key], config.algorithm)
        needed[sum(needed_memory(config, layout))] = config, layout
    if at_once:
        require_memory(*needed[max(needed)], at_once, fewer)
    if here:
        require_prefill_there(cells, specs)


def require_prefill_there(cells: Sequence[Cell], specs: Mapping[str, EnvironmentSpec]) -> None:
    """Raise UserError if what runs are to begin with cannot be read here; `specs` are by `environment_key`."""
    from saclab.replay import layout_of
    from saclab.training.manifest import visible_checkpoints
    from saclab.training.prefill import read_prefill

    looked_at = set()
    for cell in cells:
        if cell.config.training.prefill is None or cell.finished or visible_checkpoints(cell.folder / "checkpoints"):
            continue
        spec, settings = specs[environment_key(cell.config)], cell.config.algorithm
        kind = environment_key(cell.config), settings.terms_of_reward, settings.batch_size, cell.config.training
        if kind not in looked_at:
            read_prefill(cell.config, spec, layout_of(spec, settings))
            looked_at.add(kind)


def environment_key(config: Config) -> str:
    """The same for all runs of one environment with the same arguments and wrappers."""
    what = [config.environment, config.environment_arguments, config.training.wrappers]
    return json.dumps(what, sort_keys=True, default=repr)
