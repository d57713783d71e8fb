"""Data sets as users record them, with Minari's own collector."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import minari
import numpy as np


class Unnamed(gymnasium.Wrapper):
    """An environment that does not say which it is: one registered by its class cannot be written down."""

    spec = None


def record(
    name: str,
    environment: gymnasium.Env,
    steps: int,
    action: Callable[[int], Any] | None = None,
    episode: int | None = None,
) -> Any:
    """A data set of so many steps, of actions drawn at random or those given; it may end within an episode.

    Args:
        name: its id.
        environment: what is recorded.
        steps: of all episodes.
        action: step -> action.
        episode: steps after which an episode is left, if it does not end before.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it wants to know author, description, …
        named = environment.spec is None or not callable(environment.spec.entry_point)
        collector = minari.DataCollector(environment if named else Unnamed(environment))
        collector.action_space.seed(0)
        collector.reset(seed=0)
        length = 0
        for step in range(steps):
            taken = collector.action_space.sample() if action is None else action(step)
            _, _, terminated, truncated, _ = collector.step(taken)
            length += 1
            if step + 1 < steps and (terminated or truncated or length == episode):
                collector.reset(seed=step)
                length = 0
        made = collector.create_dataset(name)
        collector.close()
    return made


def by_hand(data: Any) -> list[tuple[np.ndarray, np.ndarray, float, np.ndarray, bool]]:
    """Each transition of a data set of flat spaces, in the environment's units, as its episodes tell them."""
    return [
        (e.observations[step], e.actions[step], float(e.rewards[step]), e.observations[step + 1],
         bool(e.terminations[step]))
        for e in data.iterate_episodes() for step in range(len(e.rewards))
    ]  # fmt: skip
