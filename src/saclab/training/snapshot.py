"""A run at one moment: what an engine gives for a checkpoint, and what an engine is built from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np

from saclab.algorithm.types import LearnerState
from saclab.config import Config
from saclab.replay import RowLayout
from saclab.training.captured import join_arrays, require_like, restore_generator, split_arrays
from saclab.training.checkpoint import Arrays, Checkpoint, Replay
from saclab.training.guide import guide_from
from saclab.training.learners import finite_arrays, initial_learner, learner_from
from saclab.training.manifest import CheckpointError
from saclab.training.run_state import RunState
from saclab.training.saved_state import Files, GeneratorState, MachineFacts, SavedState, read_state

EnvironmentStates = list[dict[str, Any] | None]
"""What `TrainingEnvironments.capture` gives."""


class Start(NamedTuple):
    """A run but for its replay buffer, before an engine steps it: new, or as a checkpoint has it."""

    run: RunState
    learner: LearnerState
    behaviour: np.ndarray | None = None
    """f32[P]: the behaviour parameters, where they are a round of updates behind."""
    environments: EnvironmentStates | None = None
    """None for those of a new run, whose first episodes begin."""

    @property
    def restarting(self) -> list[int]:
        """The environments that have to begin a new episode, as their state could not be captured."""
        return [index for index, state in enumerate(self.environments or ()) if state is None]


class Snapshot(NamedTuple):
    """A run as its engine has it. It is good until the engine takes its next step."""

    run: RunState
    """The state itself, not a copy; its window has the metrics of every update that was made."""
    learner: LearnerState
    behaviour: np.ndarray
    """f32[P]: the parameters that choose the actions: with acting_delay 1, those before the last round of updates."""
    observation: np.ndarray
    """f32[N, O]: what the environments show now."""
    replay: Replay


def new_start(config: Config, layout: RowLayout) -> Start:
    """A run before its first step."""
    return Start(RunState(config, layout), initial_learner(config, layout))


def to_checkpoint(
    snapshot: Snapshot,
    environments: EnvironmentStates,
    logs: Files | None = None,
    facts: Mapping[str, Any] | None = None,
) -> Checkpoint:
    """Everything but the transitions, which lie in `snapshot.replay`.

    Args:
        snapshot: the run.
        environments: the states of its environments.
        logs: what its logs and config.json are now.
        facts: of the machine, from `machine_facts`.

    Raises:
        NonFiniteError: if the run is not worth continuing.
    """
    run = snapshot.run
    learner = finite_arrays(snapshot.learner, run.counters.updates)
    environment_arrays, environment_states = split_arrays(environments)
    groups: dict[str, Arrays] = {
        "learner": learner,
        "environments": environment_arrays,
        "window": {"metrics": run.window_array()},
    }
    if run.best_actor is not None:
        groups["best"] = {"actor": run.best_actor}
    if run.config.training.acting_delay:
        groups["acting"] = {"actor": snapshot.behaviour}
    noise, groups["exploration"] = run.exploration.capture()
    groups["rewards"] = run.reward_scale.capture()
    groups["observations"] = run.observation_moments.capture()
    guide = None
    if run.guide is not None and run.exploring():
        guide, groups["guide"] = run.guide.capture()
    state = SavedState(
        run.counters, environment_states, msgspec.convert(noise, GeneratorState),
        msgspec.convert(run.sampling.bit_generator.state, GeneratorState), logs or {},
        None if facts is None else MachineFacts(**facts), run.prefilled, guide,
    )  # fmt: skip
    groups = {name: arrays for name, arrays in groups.items() if arrays}
    return Checkpoint(groups, msgspec.to_builtins(state), snapshot.replay.added)


def from_checkpoint(config: Config, layout: RowLayout, checkpoint: Checkpoint) -> Start:
    """The run that `to_checkpoint` has taken apart.

    Raises:
        CheckpointError: if it is not one of a run with this configuration.
    """
    groups, state = checkpoint.groups, read_state(checkpoint.state)
    example = initial_learner(config, layout)
    learner = learner_from(groups.get("learner", {}), example)
    behaviour = None
    if config.training.acting_delay:
        behaviour = require_like("acting", groups.get("acting", {}).get("actor"), np.asarray(example.actor.weights))
    run = RunState(config, layout)
    window = groups.get("window", {}).get("metrics", np.zeros(0))
    run.window = list(require_like("metrics", window, np.zeros((*window.shape[:1], len(run.metrics)), np.float32)))
    if "best" in groups:
        run.best_actor = require_like("best", groups["best"].get("actor"), np.asarray(example.actor.weights))
    run.counters = state.counters
    run.logged_updates = run.counters.updates - len(run.window)
    run.prefilled = state.prefilled
    if run.added != checkpoint.transitions:
        raise CheckpointError(f"the checkpoint has {run.added} steps and {checkpoint.transitions} transitions")
    if state.guide is not None:
        run.guide = guide_from(state.guide, groups.get("guide", {}), layout)
    run.exploration.restore(msgspec.to_builtins(state.exploration), groups.get("exploration", {}))
    run.reward_scale.restore(groups.get("rewards", {}))
    run.observation_moments.restore(groups.get("observations", {}))
    restore_generator("sampling", run.sampling, msgspec.to_builtins(state.sampling))
    like = np.zeros((config.training.parallel_environments, layout.observation_size), np.float32)
    environments = join_arrays(groups.get("environments", {}), state.environments, like)
    start = Start(run, learner, behaviour, environments)
    run.reward_scale.returns[start.restarting] = 0.0
    return start
