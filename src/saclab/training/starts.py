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
from saclab.records import FileRecord, RunDescription, read_json
from saclab.replay import RowLayout
from saclab.training.checkpoint import Checkpoint
from saclab.training.common_checkpoint import read_common
from saclab.training.engine import Engine, EngineBuilder, EnvironmentStateError
from saclab.training.manifest import FORMAT as CHECKPOINT_FORMAT
from saclab.training.manifest import CheckpointError
from saclab.training.prefill import Prefill, begin_with, read_prefill
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
    layout, configs = builder.layout, builder.configs
    begun = [is_begun(folder, config) for folder, config in zip(folders, configs, strict=True)]
    notes = [[ratio_note(config), *early_end_notes(config)] for config in configs]
    found: list[Checkpoint] = []
    if any(begun):
        found = read_common([folder / "checkpoints" for folder in folders], builder.read, [own.append for own in notes])
    if not found:
        prefill = read_prefill(configs[0], builder.spec, layout)  # which the runs of an engine have in common
        for folder, config in zip(folders, configs, strict=True):
            begin_folder(folder, config, facts, prefill)
        return [begun_with(prefill, builder, run, own) for run, own in enumerate(notes)]
    return [
        continued(config, folder, layout, checkpoint, own, facts)
        for config, folder, checkpoint, own in zip(configs, folders, found, notes, strict=True)
    ]


def is_begun(folder: Path, config: Config) -> bool:
    """Whether there is a config.json, which has to be that of the same run."""
    if begun := (folder / "config.json").exists():
        require_same_config(folder, config)
    return begun


def begin_folder(folder: Path, config: Config, facts: dict[str, Any], prefill: Prefill | None) -> None:
    """Write config.json; if it is there, the run had no checkpoint yet, and has to begin with the same again."""
    path, record = folder / "config.json", None if prefill is None else prefill.record
    if not path.exists():
        write_json(path, RunDescription(FORMAT, config.to_dict(), **facts, prefill=record))
    elif (before := read_json(path, RunDescription).prefill) != record:
        raise UserError(
            f"{folder} has begun with another prefill {config.training.prefill!r}: it had {before or 'none'} then, and "
            f"has {record or 'none'} now: bring back what it was, or give this run a name of its own with --name"
        )


def begun_with(prefill: Prefill | None, builder: EngineBuilder, run: int, notes: list[str]) -> Beginning:
    """A run of a builder before its first step."""
    start = new_start(builder.configs[run], builder.layout)
    if prefill is not None:
        builder.fill(run, begin_with(prefill, start.run))
        notes += prefill.notes
    return Beginning(start, None, notes)


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


def early_end_notes(config: Config) -> list[str]:
    """A schedule over the planned updates is cut off where a limit of another kind ends the run."""
    training, by_share = config.training, [term for term in config.algorithm.scheduled_terms if not term.by_return]
    schedules = ["learning_rate_schedule"] * (config.algorithm.learning_rate_schedule != "constant")
    schedules += ["reward_schedule"] * bool(by_share)
    limits = [name for name in ("max_episodes", "patience_episodes") if getattr(training, name) is not None]
    if not schedules or not limits:
        return []
    flags = " ".join(f"--{name.replace('_', '-')} None" for name in limits)
    return [
        f"{' and '.join(schedules)}: over {config.planned_updates} planned updates, before which "
        f"{' or '.join(limits)} may end the run; without: {flags}"
    ]


def require_same_config(folder: Path, config: Config) -> None:
    """Refuse a folder that holds a run with other settings."""
    differences = read_config(folder).differences(config)
    if differences:
        listed = "; ".join(f"{name} is {there!r} there, {here!r} here" for name, (there, here) in differences.items())
        raise UserError(
            f"{folder} already holds a run with other settings ({listed}): give this one a name of its own with "
            "--name, or another place with --runs"
        )
