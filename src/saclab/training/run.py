"""A run in memory: everything that it is, how it takes a step, and how it is captured and restored."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.learner import make_learner
from saclab.algorithm.types import LearnerState, Metrics
from saclab.config import AlgorithmSettings, Config
from saclab.environments.vector import EndedEpisode, TrainingEnvironments
from saclab.errors import NonFiniteError
from saclab.replay import ReplayBuffer, RowLayout, require_memory
from saclab.training import seeds
from saclab.training.captured import (
    join_arrays,
    part,
    plain_numbers,
    require_like,
    restore_generator,
    split_arrays,
)
from saclab.training.checkpoint import Arrays, Checkpoint, CheckpointError
from saclab.training.evaluation import EvaluationEpisodes, Evaluator
from saclab.training.q_bias import Critics, QBias, measure_q_bias

RUNNING_AVERAGE_KEEP = 0.8  # the paper's running average: 0.8 old + 0.2 new


class Stopped(Exception):  # noqa: N818 - no error
    """Asked to stop in the middle of a test, whose episodes so far count for nothing."""


@dataclass
class Counters:
    """Where a run stands, in plain values."""

    steps: int = 0
    """Environment steps, over all environments."""
    updates: int = 0
    episodes: int = 0
    """Training episodes that ended after the random steps."""
    running_average: float | None = None
    """Of the training episodes' returns."""
    evaluations: int = 0
    evaluation_slots: int = 0
    """Multiples of the evaluation interval that were reached."""
    evaluated_at_update: int = -1
    best_return: float | None = None
    best_at_episode: int = 0
    last_return: float | None = None
    seconds: float = 0.0
    """Wall-clock time."""


