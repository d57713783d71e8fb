"""Step several training environments in turn. Truncation and the start of the next episode are solved here, once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from saclab.environments.checked import CheckedEnvironment
from saclab.environments.reward_terms import split_within_run
from saclab.errors import NonFiniteError, RunBroken

LARGEST = float(np.finfo(np.float32).max)


class Transitions(NamedTuple):
    """One step of each environment. N: environments."""

    observation: np.ndarray
    """f32[N, O]."""
    action: np.ndarray
    """f32[N, A] in [-1, 1]."""
    reward_terms: np.ndarray
    """f32[N, T]: what the reward is the weighted sum of; T = 1 is the reward itself."""
    next_observation: np.ndarray
    """f32[N, O]: what the action led to, also where the episode ended; never the next episode's first one."""
    terminated: np.ndarray
    """bool[N]: the episode ended in a terminal state. A time limit (truncation) is not one."""


class EndedEpisode(NamedTuple):
    environment: int
    total_reward: float
    length: int
    terminated: bool


class TrainingEnvironments:
    """N environments, each always inside an episode: the one after an end starts at once."""

    def __init__(
        self,
        environment: str,
        arguments: Mapping[str, Any],
        seeds: list[int],
        reward_terms: Sequence[str] = (),
        wrappers: Sequence[str] = (),
    ) -> None:
        """Make one environment per seed and start its first episode.

        Args:
            environment: Gymnasium id.
            arguments: its keyword arguments.
            seeds: of the first episodes.
            reward_terms: names in the `info` of a step; what they leave of the reward is the last term.
            wrappers: names, as `wrapped` takes them.
        """
        self.reward_terms = tuple(reward_terms)
        self.name = environment
        self.environments = [CheckedEnvironment(environment, arguments, wrappers=wrappers) for _ in seeds]
        self.spec = self.environments[0].spec
        self.observation = np.zeros((len(seeds), self.spec.observation_size), np.float32)
        """f32[N, O]: the current observations."""
        self.total_rewards = np.zeros(len(seeds), np.float64)
        self.lengths = np.zeros(len(seeds), np.int64)
        for index, seed in enumerate(seeds):
            self._start_episode(index, seed=seed)

    def __len__(self) -> int:
        return len(self.environments)

    def step(self, action: np.ndarray) -> tuple[Transitions, list[EndedEpisode]]:
        """Apply f32[N, A] in [-1, 1].

        Raises:
            NonFiniteError: if an environment gives an observation or a reward that is not finite.
            RunBroken: if one breaks its word or raises an error.
        """
        observation = self.observation.copy()
        reward_terms = np.zeros((len(self), len(self.reward_terms) + 1), np.float32)
        next_observation = np.empty_like(observation)
        terminated = np.zeros(len(self), bool)
        ended = []
        scaled = self.spec.scale_action(action)
        for index, environment in enumerate(self.environments):
            seen, reward, ends, cut, info = environment.step(scaled[index])
            self._require_finite(index, seen, reward, scaled[index])
            next_observation[index], reward_terms[index, -1], terminated[index] = seen, reward, ends
            if self.reward_terms:
                reward_terms[index] = split_within_run(self.name, reward, info, self.reward_terms)
            self.total_rewards[index] += reward
            self.lengths[index] += 1
            if ends or cut:
                ended.append(self._ended(index, ends))
                self._start_episode(index)
            else:
                self.observation[index] = seen
        return Transitions(observation, action, reward_terms, next_observation, terminated), ended

    def close(self) -> list[RunBroken]:
        """Close them; what went wrong then, which harms no result."""
        return [error for environment in self.environments if (error := environment.close())]

    def capture(self) -> list[dict[str, Any] | None]:
        """The exact state of each environment and its episode so far; None where it cannot be captured."""
        states: list[dict[str, Any] | None] = []
        for index, environment in enumerate(self.environments):
            state = environment.capture()
            if state is not None:
                state["observation"] = self.observation[index].copy()
                state["total_reward"] = float(self.total_rewards[index])
                state["length"] = int(self.lengths[index])
            states.append(state)
        return states

    def restore(self, states: list[dict[str, Any] | None], seeds: list[int]) -> list[int]:
        """Continue from `capture`; the environments whose state could not be captured and that started anew.

        Those start an episode from their entry of `seeds`, which should not have been used before.
        """
        restarted = []
        for index, (environment, state) in enumerate(zip(self.environments, states, strict=True)):
            if state is None:
                restarted.append(index)
                self._start_episode(index, seed=seeds[index])
                continue
            environment.restore(state)
            self.observation[index] = state["observation"]
            self.total_rewards[index] = state["total_reward"]
            self.lengths[index] = state["length"]
        return restarted

    def _ended(self, index: int, terminated: bool) -> EndedEpisode:
        return EndedEpisode(index, float(self.total_rewards[index]), int(self.lengths[index]), terminated)

    def _start_episode(self, index: int, seed: int | None = None) -> None:
        self.total_rewards[index], self.lengths[index] = 0.0, 0
        seen = self.environments[index].reset(seed)
        self._require_finite(index, seen, 0.0, np.zeros(0, np.float32))
        self.observation[index] = seen

    def _require_finite(self, index: int, seen: np.ndarray, given: float, action: np.ndarray) -> None:
        """Refuse an observation and a reward that 32 bits cannot hold."""
        if abs(given) <= LARGEST and np.abs(seen).max(initial=0) <= LARGEST:
            return
        with np.errstate(over="ignore"):
            observation, reward = seen.astype(np.float32), float(np.float32(given))
        broken = np.flatnonzero(~np.isfinite(observation)).tolist()
        what = f"observation entries {broken[:10]}" if broken else f"reward {reward}"
        raise NonFiniteError(
            f"environment {self.name} number {index} gave a value that is not finite ({what}) in step "
            f"{int(self.lengths[index]) + 1} of an episode: check the environment, or wrap it so that it ends the "
            "episode before it diverges",
            {"action": action, "next_observation": observation.copy(), "reward": np.array(reward)},
        )
