"""The plain values of a checkpoint: one schema, for writing and for reading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from saclab.records import Count, FileRecord, Flag
from saclab.training.manifest import CheckpointError

Whole = Annotated[int, Meta(ge=-1, lt=2**53)]
"""A number of something, or -1."""
Files = Mapping[str, Count | FileRecord]
"""The logs and config.json; an earlier saclab recorded the lengths of the logs only."""


@dataclass
class Counters:
    """Where a run stands, in plain values."""

    steps: Count = 0
    """Environment steps, over all environments."""
    updates: Count = 0
    episodes: Count = 0
    """Training episodes that ended after the random steps."""
    running_average: float | None = None
    """Average of the training episodes' returns, recent ones weighing most."""
    evaluations: Count = 0
    evaluation_slots: Whole = 0
    """Multiples of the evaluation interval that were reached."""
    evaluated_at_update: Whole = -1
    best_return: float | None = None
    best_at_episode: Count = 0
    last_return: float | None = None
    seconds: float = 0.0
    """Wall-clock time."""


class Words(Struct):
    """Two numbers of 128 bits, as NumPy's PCG64 has them."""

    state: int
    inc: int


class GeneratorState(Struct):
    """`bit_generator.state` of a generator of `seeds.generator`."""

    bit_generator: Literal["PCG64"]
    state: Words
    has_uint32: Flag
    uinteger: Annotated[int, Meta(ge=0, lt=2**32)]


class EnvironmentState(Struct):
    """What `capture_state` gives of an environment beside its arrays, and its episode so far."""

    elapsed_steps: list[Count]
    """The steps that each time limit has counted."""
    generator: dict[str, Any]
    """`bit_generator.state` of whatever generator it has."""
    total_reward: float
    length: Count


class MachineFacts(Struct):
    """What `machine_facts` gave."""

    versions: dict[str, str]
    machine: dict[str, str | int | float | bool | None]


class SavedState(Struct):
    """`state` of a checkpoint's manifest."""

    counters: Counters
    environments: list[EnvironmentState | None]
    """None where an environment cannot be captured."""
    exploration: GeneratorState
    sampling: GeneratorState
    logs: Files = {}
    facts: MachineFacts | None = None
    prefilled: Count = 0
    """Transitions that were in the replay buffer before the first step."""
    guide: dict[str, Any] | None = None
    """AlgorithmSettings of the policy that acts in the random steps, as long as they last, if there is one."""


def read_state(state: Mapping[str, Any]) -> SavedState:
    """The state in a manifest; raises CheckpointError with the place that does not fit."""
    found: SavedState = fitting(state, SavedState, "state")
    return found


def files_in(state: Mapping[str, Any]) -> dict[str, FileRecord]:
    """What a checkpoint's state records of files. Raises CheckpointError."""
    found: Files = fitting(state.get("logs"), Files, "entry 'logs'")
    return {name: FileRecord(entry) if isinstance(entry, int) else entry for name, entry in found.items()}


def fitting(values: object, schema: Any, what: str) -> Any:
    try:
        return msgspec.convert(values, schema)
    except msgspec.ValidationError as error:
        raise CheckpointError(f"the checkpoint's {what} is not what saclab writes: {error}") from error