class Run:
    """The state of a run. `step` is one step of every training environment and the updates that fall due."""

    def __init__(self, config: Config) -> None:
        """The state before the first step.

        Raises:
            UserError: if the environment cannot be trained on, or the replay buffer does not fit in memory.
        """
        self.config = config
        training, algorithm = config.training, config.algorithm
        environment_seeds = seeds.integers(config.seed, "environments", training.parallel_environments)
        self.environments = TrainingEnvironments(config.environment, config.environment_arguments, environment_seeds)
        self.spec = self.environments.spec
        layout = RowLayout(self.spec.observation_size, self.spec.action_size)
        require_memory(training.replay_capacity, layout)
        self.replay = ReplayBuffer(training.replay_capacity, layout)
        self.evaluator = Evaluator(config.environment, config.environment_arguments)

        learner = make_learner(algorithm, self.spec.observation_size, self.spec.action_size)
        self.policy, self.q_network = learner.policy, learner.q_network
        self.learner_state: LearnerState = compiled_init(algorithm, layout)(seeds.learner_key(config.seed))
        self.update = compiled_update(algorithm, layout)
        self.exploration = seeds.generator(config.seed, "exploration")
        self.sampling = seeds.generator(config.seed, "replay")

        self.counters = Counters()
        self.window: list[Any] = []
        """Metrics f32[M] of the updates since the last line of metrics.jsonl."""
        self.best_actor: np.ndarray | None = None
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
        """The parameters f32[P] that choose the actions: with a delay, those before the last round of updates.

        Nothing has to wait then for the round, which XLA computes while the environments are stepped.
        """
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
        shape = (len(self.environments), self.spec.action_size)
        if self.counters.steps < self.config.training.random_steps:
            return self.exploration.uniform(-1, 1, shape).astype(np.float32)
        noise = self.exploration.standard_normal(shape, np.float32)
        action: np.ndarray = self.policy.act(self.acting, self.environments.observation, noise)
        return action

    def count_episode(self, episode: EndedEpisode) -> int:
        """Enter an ended episode; its number, 0 if it ended within the random steps."""
        counters = self.counters
        if counters.steps <= self.config.training.random_steps:
            return 0
        counters.episodes += 1
        if counters.running_average is None:
            counters.running_average = episode.total_reward
        kept = RUNNING_AVERAGE_KEEP * counters.running_average
        counters.running_average = kept + (1 - RUNNING_AVERAGE_KEEP) * episode.total_reward
        return counters.episodes

    def evaluation_due(self) -> bool:
        """Whether another multiple of the evaluation interval has been reached since the last time."""
        training, counters = self.config.training, self.counters
        if training.evaluation_interval_episodes is not None:
            slots = counters.episodes // training.evaluation_interval_episodes
        else:
            assert training.evaluation_interval_steps is not None
            slots = counters.steps // training.evaluation_interval_steps
        due = slots > counters.evaluation_slots
        counters.evaluation_slots = slots
        return due

    def evaluate(self, asked_to_stop: Callable[[], bool] = lambda: False) -> tuple[EvaluationEpisodes, bool]:
        """Test the policy as it is now; the episodes, and whether their mean return is the best so far.

        Raises:
            Stopped: when `asked_to_stop`; the run is as before, but that `evaluation_due` has been asked.
        """
        counters, actor = self.counters, self.actor
        test_seeds = seeds.integers(
            self.config.seed, "evaluation", self.config.training.evaluation_episodes, counters.evaluations
        )

        def act(observation: np.ndarray) -> np.ndarray:
            if asked_to_stop():
                raise Stopped
            action: np.ndarray = self.policy.mode(actor, observation)
            return action

        episodes = self.evaluator.run(act, test_seeds)
        counters.evaluations += 1
        counters.evaluated_at_update = counters.updates
        counters.last_return = float(episodes.total_rewards.mean())
        best = counters.best_return is None or counters.last_return > counters.best_return
        if best:
            counters.best_return, counters.best_at_episode = counters.last_return, counters.episodes
            self.best_actor = actor
        return episodes, best

    def q_bias(self) -> QBias | None:
        """How far the critics are from Monte-Carlo soft returns, as after the last test; None if not wanted."""
        count, number = self.config.training.q_bias_episodes, self.counters.evaluations
        if count == 0:
            return None
        critics = Critics(
            self.policy, self.actor, self.q_network, np.array(self.learner_state.critic),
            float(np.exp(np.asarray(self.learner_state.log_alpha))), self.config.algorithm.discount,
        )  # fmt: skip
        return measure_q_bias(
            critics, self.evaluator.environments[0], self.spec,
            seeds.integers(self.config.seed, "q_bias", count, number),
            seeds.generator(self.config.seed, "q_bias", number),
        )  # fmt: skip

    def finish_reason(self) -> str | None:
        """Why the run is at its end, or None if it is not."""
        training, counters = self.config.training, self.counters
        for name, done in (("steps", counters.steps), ("updates", counters.updates), ("episodes", counters.episodes)):
            limit = getattr(training, f"max_{name}")
            if limit is not None and done >= limit:
                return f"max_{name} = {limit} reached"
        patience = training.patience_episodes
        if patience is not None and counters.episodes - counters.best_at_episode >= patience:
            return f"no better test return for patience_episodes = {patience}"
        return None

    def fraction_done(self) -> float:
        """By the nearest of the limits, patience aside."""
        training, counters = self.config.training, self.counters
        shares = [
            done / limit
            for done, limit in (
                (counters.steps, training.max_steps),
                (counters.updates, training.max_updates),
                (counters.episodes, training.max_episodes),
            )
            if limit is not None
        ]
        return min(1.0, max(shares))

    def window_array(self) -> np.ndarray:
        """The window's metrics f32[updates, M].

        Raises:
            NonFiniteError: names the first update and the metrics that are not finite.
        """
        if not self.window:
            return np.zeros((0, len(Metrics._fields)), np.float32)
        values: np.ndarray = np.asarray(jnp.stack(self.window))
        broken = ~np.isfinite(values)
        if broken.any():
            first = int(np.flatnonzero(broken.any(axis=1))[0])
            names = [name for name, bad in zip(Metrics._fields, broken[first], strict=True) if bad]
            raise NonFiniteError(
                f"update {self.counters.updates - len(values) + first + 1} gave a value that is not finite in "
                f"{', '.join(names)}: lower the learning rates, or look at the scale of the environment's rewards"
            )
        return values

    def capture(self) -> Checkpoint:
        """Everything but the replay buffer, which the checkpoint takes from `self.replay`.

        Raises:
            NonFiniteError: if it is not worth continuing from.
        """
        learner = {name: np.asarray(leaf) for name, leaf in named_leaves(self.learner_state).items()}
        for name, array in learner.items():
            zero_temperature = name == ".log_alpha" and array == -np.inf
            if not (np.isfinite(array).all() or zero_temperature):
                raise NonFiniteError(f"after update {self.counters.updates} {name} is not finite")
        environment_arrays, environment_states = split_arrays(self.environments.capture())
        groups: dict[str, Arrays] = {
            "learner": learner,
            "environments": environment_arrays,
            "window": {"metrics": self.window_array()},
        }
        if self.best_actor is not None:
            groups["best"] = {"actor": self.best_actor}
        if self.config.training.acting_delay:
            groups["acting"] = {"actor": self.acting}
        state = {
            "counters": dataclasses.asdict(self.counters),
            "environments": environment_states,
            "exploration": self.exploration.bit_generator.state,
            "sampling": self.sampling.bit_generator.state,
        }
        return Checkpoint(groups, state)

    def restore(self, checkpoint: Checkpoint) -> list[int]:
        """Continue from `capture`; the environments whose state could not be captured and that started anew.

        Raises:
            CheckpointError: if it is not one of a run with this configuration.
        """
        groups, state = checkpoint
        saved = groups.get("learner", {})
        leaves, structure = jax.tree.flatten(self.learner_state)
        names = named_leaves(self.learner_state)
        checked = [
            require_like(name, saved.get(name), np.asarray(leaf)) for name, leaf in zip(names, leaves, strict=True)
        ]
        self.learner_state = jax.tree.unflatten(structure, [jnp.asarray(array) for array in checked])
        self._actor = None
        window = groups.get("window", {}).get("metrics", np.zeros(0))
        expected = np.zeros((*window.shape[:1], len(Metrics._fields)), np.float32)
        self.window = list(require_like("metrics", window, expected))
        if self.config.training.acting_delay:
            self._actor_before = require_like("acting", groups.get("acting", {}).get("actor"), self.actor)
        if "best" in groups:
            self.best_actor = require_like("best", groups["best"].get("actor"), self.actor)
        self.counters = Counters(**plain_numbers(state.get("counters"), dataclasses.asdict(Counters())))
        if self.counters.steps != self.replay.added:
            raise CheckpointError(f"the checkpoint has {self.counters.steps} steps and {self.replay.added} transitions")
        restore_generator("exploration", self.exploration, state.get("exploration"))
        restore_generator("sampling", self.sampling, state.get("sampling"))
        return self._restore_environments(groups.get("environments", {}), part(state, "environments", list))

    def _restore_environments(self, arrays: Arrays, rest: list[Any]) -> list[int]:
        states = join_arrays(arrays, rest, self.environments.observation)
        new_seeds = seeds.integers(self.config.seed, "environments", len(states), self.counters.steps)
        try:
            return self.environments.restore(states, new_seeds)
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            raise CheckpointError(f"the checkpoint's state of the environments does not fit: {error}") from error

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


def named_leaves(tree: Any) -> dict[str, Any]:
    """The arrays of a pytree by their path, such as `.optimizers.actor[0].mu`."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
