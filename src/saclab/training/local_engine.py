"""The engine of a run alone: its environments and replay buffer in this process, one update per call into XLA."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from saclab.algorithm.types import Context
from saclab.config import Config
from saclab.environments.vector import TrainingEnvironments
from saclab.errors import RunBroken
from saclab.memory import require_memory
from saclab.replay import ReplayBuffer, Windows, layout_of
from saclab.settings import structure
from saclab.training import seeds
from saclab.training.checkpoint import Checkpoint, read_checkpoint
from saclab.training.engine import NOTHING_HAPPENED, Broken, EnvironmentStateError, StepResult, never, spec_of
from saclab.training.evaluation import EvaluationEpisodes, Evaluator
from saclab.training.learners import compiled_update, learner_of, numbers_of, on_device
from saclab.training.q_bias import QBias, critics_of, q_bias_at
from saclab.training.requests import Stopped
from saclab.training.snapshot import EnvironmentStates, Snapshot, Start, new_start

IN_FLIGHT = 2
"""Updates that XLA is asked for at once at most: a stop has to wait for all of them; with one it would run dry."""


class LocalBuilder:
    """An `EngineBuilder` of a run alone."""

    slots = 0

    def __init__(self, config: Config) -> None:
        """Make room for its replay buffer.

        Raises:
            UserError: if the environment cannot be trained on, or the run does not fit in memory.
        """
        self.configs = [config]
        self.spec = spec_of(config)
        self.layout = layout_of(self.spec, config.algorithm)
        require_memory(config, self.layout)
        self.replay = ReplayBuffer(config.training.replay_capacity, self.layout)

    def read(self, run: int, path: Path) -> Checkpoint:
        return read_checkpoint(path, self.replay)

    def fill(self, run: int, rows: np.ndarray) -> None:
        self.replay.add_rows(rows)

    def build(self, starts: Sequence[Start]) -> LocalEngine:
        return LocalEngine(starts[0], self.replay)


class LocalEngine:
    """An `Engine` of one run. `step` is one step of every training environment and the updates that fall due."""

    def __init__(self, start: Start, replay: ReplayBuffer) -> None:
        """Go on from `start`, whose transitions are in the replay buffer.

        Raises:
            EnvironmentStateError: if the environments' states cannot be restored.
        """
        self.run, self.replay = start.run, replay
        self.runs = [start.run]
        config = start.run.config
        self.environments = restored_environments(start)
        self.spec = self.environments.spec
        self.evaluator = Evaluator(
            config.environment, config.environment_arguments, config.training.wrappers, config.algorithm.terms_of_reward
        )
        self.learner = learner_of(config.algorithm, replay.layout)
        self.policy = self.learner.policy
        self.update = compiled_update(structure(config.algorithm), replay.layout)
        self.numbers = on_device(numbers_of(config, replay.layout))
        run = self.run
        self.context = on_device(
            Context(np.int32(0), run.reward_weights(), run.reward_scale.value, run.observation_moments.value)
        )
        self.learner_state = on_device(start.learner)
        self._actor: np.ndarray | None = None
        self._actor_before = start.behaviour

    @classmethod
    def new(cls, config: Config) -> LocalEngine:
        """The engine of a run before its first step."""
        builder = LocalBuilder(config)
        return builder.build([new_start(config, builder.layout)])

    def step(self, should_pause: Callable[[], bool] = never) -> StepResult:
        run, counters = self.run, self.run.counters
        try:
            transitions, ended = self.environments.step(self._next_action())
        except RunBroken as error:
            return StepResult({}, {0: Broken(error, self.snapshot(0))})
        self.replay.add(transitions)
        if run.reward_scale.active:
            last = np.isin(np.arange(len(self.environments)), [episode.environment for episode in ended])
            run.reward_scale.enter(transitions.reward_terms @ run.reward_weights(), last)
            self.context = self.context._replace(reward_scale=run.reward_scale.value)
        if run.observation_moments.active:
            run.observation_moments.enter(transitions.observation)
            self.context = self.context._replace(observation_moments=run.observation_moments.value)
        counters.steps += len(self.environments)
        if run.updates_left:
            self._actor_before = self.actor(0)
            self.make_updates(should_pause)
        return StepResult({0: ended}, {}) if ended else NOTHING_HAPPENED

    def make_updates(self, should_pause: Callable[[], bool] = never) -> None:
        run, counters = self.run, self.run.counters
        if run.config.algorithm.reward_schedule:
            self.context = self.context._replace(reward_weights=run.reward_weights())
        for _ in range(run.updates_left):
            rows = self._sample()
            context = self.context._replace(step=np.int32(counters.updates))
            self.learner_state, metrics = self.update(self.numbers, self.learner_state, rows, context)
            run.window.append(metrics)
            counters.updates += 1
            self._actor = None
            jax.block_until_ready(run.window[-IN_FLIGHT : 1 - IN_FLIGHT])  # type: ignore[no-untyped-call]
            if should_pause():
                return

    def _sample(self) -> np.ndarray:
        """What an update learns from: rows f32[B, width], or windows of several."""
        settings, run = self.run.config.algorithm, self.run
        if settings.n_step == 1:
            return self.replay.sample(run.sampling, settings.batch_size)
        windows = Windows(self.replay.layout, settings.n_step, len(self.environments))
        return self.replay.sample_windows(run.sampling, settings.batch_size, windows)

    def _next_action(self) -> np.ndarray:
        """f32[N, A] in [-1, 1]: uniform or a guide's during the random steps, then a sample of the policy."""
        if self.run.exploring():
            return self.run.exploring_action(self.environments.observation)
        noise = self.run.exploration.noise()
        action: np.ndarray = self.policy.act(self.behaviour, self.environments.observation, noise)
        return action

    def actor(self, run: int) -> np.ndarray:
        """The policy's parameters f32[P] on the host, copied once per update."""
        if self._actor is None:
            self._actor = np.array(self.learner_state.actor.weights)
        return self._actor

    @property
    def behaviour(self) -> np.ndarray:
        """The parameters f32[P] that choose the actions: with a delay, those before the last round of updates.

        Nothing has to wait then for the round, which XLA computes while the environments are stepped.
        """
        if self.run.config.training.acting_delay == 0 or self._actor_before is None:
            return self.actor(0)
        return self._actor_before

    def deliver_metrics(self) -> None:
        """They are in the window already."""

    def evaluate(
        self, runs: Sequence[int], should_stop: Callable[[], bool] = never
    ) -> Mapping[int, EvaluationEpisodes | RunBroken]:
        actor = self.actor(0)

        def act(observation: np.ndarray) -> np.ndarray:
            if should_stop():
                raise Stopped
            action: np.ndarray = self.policy.mode(actor, observation)
            return action

        try:
            return {0: self.evaluator.run(act, self.run.evaluation_seeds())}
        except RunBroken as error:
            return {0: error}

    def measure_q_bias(
        self, runs: Sequence[int], should_stop: Callable[[], bool] = never
    ) -> Mapping[int, QBias | RunBroken]:
        config, state = self.run.config, self.learner_state
        if not runs or config.training.q_bias_episodes == 0:
            return {}
        critics = critics_of(
            config,
            self.learner,
            self.actor(0),
            np.array(state.critic.weights),
            np.asarray(state.temperature.weights),
            float(self.run.reward_scale.value),
            self.run.reward_weights().tolist(),
        )
        try:
            environment, number = self.evaluator.environments[0], self.run.counters.evaluations + 1
            return {0: q_bias_at(config, critics, environment, number, should_stop)}
        except RunBroken as error:
            return {0: error}

    def snapshot(self, run: int) -> Snapshot:
        return Snapshot(self.run, self.learner_state, self.behaviour, self.environments.observation, self.replay)

    def capture_environments(self, run: int) -> EnvironmentStates:
        return self.environments.capture()

    def drop(self, run: int) -> None:
        """Nothing is left to go on with."""

    def close(self) -> list[tuple[int, RunBroken]]:
        return [(0, error) for error in (*self.environments.close(), *self.evaluator.close())]


def restored_environments(start: Start) -> TrainingEnvironments:
    """The training environments of a run, in their first episodes or in those of the checkpoint."""
    config = start.run.config
    first_seeds = seeds.integers(config.seed, "environments", config.training.parallel_environments)
    environments = TrainingEnvironments(
        config.environment, config.environment_arguments, first_seeds, config.algorithm.terms_of_reward,
        config.training.wrappers,
    )  # fmt: skip
    if start.environments is not None:
        try:
            environments.restore(start.environments, start.run.restart_seeds())
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            environments.close()
            raise EnvironmentStateError(0, error) from error
    return environments
