"""What steps environments and computes updates: the interface that the loop, saving and resuming are written for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from saclab.config import Config
from saclab.environments.checked import CheckedEnvironment
from saclab.environments.make import EnvironmentSpec
from saclab.environments.reward_terms import split_reward
from saclab.environments.vector import EndedEpisode
from saclab.errors import RunBroken
from saclab.files import same_directory
from saclab.replay import RowLayout
from saclab.training.checkpoint import Checkpoint
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.manifest import CheckpointError
from saclab.training.q_bias import QBias
from saclab.training.run_state import RunState
from saclab.training.snapshot import EnvironmentStates, Snapshot, Start, new_start


class Broken(NamedTuple):
    """A run that cannot go on."""

    error: RunBroken
    snapshot: Snapshot
    """The run before the step that broke it; to be looked at before anything else is asked of the engine."""


class StepResult(NamedTuple):
    ended: Mapping[int, Sequence[EndedEpisode]]
    """Run -> the episodes that ended; runs without one may be missing."""
    broken: Mapping[int, Broken]
    """Runs whose environment broke. They have to be dropped."""


NOTHING_HAPPENED = StepResult({}, {})


def never() -> bool:
    return False


class Engine(Protocol):
    """R runs that take their steps together. A run is named by its place in `runs`."""

    @property
    def runs(self) -> Sequence[RunState]:
        """What belongs to each run on the host; the engine counts steps and updates there, the loop all else."""

    def step(self, should_pause: Callable[[], bool] = never) -> StepResult:
        """Step every environment once, store the transitions, make the updates due.

        Updates may be left to make, as `RunState.updates_left` says: when `should_pause`, or if a run broke. What
        broke has to be dropped and `make_updates` called then, before the next step.
        """

    def make_updates(self, should_pause: Callable[[], bool] = never) -> None:
        """Make the updates that are left of this round, until `should_pause`, which is asked within seconds."""

    def deliver_metrics(self) -> None:
        """Bring the metrics of all updates that were made into the runs' windows."""

    def evaluate(
        self, runs: Sequence[int], should_stop: Callable[[], bool]
    ) -> Mapping[int, EvaluationEpisodes | RunBroken]:
        """Evaluate the policies of these runs as they are now: the episodes of each, or what broke in them.

        Raises:
            Stopped: when `should_stop`; the runs are as before.
        """

    def measure_q_bias(
        self, runs: Sequence[int], should_stop: Callable[[], bool] = never
    ) -> Mapping[int, QBias | RunBroken]:
        """How far the critics are from Monte-Carlo soft returns, as part of the next evaluation, or what broke.

        Runs that do not want it are missing.

        Raises:
            Stopped: when `should_stop`; the runs are as before.
        """

    def actor(self, run: int) -> np.ndarray:
        """The policy's parameters f32[P] on the host, after every update that was made."""

    def snapshot(self, run: int) -> Snapshot:
        """The run as it is now, after every update that was made."""

    def capture_environments(self, run: int) -> EnvironmentStates:
        """The exact state of each environment of a run; None where it cannot be captured."""

    def drop(self, run: int) -> None:
        """Go on without a run that has finished or failed."""

    def close(self) -> Sequence[tuple[int, RunBroken]]:
        """Close the environments; run -> what went wrong then, which harms no result."""


class EngineBuilder(Protocol):
    """What an engine will be made of: all that can be refused is refused before a run folder is touched.

    It builds one engine, with the replay buffers into which it has read checkpoints, or filled them, before.
    """

    @property
    def configs(self) -> Sequence[Config]: ...

    @property
    def spec(self) -> EnvironmentSpec: ...

    @property
    def layout(self) -> RowLayout: ...

    @property
    def slots(self) -> int:
        """Runs for which the compiled program has room; 0 for a run alone."""

    def read(self, run: int, path: Path) -> Checkpoint:
        """Read a checkpoint of a run, its transitions into the run's replay buffer.

        Raises:
            CheckpointError: if it is not whole.
        """

    def fill(self, run: int, rows: np.ndarray) -> None:
        """Put packed transitions f32[M, width] into the replay buffer of a run, which is empty."""

    def build(self, starts: Sequence[Start]) -> Engine:
        """The engine of these runs.

        Raises:
            EnvironmentStateError: if the environments' states cannot be restored.
        """


class EnvironmentStateError(CheckpointError):
    """The environments' states in a checkpoint do not fit the environments."""

    def __init__(self, run: int, reason: object) -> None:
        super().__init__(f"the checkpoint's state of the environments does not fit: {reason}")
        self.run = run


@same_directory()
def spec_of(config: Config) -> EnvironmentSpec:
    """What a learner must know of a run's environment; raises UserError if it cannot be trained on."""
    environment = CheckedEnvironment(
        config.environment, config.environment_arguments, wrappers=config.training.wrappers
    )
    try:
        if names := config.algorithm.terms_of_reward:
            environment.reset(seed=0)
            _, reward, _, _, info = environment.step(
                environment.spec.scale_action(np.zeros(environment.spec.action_size))
            )
            scheduled = set(names) - set(config.algorithm.reward_terms)
            split_reward(config.environment, reward, info, names, scheduled)
        return environment.spec
    finally:
        environment.close()


def build_new(builder: EngineBuilder) -> Engine:
    """The engine of new runs."""
    return builder.build([new_start(config, builder.layout) for config in builder.configs])
