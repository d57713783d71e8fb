"""What a tune asks, as its folder records it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saclab.config import Config, flatten
from saclab.errors import SettingError, UserError, require, shown
from saclab.grid.plan import Cell, seed_numbers
from saclab.protocols import make_config
from saclab.records import JSON_BYTES, Damaged, Missing, read_bytes
from saclab.training.run_folder import run_path
from saclab.tuning.objective import Objective, objective_of
from saclab.tuning.space import Choice, Space, changed_space, default_space

PLAN = "tune.json"


@dataclass(frozen=True)
class TunePlan:
    """All that decides what the trials of a tune are and how they are judged."""

    environment: str
    variant: str
    protocol: str
    seeds: tuple[int, ...]
    """Of each trial's runs."""
    objective: Objective
    space: Space
    overrides: dict[str, Any]
    """Settings that hold for every trial."""
    environment_arguments: dict[str, Any]
    search_seed: int
    """What the trials' settings are drawn from."""
    pruning: bool
    """Whether trials that look bad are given up."""

    def config(self, settings: Mapping[str, Any], seed: int) -> Config:
        """A run of a trial; raises UserError for settings that cannot work together."""
        return make_config(
            self.environment, self.variant, self.protocol, seed, self.environment_arguments,
            {**self.overrides, **settings},
        )  # fmt: skip

    def cells(self, folder: Path, name: str, settings: Mapping[str, Any]) -> list[Cell]:
        """The runs of a trial; raises UserError for settings that cannot work together."""
        configs = [self.config(settings, seed) for seed in self.seeds]
        return [Cell(config, run_path(folder / "runs", config, name)) for config in configs]

    def extremes(self, folder: Path) -> list[Cell]:
        """The runs of the variant's own settings, and of each end of the space: what must be possible at least."""
        changes: list[dict[str, Any]] = [{}]
        changes += [{name: end} for name, dimension in self.space.items() for end in dimension.ends]
        return [cell for change in changes for cell in self.cells(folder, "extreme", change)[:1]]

    @property
    def own_values(self) -> dict[str, Any]:
        """What the settings that are searched are without a search."""
        config = self.config({}, self.seeds[0])
        return {
            name: getattr(config.algorithm if hasattr(config.algorithm, name) else config.training, name)
            for name in self.space
        }

    @property
    def own_outside(self) -> dict[str, Any]:
        """The variant's own values that do not lie in the space: if there are none, the first trial tries them all."""
        return {name: value for name, value in self.own_values.items() if not self.space[name].holds(value)}

    def to_plain(self) -> dict[str, Any]:
        """As JSON has it."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain


def trial_name(number: int) -> str:
    """What takes the variant's place in the paths of a trial's runs."""
    return f"trial-{number:04d}"


def make_plan(
    environment: str,
    variant: str,
    protocol: str,
    seeds: int | Sequence[int],
    objective: str,
    score: float | None,
    space: Mapping[str, Any],
    overrides: Mapping[str, Any],
    environment_arguments: Mapping[str, Any],
    search_seed: int,
    pruning: bool,
) -> TunePlan:
    """A plan that can work; the arguments are those of `saclab.tune`.

    Raises:
        UserError: for a name or value that cannot work, in the space too.
    """
    require(0 <= search_seed < 2**31, "search_seed", search_seed, "use a whole number from 0 to 2**31 - 1")
    numbers = tuple(seed_numbers(seeds, protocol))
    require(len({*numbers}) == len(numbers), "seeds", numbers, "name each once")
    config = flatten(make_config(environment, variant, protocol, 0, environment_arguments, overrides).to_dict())
    bare = TunePlan(
        environment, variant, protocol, numbers, objective_of(objective, score), {},
        {name: config[name] for name in overrides}, dict(environment_arguments), search_seed, pruning,
    )  # fmt: skip
    plan = dataclasses.replace(bare, space=changed_space(possible_defaults(bare), space))
    for name, dimension in plan.space.items():
        if name in overrides:
            raise SettingError("space", name, "it is given for all trials as well: leave out one of the two")
        for value in dimension.ends:
            if refused := refusal(plan, name, value):
                raise SettingError("space", f"{name} = {value}", refused)
    return plan


def possible_defaults(plan: TunePlan) -> Space:
    """The default space without what the user has set, and without choices that the other settings do not allow."""
    found: Space = {}
    for name, dimension in default_space(plan.config({}, plan.seeds[0]).algorithm).items():
        possible = tuple(value for value in dimension.ends if not refusal(plan, name, value))
        if name not in plan.overrides and len(possible) > 1:
            found[name] = Choice(possible) if isinstance(dimension, Choice) else dimension
    return found


def refusal(plan: TunePlan, name: str, value: Any) -> str:
    """Why a value of a setting cannot work with the other settings; empty if it can."""
    try:
        plan.config({name: value}, plan.seeds[0])
    except UserError as error:
        return str(error)
    return ""


def is_recorded(folder: Path, plan: TunePlan) -> bool:
    """Whether the folder holds this tune already; False if it holds none.

    Raises:
        UserError: if it holds one that asks something else, with the first setting that differs.
    """
    path = folder / PLAN
    try:
        theirs = json.loads(read_bytes(path, JSON_BYTES))
    except Missing:
        return False
    except ValueError as error:
        raise Damaged(path, error) from error
    mine = plan.to_plain()
    if mine != theirs:
        name, here, there = first_difference(mine, theirs)
        raise UserError(
            f"{folder} holds a tune with another {name}: {shown(there)} there, {shown(here)} here: give the same "
            "command to go on with it, or another folder with --out"
        )
    return True


def first_difference(mine: Mapping[str, Any], theirs: Any) -> tuple[str, Any, Any]:
    """The first name whose value differs, with both values; inside of dictionaries, by both names."""
    theirs = theirs if isinstance(theirs, dict) else {}
    for name in (*mine, *theirs):
        here, there = mine.get(name, "nothing"), theirs.get(name, "nothing")
        if here != there and isinstance(here, dict) and isinstance(there, dict):
            inner, here, there = first_difference(here, there)
            return f"{name}, {inner}", here, there
        if here != there:
            return name, here, there
    raise AssertionError("they are equal")
