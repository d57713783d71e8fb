"""Where the runs of an engine go on: from their newest common checkpoint, or from the beginning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from saclab.config import Config
from saclab.errors import UserError
from saclab.files import write_json
from saclab.machine import different_facts, other_simulation
from saclab.records import FileRecord, RunDescription
from saclab.replay import RowLayout
from saclab.training.checkpoint import Checkpoint
from saclab.training.common_checkpoint import read_common
from saclab.training.engine import Engine, EngineBuilder, EnvironmentStateError
from saclab.training.manifest import FORMAT as CHECKPOINT_FORMAT
from saclab.training.manifest import CheckpointError
from saclab.training.run_folder import FORMAT, read_config
from saclab.training.saved_state import files_in, read_state
from saclab.training.snapshot import Start, from_checkpoint, new_start


class Beginning(NamedTuple):
    """How a session begins with a run."""

    start: Start
    logs: dict[str, FileRecord] | None
    """What belongs of each log to the checkpoint; None for a new run."""
    notes: list[str]
    """What the user should know; the first says the update-to-data ratio."""


def find_beginnings(builder: EngineBuilder, folders: Sequence[Path], facts: dict[str, Any]) -> list[Beginning]:
    """Begin or find each run folder; where its run goes on.

    Args:
        builder: of the engine; the transitions of checkpoints go into its replay buffers.
        folders: the run folders, on which this process has the locks.
        facts: what may decide the results' last bits, from `machine_facts`.

    Raises:
        UserError: if a folder holds a run with other settings.
        CheckpointError: if there are checkpoints and none can be used.
    """
    layout = builder.layout
    begun = [begin_folder(folder, config, facts) for folder, config in zip(folders, builder.configs, strict=True)]
    notes = [[ratio_note(config)] for config in builder.configs]
    found: list[Checkpoint] = []
    if any(begun):
        found = read_common([folder / "checkpoints" for folder in folders], builder.read, [own.append for own in notes])
    if not found:
        return [
            Beginning(new_start(config, layout), None, own) for config, own in zip(builder.configs, notes, strict=True)
        ]
    return [
        continued(config, folder, layout, checkpoint, own, facts)
        for config, folder, checkpoint, own in zip(builder.configs, folders, found, notes, strict=True)
    ]


def begin_folder(folder: Path, config: Config, facts: dict[str, Any]) -> bool:
    """Write config.json; whether it was there, in which case it has to be that of the same run."""
    if (folder / "config.json").exists():
        require_same_config(folder, config)
        return True
    write_json(folder / "config.json", RunDescription(FORMAT, config.to_dict(), **facts))
    return False


def continued(
    config: Config, folder: Path, layout: RowLayout, checkpoint: Checkpoint, notes: list[str], facts: dict[str, Any]
) -> Beginning:
    """Go on from a checkpoint of this folder."""
    try:
        start = from_checkpoint(config, layout, checkpoint)
        logs, saved_facts = files_in(checkpoint.state), read_state(checkpoint.state).facts
    except CheckpointError as error:
        raise cannot_continue(folder, error) from error
    if start.restarting:
        notes.append(
            f"the exact state of {config.environment} cannot be captured: environments {start.restarting} "
            "started a new episode, so this run is not bit for bit what it would have been"
        )
    if checkpoint.format != CHECKPOINT_FORMAT:
        notes.append(
            f"the checkpoint has format {checkpoint.format}, of an earlier saclab: from here on the results differ in "
            "the last bits from what they would have been"
        )
    if saved_facts and (reason := other_simulation(saved_facts.versions, facts["versions"])):
        raise UserError(f"cannot continue {folder}: {reason}")
    notes += different_facts(msgspec.to_builtins(saved_facts), facts)
    return Beginning(start, logs, notes)


def build(builder: EngineBuilder, beginnings: Sequence[Beginning], folders: Sequence[Path]) -> Engine:
    """The engine; raises CheckpointError if what a checkpoint has of the environments does not fit them."""
    try:
        return builder.build([beginning.start for beginning in beginnings])
    except EnvironmentStateError as error:
        raise cannot_continue(folders[error.run], error) from error


def cannot_continue(folder: Path, error: CheckpointError) -> CheckpointError:
    return CheckpointError(
        f"cannot continue {folder}: {error}. If a checkpoint does not belong to this run or has been "
        f"changed, remove {folder / 'checkpoints'} to train from the start"
    )


def ratio_note(config: Config) -> str:
    training = config.training
    note = (
        f"{training.updates_per_interval} update(s) per {training.update_interval} environment step(s): "
        f"update-to-data ratio {training.update_to_data_ratio:g}"
    )
    if training.parallel_environments > 1:
        each = training.parallel_environments * training.update_to_data_ratio
        note += (
            f", kept with {training.parallel_environments} environments: {each:g} update(s) on average "
            "each time all of them have been stepped"
        )
    return note


def require_same_config(folder: Path, config: Config) -> None:
    """Refuse a folder that holds a run with other settings."""
    differences = read_config(folder).differences(config)
    if differences:
        listed = "; ".join(f"{name} is {there!r} there, {here!r} here" for name, (there, here) in differences.items())
        raise UserError(
            f"{folder} already holds a run with other settings ({listed}): give this one a name of its own with "
            "--name, or another place with --runs"
        )
