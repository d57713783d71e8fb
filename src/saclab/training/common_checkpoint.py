"""What the checkpoints of several runs have in common, so that they can be continued as one batch."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from saclab.replay import ReplayBuffer
from saclab.training.checkpoint import (
    CheckpointError,
    newest_first,
    read_checkpoint,
    read_manifest,
    set_aside,
    step_of,
)

LARGEST_BATCH = 4096


def checkpoint_steps(run: Path) -> list[int]:
    """The steps of a run folder's finished checkpoints, newest first."""
    return [step_of(path) for path in newest_first(run / "checkpoints")]


def batch_slots(run: Path) -> int:
    """Slots of the batch in which a run was saved last, or begun; 0 if it was not begun, or is alone."""
    for path in newest_first(run / "checkpoints"):
        with suppress(CheckpointError, OSError):
            return slots_among(read_manifest(path)["state"].get("facts"))
    with suppress(OSError, ValueError, RecursionError):
        return slots_among(json.loads((run / "config.json").read_text()))
    return 0


def slots_among(facts: object) -> int:
    """The slots in what `machine_facts` gave, if that is what it is."""
    machine = facts.get("machine") if isinstance(facts, dict) else None
    slots = machine.get("batch") if isinstance(machine, dict) else None
    return slots if type(slots) is int and 0 <= slots <= LARGEST_BATCH else 0


def common_checkpoints(
    runs: Sequence[Path], replay: ReplayBuffer, warns: Sequence[Callable[[str], None]]
) -> list[Path]:
    """The checkpoints of the newest step of which every run folder has a whole one; an empty list if none has any.

    Each is read once to see that it is whole, its transitions into `replay`.

    Newer ones are taken away: they are damaged, or the others were not saved before the process was killed.

    Raises:
        CheckpointError: if there is no such step; the checkpoints stay as they are then.
    """
    found = [{step_of(path): path for path in reversed(newest_first(run / "checkpoints"))} for run in runs]
    if not any(found):
        return []
    damaged: dict[Path, str] = {}
    for step in sorted(set.intersection(*(set(paths) for paths in found)), reverse=True):
        checkpoints = [paths[step] for paths in found]
        for path in checkpoints:
            try:
                read_checkpoint(path, replay)
            except (CheckpointError, OSError) as error:
                damaged[path] = f"{path} is damaged: {error}"
        if damaged.keys() & set(checkpoints):
            continue
        for paths, warn in zip(found, warns, strict=True):
            for newer in (paths[other] for other in paths if other > step):
                set_aside(newer, ".damaged" if newer in damaged else ".partial")
                if newer in damaged:
                    warn(f"{damaged[newer]}; it is set aside, and {paths[step].name} before it is used")
        return checkpoints
    problems = list(damaged.values()) + [
        f"{run} has {', '.join(path.name for path in paths.values()) or 'none'}"
        for run, paths in zip(runs, found, strict=True)
    ]
    raise CheckpointError(
        f"the runs of the batch have no whole checkpoint of the same step: {'; '.join(problems)}. Continue them each "
        "alone (--batch 0), or in batches of those that are equally far"
    )
