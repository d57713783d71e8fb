"""A run alone, in memory: its environments and its replay buffer in this process, one update per call into XLA."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.learner import make_learner
from saclab.algorithm.types import LearnerState
from saclab.config import AlgorithmSettings, Config
from saclab.environments.vector import EndedEpisode, TrainingEnvironments
from saclab.errors import NonFiniteError
from saclab.replay import ReplayBuffer, RowLayout, require_memory
from saclab.training import seeds
from saclab.training.course import Course
from saclab.training.evaluation import EvaluationEpisodes, Evaluator
from saclab.training.q_bias import QBias, critics_of, q_bias_at
from saclab.training.requests import Stopped


class Run(Course):
    """The state of a run. `step` is one step of every training environment and the updates that fall due."""

    def __init__(self, config: Config) -> None:
        """The state before the first step.

        Raises:
            UserError: if the environment cannot be trained on, or the replay buffer does not fit in memory.
        """
        super().__init__(config)
        training, algorithm = config.training, config.algorithm
        environment_seeds = seeds.integers(config.seed, "environments", training.parallel_environments)
        self.environments = TrainingEnvironments(config.environment, config.environment_arguments, environment_seeds)
        self.spec = self.environments.spec
        layout = RowLayout(self.spec.observation_size, self.spec.action_size)
        require_memory(training.replay_capacity, layout)
        self.replay = ReplayBuffer(training.replay_capacity, layout)
        self.evaluator = Evaluator(config.environment, config.environment_arguments)

        learner = make_learner(algorithm, self.spec.observation_size, self.spec.action_size)
        self.judged, self.policy = learner, learner.policy
        self.learner_state: LearnerState = compiled_init(algorithm, layout)(seeds.learner_key(config.seed))
        self.update = compiled_update(algorithm, layout)
        self._actor: np.ndarray | None = None
        self._actor_before: np.ndarray | None = None

    @property
    def actor(self) -> np.ndarray:
        """The policy's parameters f32[P] on the host, copied once per update."""
        if self._actor is None:
            self._actor = np.array(self.learner_state.actor)
        return self._actor

    @property
    def acting(self) -> np.ndarray:
        if self.config.training.acting_delay == 0 or self._actor_before is None:
            return self.actor
        return self._actor_before

    def step(self) -> list[EndedEpisode]:
        """Step every environment once, store the transitions, make the updates due; the episodes that ended."""
        try:
            transitions, ended = self.environments.step(self._next_action())
        except NonFiniteError:
            self.window_array()  # raises if an update broke first, and the environment only met what came of it
            raise
        self.replay.add(transitions)
        self.counters.steps += len(self.environments)
        updates_due = self.config.training.updates_due(self.counters.steps)
        if self.counters.updates < updates_due:
            self._actor_before = self.actor
        while self.counters.updates < updates_due:
            rows = self.replay.sample(self.sampling, self.config.algorithm.batch_size)
            self.learner_state, metrics = self.update(self.learner_state, rows)
            self.window.append(metrics)
            self.counters.updates += 1
            self._actor = None
        return ended

    def _next_action(self) -> np.ndarray:
        """f32[N, A] in [-1, 1]: uniform during the random steps, then a sample of the policy."""
        if self.exploring():
            return self.random_action()
        action: np.ndarray = self.policy.act(self.acting, self.environments.observation, self.action_noise())
        return action

    def evaluate(self, asked_to_stop: Callable[[], bool] = lambda: False) -> tuple[EvaluationEpisodes, bool]:
        """Test the policy as it is now; the episodes, and whether their mean return is the best so far.

        Raises:
            Stopped: when `asked_to_stop`; the run is as before, but that `evaluation_due` has been asked.
        """
        actor = self.actor

        def act(observation: np.ndarray) -> np.ndarray:
            if asked_to_stop():
                raise Stopped
            action: np.ndarray = self.policy.mode(actor, observation)
            return action

        episodes = self.evaluator.run(act, self.test_seeds())
        return episodes, self.enter_test(episodes)

    def q_bias(self) -> QBias | None:
        """How far the critics are from Monte-Carlo soft returns, as after the last test; None if not wanted."""
        count, number = self.config.training.q_bias_episodes, self.counters.evaluations
        if count == 0:
            return None
        state = self.learner_state
        critics = critics_of(self.config, self.judged, self.actor, np.array(state.critic), np.asarray(state.log_alpha))
        return q_bias_at(self.config, critics, self.evaluator.environments[0], self.spec, number)

    @property
    def observation(self) -> np.ndarray:
        return self.environments.observation

    def learner(self) -> LearnerState:
        return self.learner_state

    def take_learner(self, state: LearnerState, acting: np.ndarray | None) -> None:
        self.learner_state = jax.tree.map(jnp.asarray, state)
        self._actor, self._actor_before = None, acting

    def capture_environments(self) -> list[dict[str, Any] | None]:
        return self.environments.capture()

    def restore_environments(self, states: list[dict[str, Any] | None], new_seeds: list[int]) -> list[int]:
        return self.environments.restore(states, new_seeds)

    def close(self) -> None:
        self.environments.close()
        self.evaluator.close()


@lru_cache(maxsize=16)
def compiled_init(settings: AlgorithmSettings, layout: RowLayout) -> Callable[[np.ndarray], LearnerState]:
    """Key u32[2] -> the state before the first update, compiled once."""
    return jax.jit(make_learner(settings, layout.observation_size, layout.action_size).init)


@lru_cache(maxsize=16)
def compiled_update(
    settings: AlgorithmSettings, layout: RowLayout
) -> Callable[[LearnerState, np.ndarray], tuple[LearnerState, jax.Array]]:
    """(state, rows f32[B, width]) -> (state, metrics f32[M]), compiled once; the state given is used up."""
    learner = make_learner(settings, layout.observation_size, layout.action_size)

    def update(state: LearnerState, rows: jax.Array) -> tuple[LearnerState, jax.Array]:
        state, metrics = learner.update(state, layout.unpack(rows))
        return state, jnp.stack(metrics)

    return jax.jit(update, donate_argnums=0)
