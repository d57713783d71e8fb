"""Which checkpoints runs go on from together: the newest whole ones of the same moment. One run is a case."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import msgspec

from saclab.records import Damaged, Facts, read_json
from saclab.replay import ReplayBuffer
from saclab.training.checkpoint import Checkpoint, read_checkpoint, set_aside
from saclab.training.manifest import (
    CheckpointError,
    Moment,
    moment_of,
    newest_first,
    read_manifest,
    visible_checkpoints,
)


def checkpoint_moments(run: Path) -> list[Moment]:
    """The moments of a run folder's finished checkpoints, newest first; evaluated or not is all one."""
    return [common_moment(path) for path in visible_checkpoints(run / "checkpoints")]


def checkpoint_steps(run: Path) -> list[int]:
    """The steps of a run folder's finished checkpoints, newest first."""
    return [moment.steps for moment in checkpoint_moments(run)]


def common_moment(checkpoint: Path) -> Moment:
    """What runs of a group must have in common: an evaluation may fall into a step of one of them only."""
    return moment_of(checkpoint)._replace(tested=True)


def group_slots(run: Path) -> int:
    """Slots of the run group in which a run was saved last, or begun; 0 if it was not begun, or is alone."""
    for path in visible_checkpoints(run / "checkpoints"):
        with suppress(CheckpointError, msgspec.ValidationError):
            return msgspec.convert(read_manifest(path).state.get("facts"), Facts).machine.batch
    with suppress(Damaged):
        return read_json(run / "config.json", Facts).machine.batch
    return 0


def load_newest_checkpoint(folder: Path, replay: ReplayBuffer, warn: Callable[[str], None]) -> Checkpoint | None:
    """The newest checkpoint in `folder` that is whole, its transitions put into `replay`; None if there is none."""
    found = read_common([folder], lambda run, path: read_checkpoint(path, replay), [warn])
    return found[0] if found else None


def read_common(
    folders: Sequence[Path], read: Callable[[int, Path], Checkpoint], warns: Sequence[Callable[[str], None]]
) -> list[Checkpoint]:
    """Each run's checkpoint of the newest moment of which all have a whole one; an empty list if there is none at all.

    Newer ones are set aside: they are damaged, or the others were not saved before the process was killed.

    Args:
        folders: of the checkpoints, one for each run.
        read: reads a run's checkpoint, its transitions to where they belong; each file is read once unless
            one is damaged.
        warns: told for each run what is damaged.

    Raises:
        CheckpointError: if there are checkpoints and no such moment; they stay as they are.
    """
    by_moment = [checkpoints_by_moment(folder) for folder in folders]
    if not any(by_moment):
        return []
    damaged: dict[Path, str] = {}
    for moment in sorted(set.intersection(*(set(paths) for paths in by_moment)), reverse=True):
        found = [first_whole(run, paths[moment], read, damaged) for run, paths in enumerate(by_moment)]
        whole = [each for each in found if each is not None]
        if len(whole) < len(folders):
            continue
        for folder, (path, _), warn in zip(folders, whole, warns, strict=True):
            set_aside_newer(folder, path, damaged, warn)
        return [checkpoint for _, checkpoint in whole]
    raise CheckpointError(nothing_in_common(folders, by_moment, list(damaged.values())))


def checkpoints_by_moment(folder: Path) -> dict[Moment, list[Path]]:
    """Moment -> its checkpoints, newest first: there are two where one was taken before an evaluation of this step."""
    found: dict[Moment, list[Path]] = {}
    for path in newest_first(folder):
        found.setdefault(common_moment(path), []).append(path)
    return found


def first_whole(
    run: int, paths: Sequence[Path], read: Callable[[int, Path], Checkpoint], damaged: dict[Path, str]
) -> tuple[Path, Checkpoint] | None:
    """The first that can be read; those before it are entered as damaged."""
    for path in paths:
        try:
            return path, read(run, path)
        except (CheckpointError, OSError) as error:
            damaged[path] = f"{path} is damaged: {error}"
    return None


def set_aside_newer(folder: Path, used: Path, damaged: Mapping[Path, str], warn: Callable[[str], None]) -> None:
    """Take away the checkpoints that are newer than the one that is used."""
    checkpoints = newest_first(folder)
    for newer in checkpoints[: checkpoints.index(used)]:
        set_aside(newer, ".damaged" if newer in damaged else ".partial")
        if newer in damaged:
            warn(f"{damaged[newer]}; it is set aside, and {used.name} before it is used")


def nothing_in_common(
    folders: Sequence[Path], by_moment: Sequence[Mapping[Moment, Sequence[Path]]], problems: list[str]
) -> str:
    """Why the runs cannot be continued, and the way out."""
    if len(folders) == 1:
        return "no checkpoint can be used. " + "; ".join(problems)
    problems += [
        f"{folder.parent} has {', '.join(path.name for paths in checkpoints.values() for path in paths) or 'none'}"
        for folder, checkpoints in zip(folders, by_moment, strict=True)
    ]
    return (
        f"the runs of the run group have no whole checkpoint of the same step: {'; '.join(problems)}. Continue them "
        "each alone (--batch 0), or in run groups of those that are equally far"
    )
