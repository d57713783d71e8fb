"""Which runs of a grid are trained together, as one run group."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from saclab.config import group_key
from saclab.grid.plan import Cell
from saclab.training.common_checkpoint import checkpoint_moments, group_slots
from saclab.training.manifest import Moment
from saclab.training.run_folder import FAILURE

NO_CHECKPOINT = Moment(-1)  # one of step 0 is something else


class RunGroup(NamedTuple):
    """Runs that are trained together."""

    members: list[int]
    """Places of the runs in the sequence that was given."""
    slots: int
    """There are as many as runs, or as the run group had from which they are continued."""


def run_groups(cells: Sequence[Cell], size: int) -> list[RunGroup]:
    """Groups of at most `size` unfinished cells of the same structure that have come equally far, in their order."""
    kinds: dict[str, list[int]] = {}
    for index, cell in enumerate(cells):
        kinds.setdefault(group_key(cell.config), []).append(index)
    groups = []
    for members in kinds.values():
        for equally_far in by_progress(cells, members):
            parts = [equally_far[first : first + size] for first in range(0, len(equally_far), size)]
            groups += [RunGroup(part, max(len(part), min(size, slots_before(cells, part)))) for part in parts]
    return sorted(groups, key=lambda group: group.members)


def by_progress(cells: Sequence[Cell], members: Sequence[int]) -> list[list[int]]:
    """Parts that have a checkpoint of the same moment, or none at all; the runs of a group are always equally far.

    A process that was killed while it saved leaves the newest checkpoint in some of its runs only; the one before
    is in all of them, as two are kept. A run that has failed would only hold up the others, or fail with them again.
    """
    parts = []
    for failed in (False, True):
        chosen = [index for index in members if (cells[index].folder / FAILURE).exists() == failed]
        moments = {index: checkpoint_moments(cells[index].folder) or [NO_CHECKPOINT] for index in chosen}
        while moments:
            common = min(found[0] for found in moments.values())
            part = [index for index, found in moments.items() if common in found]
            parts.append(part)
            moments = {index: found for index, found in moments.items() if index not in part}
    return parts


def slots_before(cells: Sequence[Cell], members: Sequence[int]) -> int:
    """Slots of the run group in which these runs were last; 0 if they were in none."""
    return max(group_slots(cells[index].folder) for index in members)
