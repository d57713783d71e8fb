"""How far a run has come and what it needs to go on: the part that a run alone and one of a batch share."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from saclab.algorithm.learner import metric_names
from saclab.algorithm.types import LearnerState
from saclab.config import Config
from saclab.environments.make import EnvironmentSpec
from saclab.environments.vector import EndedEpisode
from saclab.errors import NonFiniteError
from saclab.training import seeds
from saclab.training.captured import join_arrays, part, plain_numbers, require_like, restore_generator, split_arrays
from saclab.training.checkpoint import Arrays, Checkpoint, CheckpointError
from saclab.training.evaluation import EvaluationEpisodes

RUNNING_AVERAGE_KEEP = 0.8  # the paper's running average: 0.8 old + 0.2 new


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


class Course(ABC):
    """The state of a run that does not depend on who steps its environments and makes its updates."""

    spec: EnvironmentSpec
    replay: Any
    """A ReplayBuffer, or what has its capacity, layout, added and size, and rows that can be indexed."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.exploration = seeds.generator(config.seed, "exploration")
        self.sampling = seeds.generator(config.seed, "replay")
        self.counters = Counters()
        self.metrics = metric_names(config.algorithm)
        self.window: list[Any] = []
        """Metrics f32[M] of the updates since the last line of metrics.jsonl."""
        self.best_actor: np.ndarray | None = None

    @property
    @abstractmethod
    def actor(self) -> np.ndarray:
        """The policy's parameters f32[P] on the host."""

    @property
    @abstractmethod
    def acting(self) -> np.ndarray:
        """The parameters f32[P] that choose the actions: with a delay, those before the last round of updates.

        Nothing has to wait then for the round, which XLA computes while the environments are stepped.
        """

    @property
    @abstractmethod
    def observation(self) -> np.ndarray:
        """f32[N, O]: what the environments show now."""

    @abstractmethod
    def learner(self) -> LearnerState:
        """The learner's state, of the structure that this run's own settings give it."""

    @abstractmethod
    def take_learner(self, state: LearnerState, acting: np.ndarray | None) -> None:
        """Continue from this state; `acting` f32[P] where the policy that acts is a round of updates behind."""

    @abstractmethod
    def capture_environments(self) -> list[dict[str, Any] | None]:
        """As `TrainingEnvironments.capture`."""

    @abstractmethod
    def restore_environments(self, states: list[dict[str, Any] | None], new_seeds: list[int]) -> list[int]:
        """As `TrainingEnvironments.restore`."""

    @property
    def window_size(self) -> int:
        """Updates since the last line of metrics.jsonl."""
        return len(self.window)

    def exploring(self) -> bool:
        """Whether the next step is one of the random ones."""
        return self.counters.steps < self.config.training.random_steps

    def random_action(self) -> np.ndarray:
        """f32[N, A], uniform in [-1, 1]."""
        return self.exploration.uniform(-1, 1, self._action_shape).astype(np.float32)

    def action_noise(self) -> np.ndarray:
        """f32[N, A], standard normal."""
        return self.exploration.standard_normal(self._action_shape, np.float32)

    @property
    def _action_shape(self) -> tuple[int, int]:
        return self.config.training.parallel_environments, self.spec.action_size

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

    def test_seeds(self) -> list[int]:
        """Of the next test's episodes."""
        count = self.config.training.evaluation_episodes
        return seeds.integers(self.config.seed, "evaluation", count, self.counters.evaluations)

    def enter_test(self, episodes: EvaluationEpisodes) -> bool:
        """Take in a test of the policy as it is now; whether its mean return is the best so far."""
        counters = self.counters
        counters.evaluations += 1
        counters.evaluated_at_update = counters.updates
        counters.last_return = float(episodes.total_rewards.mean())
        best = counters.best_return is None or counters.last_return > counters.best_return
        if best:
            counters.best_return, counters.best_at_episode = counters.last_return, counters.episodes
            self.best_actor = self.actor
        return best

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
            return np.zeros((0, len(self.metrics)), np.float32)
        values: np.ndarray = np.stack([np.asarray(metrics) for metrics in self.window])
        broken = ~np.isfinite(values)
        if broken.any():
            first = int(np.flatnonzero(broken.any(axis=1))[0])
            names = [name for name, bad in zip(self.metrics, broken[first], strict=True) if bad]
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
        learner = {name: np.asarray(leaf) for name, leaf in named_leaves(self.learner()).items()}
        for name, array in learner.items():
            zero_temperature = name == ".temperature.weights" and array == -np.inf
            if not (np.isfinite(array).all() or zero_temperature):
                raise NonFiniteError(f"after update {self.counters.updates} {name} is not finite")
        environment_arrays, environment_states = split_arrays(self.capture_environments())
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
        groups, state, _ = checkpoint
        self._restore_learner(groups)
        window = groups.get("window", {}).get("metrics", np.zeros(0))
        expected = np.zeros((*window.shape[:1], len(self.metrics)), np.float32)
        self.window = list(require_like("metrics", window, expected))
        if "best" in groups:
            self.best_actor = require_like("best", groups["best"].get("actor"), self.actor)
        self.counters = Counters(**plain_numbers(state.get("counters"), dataclasses.asdict(Counters())))
        if self.counters.steps != self.replay.added:
            raise CheckpointError(f"the checkpoint has {self.counters.steps} steps and {self.replay.added} transitions")
        restore_generator("exploration", self.exploration, state.get("exploration"))
        restore_generator("sampling", self.sampling, state.get("sampling"))
        return self._restore_environments(groups.get("environments", {}), part(state, "environments", list))

    def _restore_learner(self, groups: dict[str, Arrays]) -> None:
        saved, now = groups.get("learner", {}), self.learner()
        checked = [require_like(name, saved.get(name), np.asarray(leaf)) for name, leaf in named_leaves(now).items()]
        acting = None
        if self.config.training.acting_delay:
            acting = require_like("acting", groups.get("acting", {}).get("actor"), self.actor)
        self.take_learner(jax.tree.unflatten(jax.tree.structure(now), checked), acting)

    def _restore_environments(self, arrays: Arrays, rest: list[Any]) -> list[int]:
        environments = self.config.training.parallel_environments
        states = join_arrays(arrays, rest, np.zeros((environments, self.spec.observation_size), np.float32))
        new_seeds = seeds.integers(self.config.seed, "environments", len(states), self.counters.steps)
        try:
            return self.restore_environments(states, new_seeds)
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            raise CheckpointError(f"the checkpoint's state of the environments does not fit: {error}") from error


def named_leaves(tree: Any) -> dict[str, Any]:
    """The arrays of a pytree by their path, such as `.actor.moments.mu`."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
