"""The experience that a run begins with: a Minari data set, the replay buffer or the policy of another run.

It is read once, before the run's first step; from then on all of it is in the run's own checkpoints.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from saclab.config import Config
from saclab.environments.checked import CheckedEnvironment
from saclab.environments.data_set import read_data_set
from saclab.environments.make import EnvironmentSpec
from saclab.errors import SettingError, UserError, in_words, require
from saclab.files import same_directory
from saclab.records import Prefilled
from saclab.replay import ReplayBuffer, RowLayout
from saclab.trained_policy import load_policy, read_description
from saclab.training.checkpoint import read_checkpoint
from saclab.training.guide import Guide
from saclab.training.manifest import CheckpointError, newest_first, read_manifest
from saclab.training.run_folder import read_config
from saclab.training.run_state import RunState

FLATTENING = ("FlattenObservation", "FlattenAction")
PART = 8192
"""Rows whose observations, or bytes, are taken in at once."""


class Prefill(NamedTuple):
    """What a run begins with. M: transitions, 0 where it is a policy."""

    rows: np.ndarray
    """f32[M, width]: packed transitions, those of an episode in turn."""
    guide: Guide | None
    record: Prefilled
    notes: list[str]
    """What the user should know."""


class Experience(NamedTuple):
    """Transitions that were read."""

    rows: np.ndarray
    """f32[M, width], as in Prefill."""
    total: int
    """Transitions that there are."""
    notes: list[str]


def read_prefill(config: Config, spec: EnvironmentSpec, layout: RowLayout) -> Prefill | None:
    """What a run begins with; None if it begins with nothing.

    Args:
        config: of the run.
        spec: of its environment.
        layout: of its transitions.

    Raises:
        UserError: if it cannot be read, or does not fit the run.
    """
    if config.training.prefill_source is None:
        return None
    kind, name = config.training.prefill_source
    try:
        return read_source(config, spec, layout, kind, name)
    except OSError as error:
        raise SettingError(
            "prefill", config.training.prefill, f"it cannot be read ({error.strerror or in_words(error)})"
        ) from error


def read_source(config: Config, spec: EnvironmentSpec, layout: RowLayout, kind: str, name: str) -> Prefill:
    """What `read_prefill` gives for a source of this kind; raises OSError too."""
    if kind == "policy":
        return read_guide(config, spec, layout, Path(name))
    if kind == "minari":
        experience = read_minari(config, layout, name)
    else:
        experience = read_replay(config, spec, layout, Path(name))
    count, random_steps = len(experience.rows), config.training.random_steps
    batch = config.algorithm.batch_size
    require(
        batch <= count + random_steps, "batch_size", batch,
        f"the first update would draw from {count} transitions of {config.training.prefill} and {random_steps} of the "
        f"run: use --batch-size {count + random_steps} or less, or --random-steps {batch - count} or more",
    )  # fmt: skip
    record = Prefilled(count, digest_of(experience.rows))
    newest = f"the newest {count} of {experience.total}" if experience.total > count else f"{count}"
    told = f"begins with {newest} transition(s) of {config.training.prefill}, SHA-256 {record.sha256[:12]}…"
    return Prefill(experience.rows, None, record, [told, *experience.notes])


def digest_of(rows: np.ndarray) -> str:
    """The SHA-256 of rows as little-endian numbers, a part at a time: a large buffer is not copied for it."""
    digest = hashlib.sha256()
    for first in range(0, len(rows), PART):
        digest.update(np.ascontiguousarray(rows[first : first + PART], "<f4").data)
    return digest.hexdigest()


def begin_with(prefill: Prefill, run: RunState) -> np.ndarray:
    """Let a run that has not taken a step begin with it; the rows f32[M, width] as they go into its replay buffer.

    Whatever is learned of all transitions, such as moments of observations, is learned of these as of played ones.
    """
    rows, environments = prefill.rows, run.config.training.parallel_environments
    run.prefilled, run.guide = len(rows), prefill.guide
    if run.observation_moments.active:
        for first in range(0, len(rows), PART):
            run.observation_moments.enter(np.asarray(run.layout.unpack(rows[first : first + PART]).observation))
    if run.reward_scale.active and len(rows):
        batch = run.layout.unpack(rows)
        left = ~np.all(batch.observation[1:] == batch.next_observation[:-1], axis=1)
        ended = np.asarray(batch.terminated > 0) | np.append(left, False)
        rewards = np.asarray(batch.reward_terms @ run.reward_weights())
        run.reward_scale.enter_stream(rewards, ended)
    if environments == 1:
        return rows
    in_place: np.ndarray = rows[side_by_side(len(rows), environments)]
    return in_place


def side_by_side(count: int, environments: int) -> np.ndarray:
    """i64[count]: which row lies where, if as many environments had been stepped together.

    Then the next row of an episode lies as many places on as there are environments, as `replay.Windows` has it.
    """
    places = np.zeros(count, np.int64)
    for environment, part in enumerate(np.array_split(np.arange(count), environments)):
        places[environment::environments] = part
    return places


def most_transitions(config: Config) -> int:
    """How many transitions are taken at most."""
    training = config.training
    return min(training.replay_capacity, training.prefill_transitions or training.replay_capacity)


# --- Minari


@same_directory()
def read_minari(config: Config, layout: RowLayout, name: str) -> Experience:
    """The newest transitions of a Minari data set; raises UserError if it does not fit."""
    training = config.training
    require(
        not config.algorithm.terms_of_reward, "prefill", training.prefill,
        "a Minari data set tells rewards and not their terms: leave out --reward-terms",
    )  # fmt: skip
    environment = CheckedEnvironment(config.environment, config.environment_arguments, wrappers=training.wrappers)
    try:
        found = read_data_set(name, environment, most_transitions(config))
    finally:
        environment.close()
    notes = list(found.notes)
    if others := [wrapper for wrapper in training.wrappers if wrapper not in FLATTENING]:
        notes.append(f"the data set {name} is taken as it is: nothing in it has gone through {', '.join(others)}")
    return Experience(layout.pack(found.transitions), found.total, notes)


# --- another run


def read_replay(config: Config, spec: EnvironmentSpec, layout: RowLayout, folder: Path) -> Experience:
    """The newest transitions in the newest whole checkpoint of another run, which is only read.

    Raises:
        UserError: if it is no run's folder, has no checkpoint, or its transitions do not fit.
    """
    other = read_config(folder)
    theirs, mine = other.algorithm.terms_of_reward, config.algorithm.terms_of_reward
    require(
        theirs == mine, "prefill", config.training.prefill, f"its reward_terms are {theirs}, and this run's are {mine}"
    )
    problems: list[str] = []
    for path in newest_first(folder / "checkpoints"):
        try:
            buffer = replay_in(path, other, layout, config)
            break
        except (CheckpointError, OSError) as error:
            problems.append(f"{path.name}: {error}")
    else:
        reason = "; ".join(problems) or "it has none: let that run go on until it saves"
        raise SettingError("prefill", config.training.prefill, f"no checkpoint can be used ({reason})")
    numbers = np.arange(buffer.added - buffer.size, buffer.added)[-most_transitions(config) :]
    streams = [numbers[first :: other.training.parallel_environments]
               for first in range(other.training.parallel_environments)]  # fmt: skip
    rows = buffer.rows[np.concatenate(streams) % buffer.capacity]
    require(len(rows) > 0, "prefill", config.training.prefill, "its replay buffer is empty: that run took no step yet")
    for row in np.flatnonzero(~np.isfinite(rows).all(axis=1)):
        number = np.concatenate(streams)[row]
        raise SettingError("prefill", config.training.prefill, f"a number of transition {number} is not finite")
    notes = other_task(config, other.environment, other.environment_arguments, other.training.wrappers)
    return Experience(rows, buffer.size, [*notes, *bounds_notes(config, spec, folder)])


def bounds_notes(config: Config, spec: EnvironmentSpec, folder: Path) -> list[str]:
    """A note if another run does not tell the bounds of its actions, which its replay buffer holds in [-1, 1].

    Raises:
        SettingError: if its policy tells other ones than this run's.
    """
    try:
        there = load_policy(folder / "best").spec
    except UserError:
        name = config.training.prefill
        return [f"whether the actions of {name} have this run's bounds is not known: it has no readable policy"]
    if there.action_size == spec.action_size:
        require_same_bounds(config, spec, there)
    return []


def require_same_bounds(config: Config, spec: EnvironmentSpec, there: EnvironmentSpec) -> None:
    """Refuse another run whose actions have other bounds, `there`: they would do other things."""
    require(
        np.array_equal(there.action_low, spec.action_low) and np.array_equal(there.action_high, spec.action_high),
        "prefill", config.training.prefill,
        f"its actions lie between {there.action_low} and {there.action_high}, and this run's between "
        f"{spec.action_low} and {spec.action_high}",
    )  # fmt: skip


def replay_in(path: Path, other: Config, layout: RowLayout, config: Config) -> ReplayBuffer:
    """The replay buffer in a checkpoint of another run.

    Raises:
        CheckpointError: if it is not whole.
        SettingError: if it is not of transitions like this run's, or takes more memory than there is.
    """
    columns = read_manifest(path).replay.columns
    require(
        columns in (None, layout.columns), "prefill", config.training.prefill,
        f"the columns of its transitions are {columns}, and this run's are {layout.columns}",
    )  # fmt: skip
    try:
        buffer = ReplayBuffer(other.training.replay_capacity, layout)
    except (MemoryError, ValueError) as error:
        way_out = f"there is no memory for its replay_capacity of {other.training.replay_capacity}"
        raise SettingError("prefill", config.training.prefill, way_out) from error
    read_checkpoint(path, buffer)
    return buffer


def read_guide(config: Config, spec: EnvironmentSpec, layout: RowLayout, folder: Path) -> Prefill:
    """The best policy of another run; raises UserError if there is none or it does not fit."""
    policy, description = load_policy(folder), read_description(folder)
    there, prefill = policy.spec, config.training.prefill
    for name, sizes in {"observations": "observation_size", "actions": "action_size"}.items():
        here, other = getattr(spec, sizes), getattr(there, sizes)
        require(here == other, "prefill", prefill, f"its {name} have {other} numbers, and this run's have {here}")
    require_same_bounds(config, spec, there)
    guide = Guide(policy.settings, layout, policy.parameters)
    told = f"the policy of {folder} acts in the first {config.training.random_steps} steps"
    notes = other_task(config, description.environment, description.environment_arguments, description.wrappers)
    return Prefill(np.zeros((0, layout.width), np.float32), guide, Prefilled(0, guide.sha256), [told, *notes])


def other_task(config: Config, environment: str, arguments: dict[str, Any], wrappers: Sequence[str]) -> list[str]:
    """A note if another run has been trained on something else; it may fit all the same."""
    here = config.environment, config.environment_arguments, tuple(config.training.wrappers)
    there = environment, arguments, tuple(wrappers)
    names = "environment", "environment_arguments", "wrappers"
    unlike = [f"{name} {b!r}, and here {a!r}" for name, a, b in zip(names, here, there, strict=True) if a != b]
    return [f"{config.training.prefill} has {'; '.join(unlike)}"] if unlike else []
