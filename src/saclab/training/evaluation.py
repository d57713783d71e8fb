"""Evaluation episodes of the deterministic policy, stepped side by side with one policy call per step."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from saclab.environments.checked import CheckedEnvironment
from saclab.environments.reward_terms import split_within_run
from saclab.environments.watch import log
from saclab.errors import NonFiniteError, RunBroken

LONG_EPISODE = 100_000
"""Steps of an evaluation episode after which it is told of: it may never end."""
LONG_EPISODE_TOLD = (
    "an evaluation episode of {name} has made {steps} steps and goes on: if it has no end, give it a "
    """time limit, such as --environment-arguments '{{"max_episode_steps": 1000}}'"""
)


class EvaluationEpisodes(NamedTuple):
    total_rewards: np.ndarray
    """f64[episodes]."""
    lengths: np.ndarray
    """i64[episodes]."""
    term_returns: np.ndarray
    """f64[episodes, T]: the sums of the reward terms as the environment tells them; T = 1 is the return itself."""


class Evaluator:
    """Environments of its own: an evaluation leaves training as it was."""

    def __init__(
        self,
        environment: str,
        arguments: Mapping[str, Any],
        wrappers: Sequence[str] = (),
        reward_terms: Sequence[str] = (),
    ) -> None:
        self.make = partial(CheckedEnvironment, environment, arguments, wrappers=wrappers)
        self.name, self.environments, self.reward_terms = environment, [self.make()], tuple(reward_terms)
        self.spec = self.environments[0].spec

    @np.errstate(over="ignore")  # what is beyond 32 bits is refused as not finite
    def run(self, act: Callable[[np.ndarray], np.ndarray], seeds: Sequence[int]) -> EvaluationEpisodes:
        """One episode per seed; `act` takes observations f32[n, O] and gives actions f32[n, A] in [-1, 1].

        Raises:
            NonFiniteError: if an environment gives an observation, a reward or a term of it that is not finite.
            RunBroken: if one breaks its word or raises an error.
        """
        while len(self.environments) < len(seeds):
            self.environments.append(self.make())
        observation = np.zeros((len(seeds), self.spec.observation_size), np.float32)
        for index, seed in enumerate(seeds):
            observation[index] = self.environments[index].reset(seed)
        total_rewards, lengths = np.zeros(len(seeds)), np.zeros(len(seeds), np.int64)
        term_returns = np.zeros((len(seeds), len(self.reward_terms) + 1))
        self._require_finite(observation, total_rewards)
        active = list(range(len(seeds)))
        for step in itertools.count(1):
            if not active:
                break
            if step == LONG_EPISODE:
                log.warning(LONG_EPISODE_TOLD.format(name=self.name, steps=f"{LONG_EPISODE:,}"))
            actions = self.spec.scale_action(act(observation[active]))
            going_on = []
            for index, action in zip(active, actions, strict=True):
                seen, reward, terminated, truncated, info = self.environments[index].step(action)
                observation[index] = seen
                total_rewards[index] += reward
                term_returns[index] += split_within_run(self.name, reward, info, self.reward_terms)
                lengths[index] += 1
                if not (terminated or truncated):
                    going_on.append(index)
            active = going_on
            self._require_finite(observation, total_rewards)
        return EvaluationEpisodes(total_rewards, lengths, term_returns)

    def _require_finite(self, observation: np.ndarray, total_rewards: np.ndarray) -> None:
        finite = np.isfinite(observation).all(axis=1) & np.isfinite(total_rewards)
        if not finite.all():
            episodes = np.flatnonzero(~finite).tolist()
            raise NonFiniteError(
                f"evaluation episodes {episodes} of {self.name} gave an observation or a reward that is not finite: "
                "check the environment, or wrap it so that it ends the episode before it diverges"
            )

    def close(self) -> list[RunBroken]:
        """Close the environments; what went wrong then, which harms no result."""
        return [error for environment in self.environments if (error := environment.close())]
