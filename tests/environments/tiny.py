"""Environments small enough to know every number of: importing this module registers them with Gymnasium."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

TIME_LIMIT = 5


class Counting(gymnasium.Env):
    """Observes [episode, step, a random number]; the reward of step n is n. Only its time limit ends an episode.

    Args:
        terminate_at: the step that leads to a terminal state.
        low: lower bounds of the actions.
        high: upper bounds of the actions.
        broken_at: the step that gives `value` in place of its observation or reward.
        broken: "observation" or "reward".
        value: what is given there.
    """

    def __init__(
        self,
        terminate_at: int | None = None,
        low: Any = (-1.0,),
        high: Any = (1.0,),
        broken_at: int | None = None,
        broken: str = "observation",
        value: float = np.nan,
        render_mode: str | None = None,
    ) -> None:
        self.observation_space = Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = Box(np.array(low, np.float32), np.array(high, np.float32))
        self.terminate_at, self.broken_at, self.broken, self.value = terminate_at, broken_at, broken, value
        self.episode, self.count = 0, 0
        self.actions: list[np.ndarray] = []

    def observe(self) -> np.ndarray:
        return np.array([self.episode, self.count, self.np_random.uniform()])

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.episode, self.count = self.episode + 1, 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.actions.append(action)
        self.count += 1
        observation, reward = self.observe(), float(self.count)
        if self.count == self.broken_at:
            if self.broken == "reward":
                reward = self.value
            else:
                observation[1] = self.value
        return observation, reward, self.count == self.terminate_at, False, {}


class CapturableCounting(Counting):
    """The same, with the two methods by which saclab captures what it cannot look into."""

    def saclab_capture(self) -> dict[str, np.ndarray]:
        return {"counters": np.array([self.episode, self.count])}

    def saclab_restore(self, state: dict[str, np.ndarray]) -> None:
        self.episode, self.count = (int(value) for value in state["counters"])


class Constant(gymnasium.Env):
    """A reward of 2 at every step whatever is done; the first step is the last one if `terminal`."""

    def __init__(self, terminal: bool = False, render_mode: str | None = None) -> None:
        self.observation_space, self.action_space = Box(-1, 1, (1,)), Box(-1, 1, (1,))
        self.terminal = terminal

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.ones(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.ones(1, np.float32), 2.0, self.terminal, False, {}


class Fragile(Constant):
    """At step `broken_at` of an episode, some go wrong in the way that `how` says: those that drew a number below ½.

    Args:
        how: "nan" for a reward that is not a number, "raise" for an error, "exit" for the end of the process.
        broken_at: counted over all episodes.
    """

    def __init__(self, how: str = "nan", broken_at: int = 100, render_mode: str | None = None) -> None:
        super().__init__()
        self.how, self.broken_at, self.count, self.doomed = how, broken_at, 0, False

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        observation, information = super().reset(seed=seed)
        if seed is not None:
            self.doomed = self.np_random.uniform() < 0.5
        return observation, information

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        observation, reward, *rest = super().step(action)
        self.count += 1
        if self.doomed and self.count == self.broken_at:
            if self.how == "raise":
                raise RuntimeError("the wheels came off")
            if self.how == "exit":
                print("the process came off", file=sys.stderr, flush=True)
                os._exit(1)
            reward = np.nan
        return observation, reward, *rest

    def saclab_capture(self) -> dict[str, np.ndarray]:
        return {"counters": np.array([self.count, self.doomed])}

    def saclab_restore(self, state: dict[str, np.ndarray]) -> None:
        self.count, self.doomed = int(state["counters"][0]), bool(state["counters"][1])


class Signing(Constant):
    """It leaves a file in a folder when it is closed."""

    def __init__(self, folder: str, render_mode: str | None = None) -> None:
        super().__init__()
        self.folder = folder

    def close(self) -> None:
        (Path(self.folder) / f"closed-{os.getpid()}-{id(self)}").touch()


class Leaning(Constant):
    """One step long; going right and going left are two terms of a reward that is always 0."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        right = float(action[0])
        return np.ones(1, np.float32), 0.0, True, False, {"right": right, "left": -right}


class Reticent(Leaning):
    """It does not tell the terms of every step: not after `told` of them."""

    def __init__(self, told: int = 1, render_mode: str | None = None) -> None:
        super().__init__()
        self.told = told

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        *result, info = super().step(action)
        self.told -= 1
        return *result, info if self.told >= 0 else {}


class Odd(gymnasium.Env):
    """It has the spaces that saclab refuses."""

    def __init__(self, kind: str, render_mode: str | None = None) -> None:
        flat = Box(-1, 1, (2,))
        self.observation_space = {
            "dict observation": Dict({"image": flat, "speed": flat}),
            "square observation": Box(-1, 1, (2, 2)),
        }.get(kind, flat)
        self.action_space = {
            "discrete action": Discrete(3),
            "dict action": Dict({"left": flat}),
            "infinite action": Box(-np.inf, np.inf, (2,)),
            "half infinite action": Box(np.zeros(2), np.array([1, np.inf])),
        }.get(kind, flat)


gymnasium.register("Counting-v0", Counting, max_episode_steps=TIME_LIMIT)
gymnasium.register("CapturableCounting-v0", CapturableCounting, max_episode_steps=TIME_LIMIT)
gymnasium.register("Constant-v0", Constant, max_episode_steps=TIME_LIMIT)
gymnasium.register("Fragile-v0", Fragile, max_episode_steps=TIME_LIMIT)
gymnasium.register("Signing-v0", Signing, max_episode_steps=TIME_LIMIT)
gymnasium.register("Endless-v0", Constant)
gymnasium.register("Leaning-v0", Leaning, max_episode_steps=TIME_LIMIT)
gymnasium.register("Reticent-v0", Reticent, max_episode_steps=TIME_LIMIT)
gymnasium.register("Odd-v0", Odd)
