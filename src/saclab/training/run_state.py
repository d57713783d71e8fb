"""How far a run has come and what it draws from: plain data on the host, whoever steps the run."""

from __future__ import annotations

from typing import Any

import numpy as np

from saclab.algorithm.learner import metric_names
from saclab.config import Config
from saclab.environments.vector import EndedEpisode
from saclab.errors import NonFiniteError
from saclab.replay import RowLayout
from saclab.training import seeds
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.exploration import Exploration
from saclab.training.guide import Guide
from saclab.training.manifest import Moment
from saclab.training.observation_moments import ObservationMoments
from saclab.training.reward_scale import RewardScale
from saclab.training.reward_weights import reward_weights
from saclab.training.saved_state import Counters

RUNNING_AVERAGE_KEEP = 0.8  # the paper's running average: 0.8 old + 0.2 new
EVALUATE_FIRST = -1  # for `evaluation_slots`: an evaluation is due before the next step


class RunState:
    """A run's settings, counters, generators, open window of metrics and best policy."""

    def __init__(self, config: Config, layout: RowLayout) -> None:
        """The state before the first step."""
        self.config, self.layout = config, layout
        algorithm, environments = config.algorithm, config.training.parallel_environments
        self.exploration = Exploration(config.seed, environments, layout.action_size, algorithm.longest_noise)
        self.reward_scale = RewardScale(
            algorithm.reward_scaling, environments, algorithm.discount, algorithm.critic_bound
        )
        self.observation_moments = ObservationMoments(algorithm.observation_normalisation, layout.observation_size)
        self.metrics = metric_names(algorithm)
        """Names of what an update reports."""
        self.sampling = seeds.generator(config.seed, "replay")
        self.counters = Counters()
        self.prefilled = 0
        """Transitions that were in the replay buffer before the first step."""
        self.guide: Guide | None = None
        """Acts in the random steps, if there is one."""
        self.window: list[Any] = []
        """Metrics f32[M] of each update since the last line of metrics.jsonl, once the engine has delivered them."""
        self.logged_updates = 0
        """Updates made when the last line of metrics.jsonl was written."""
        self.best_actor: np.ndarray | None = None
        """f32[P]: the policy's parameters at the best evaluation."""

    # --- steps

    def exploring(self) -> bool:
        """Whether the next step is one of the random ones."""
        return self.counters.steps < self.config.training.random_steps

    def exploring_action(self, observation: np.ndarray) -> np.ndarray:
        """f32[N, A] in [-1, 1] for a random step from f32[N, O]: uniform, or a sample of the guide's policy."""
        if self.guide is None:
            return self.exploration.uniform_action()
        return self.guide.act(observation, self.exploration.noise())

    @property
    def added(self) -> int:
        """Transitions that have been put into the replay buffer."""
        return self.prefilled + self.counters.steps

    def restart_seeds(self) -> list[int]:
        """A seed for each environment that has to start anew at this step, never used before."""
        count = self.config.training.parallel_environments
        return seeds.integers(self.config.seed, "environments", count, self.counters.steps)

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

    @property
    def updates_left(self) -> int:
        """Updates that the steps so far make due and that have not been made: above 0, a round is under way."""
        return self.config.training.updates_due(self.counters.steps) - self.counters.updates

    # --- rewards

    def reward_weights(self) -> np.ndarray:
        """f32[T]: what the reward terms are weighed by in the round of updates that is under way, or in the next one.

        A schedule goes by the share of the planned updates that were made when the round began, and by the best
        evaluation until then: all updates between two steps have the same weights, whoever makes them.
        """
        planned = self.config.planned_updates or 1
        return reward_weights(self.config.algorithm, self._round_start / planned, self.counters.best_return)

    @property
    def _round_start(self) -> int:
        """Updates made before the round that is under way, or before the next one."""
        training, steps = self.config.training, self.counters.steps
        return training.updates_due(steps - training.parallel_environments if self.updates_left > 0 else steps)

    # --- evaluations

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

    def postpone_evaluation(self) -> None:
        """An evaluation was broken off: it comes first when the run goes on."""
        self.counters.evaluation_slots = EVALUATE_FIRST

    def moment(self) -> Moment:
        """Where the run stands, as its checkpoints are named."""
        counters, whole = self.counters, self.updates_left <= 0
        tested = counters.evaluation_slots != EVALUATE_FIRST
        return Moment(counters.steps, whole, 0 if whole else counters.updates, tested)

    def evaluation_seeds(self) -> list[int]:
        """One for each episode of the next evaluation."""
        count = self.config.training.evaluation_episodes
        return seeds.integers(self.config.seed, "evaluation", count, self.counters.evaluations)

    def enter_evaluation(self, episodes: EvaluationEpisodes, actor: np.ndarray) -> bool:
        """Take in an evaluation of the policy f32[P]; whether its mean return is the best so far."""
        counters = self.counters
        counters.evaluations += 1
        counters.evaluated_at_update = counters.updates
        counters.last_return = float(episodes.total_rewards.mean())
        best = counters.best_return is None or counters.last_return > counters.best_return
        if best:
            counters.best_return, counters.best_at_episode = counters.last_return, counters.episodes
            self.best_actor = actor
        return best

    # --- the end

    def finish_reason(self) -> str | None:
        """Why the run is at its end, or None if it is not."""
        counters = self.counters
        for name, limit in self.config.training.limits.items():
            if getattr(counters, name) >= limit:
                return f"max_{name} = {limit} reached"
        patience = self.config.training.patience_episodes
        if patience is not None and counters.episodes - counters.best_at_episode >= patience:
            return f"no better evaluation return for patience_episodes = {patience}"
        return None

    def fraction_done(self) -> float:
        """The share of the run that is done, by the nearest of its limits, patience aside."""
        limits = self.config.training.limits
        nearest: float = max(getattr(self.counters, name) / limit for name, limit in limits.items())
        return min(1.0, nearest)

    # --- the window of metrics

    @property
    def window_size(self) -> int:
        """Updates since the last line of metrics.jsonl, those that are not yet delivered counted in."""
        return self.counters.updates - self.logged_updates

    def window_is_full(self) -> bool:
        """Whether a line of metrics.jsonl is due."""
        return self.window_size >= self.config.training.log_interval

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

    def close_window(self) -> np.ndarray:
        """The window's metrics, as `window_array` gives them; a new window begins."""
        values = self.window_array()
        self.window, self.logged_updates = [], self.counters.updates
        return values
