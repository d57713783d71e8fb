"""Environments that raise anything anywhere, die, hang, or change the process: importing this registers them."""

from __future__ import annotations

import os
import random
import signal
import time
import warnings
from itertools import count
from typing import Any

import gymnasium
import numpy as np

from .tiny import Constant


class MuteError(RuntimeError):
    def __str__(self) -> str:
        raise ValueError("no word")


class Rogue(Constant):
    """A fair environment but for one call of one instance.

    Args:
        where: the method.
        what: happens there, a key of HAPPENINGS.
        at: which of its calls, counted over all episodes.
        instance: which of the instances made since `made` was set back: of a run alone the first is looked at, the
            second trained in, the third evaluated in.
    """

    made = count(1)

    def __init__(self, where: str = "", what: str = "error", at: int = 1, instance: int = 0, render_mode: Any = None):
        super().__init__()
        self.where, self.what, self.at = where, what, at
        self.acts = instance in (0, next(Rogue.made))
        self.calls: dict[str, int] = {}
        self.perhaps("__init__")

    def perhaps(self, where: str) -> None:
        self.calls[where] = self.calls.get(where, 0) + 1
        if self.acts and where == self.where and self.calls[where] == self.at:
            HAPPENINGS[self.what]()

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self.perhaps("reset")
        return super().reset(seed=seed)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.perhaps("step")
        return super().step(action)

    def render(self) -> np.ndarray:
        self.perhaps("render")
        return np.zeros((64, 64, 3), np.uint8)

    def close(self) -> None:
        self.perhaps("close")

    def saclab_capture(self) -> dict[str, np.ndarray]:
        self.perhaps("saclab_capture")
        return {"calls": np.zeros(1)}

    def saclab_restore(self, state: dict[str, np.ndarray]) -> None:
        self.perhaps("saclab_restore")


def fail(error: BaseException) -> None:
    raise error


def recurse() -> None:
    recurse()


HAPPENINGS: dict[str, Any] = {
    "error": lambda: fail(RuntimeError("the wheels\x1b[2J came\noff")),
    "type": lambda: fail(TypeError("of no use")),
    "mute": lambda: fail(MuteError()),
    "endless": lambda: fail(RuntimeError("word " * 10**6)),
    "surrogate": lambda: fail(RuntimeError("\udc80")),
    "exit": lambda: fail(SystemExit(3)),
    "interrupt": lambda: fail(KeyboardInterrupt()),
    "generator": lambda: fail(GeneratorExit()),
    "recursion": recurse,
    "death": lambda: os._exit(7),
    "hang": lambda: time.sleep(10**6),
}


class Meddling(Constant):
    """It changes all that a process has, and prints much."""

    def __init__(self, folder: str = "", render_mode: Any = None) -> None:
        super().__init__()
        self.folder = folder

    def meddle(self) -> None:
        if not self.folder:
            return
        os.chdir(self.folder)
        os.environ.update(NPROC="7", XLA_FLAGS="--no_such_flag", HOME=self.folder)
        np.seterr(all="raise")
        random.seed(0)
        np.random.seed(0)
        warnings.simplefilter("error")
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
            signal.signal(number, signal.SIG_IGN)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self.meddle()
        if self.folder:
            print("x" * 100_000, flush=True)
            os.write(1, b"\xff\xfe no text\n")
            self.close()
        return super().reset(seed=seed)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self.folder:
            np.seterr(all="raise")
            action[:] = 5.0
        observation, *rest = super().step(action)
        return observation * 1e-30, *rest


gymnasium.register("Rogue-v0", Rogue, max_episode_steps=5)
gymnasium.register("Dying-v0", Rogue, max_episode_steps=5, kwargs={"where": "step", "what": "death", "at": 50})
gymnasium.register("Hanging-v0", Rogue, max_episode_steps=5, kwargs={"where": "step", "what": "hang", "at": 50})
gymnasium.register("Meddling-v0", Meddling, max_episode_steps=5)
