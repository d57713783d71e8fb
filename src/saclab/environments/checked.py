"""An environment as the rest of saclab knows it: all that it gives is held against what it has declared.

Every step of a training goes through here, so the way of an environment that keeps its word is a short one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from saclab.environments.foreign import Calls, meant_for_saclab, signals_kept
from saclab.environments.make import make_with_spec
from saclab.environments.simulator import State, capture_state, restore_state
from saclab.errors import RunBroken, in_words

Step = tuple[np.ndarray, float, bool, bool, dict[str, Any]]
"""Observation [O] of real numbers, reward, terminated, truncated, info."""
NUMBERS = "fiub"
"""Kinds of NumPy's types that are real numbers."""


class CheckedEnvironment:
    """A Gymnasium environment that is anybody's code.

    Whatever its methods raise is a RunBroken with the environment's own traceback, and so is what is not what a
    Gymnasium environment gives.
    """

    def __init__(
        self,
        name: str,
        arguments: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        wrappers: Sequence[str] = (),
    ) -> None:
        """Make it, inside its wrappers.

        Raises:
            UserError: if it cannot be made or trained on.
        """
        self.name = name
        self.calls = Calls(name)
        self.environment, self.spec = make_with_spec(self.calls, name, arguments, render_mode, wrappers)
        self.shape = (self.spec.observation_size,)

    def reset(self, seed: int | None) -> np.ndarray:
        """Start an episode: the first observation [O], as `step` gives it."""
        with signals_kept():
            given = self.calls("reset", self.environment.reset, seed=seed)
        if not isinstance(given, tuple) or len(given) != 2:
            self.refuse("reset", f"it returned {type(given).__name__}", "a pair (observation, info)")
        return self._observation("reset", given[0])

    def step(self, action: np.ndarray) -> Step:
        """Take a step with an action within the environment's bounds.

        Returns:
            The observation may be an array that the environment writes its next one into: who keeps it copies it.
        """
        given = self.calls("step", self.environment.step, action)
        if not isinstance(given, tuple) or len(given) != 5:
            what = f"{len(given)} values" if isinstance(given, tuple) else type(given).__name__
            self.refuse("step", f"it returned {what}", "(observation, reward, terminated, truncated, info)")
        seen, reward, ends, cut, info = given
        if type(seen) is not np.ndarray or seen.shape != self.shape or seen.dtype.char not in "df":
            seen = self._observation("step", seen)
        if type(reward) is not float:
            reward = float(reward) if isinstance(reward, float) else self._reward(reward)
        if ends is not True and ends is not False:
            ends = self._flag("terminated", ends)
        if cut is not True and cut is not False:
            cut = self._flag("truncated", cut)
        if not isinstance(info, dict):
            self.refuse("step", f"its info is {type(info).__name__}", "a dict")
        return seen, reward, ends, cut, info

    def capture(self) -> State | None:
        """The exact state of its episode; None if it cannot be captured."""
        state: State | None = self.calls("saclab_capture", capture_state, self.environment)
        if state is not None and not is_named_arrays(state["physics"]):
            self.refuse("saclab_capture", "it returned something else", "a dict of names and arrays of numbers")
        return state

    def restore(self, state: State) -> None:
        """Continue an episode from `capture` in an environment that has been reset once.

        Raises:
            KeyError, TypeError, ValueError or OverflowError: if it is no state of this kind of environment.
        """
        try:
            self.calls.run("saclab_restore", restore_state, self.environment, state)
        except (KeyError, OverflowError, TypeError, ValueError):
            raise
        except BaseException as error:
            if meant_for_saclab(error):
                raise
            raise self.calls.raised("saclab_restore", error) from error

    def render(self) -> Any:
        """What it draws."""
        return self.calls("render", self.environment.render)

    def close(self) -> RunBroken | None:
        """Close it; what went wrong then, which harms no result."""
        try:
            with signals_kept():
                self.calls("close", self.environment.close)
        except RunBroken as error:
            return error
        return None

    def refuse(self, call: str, what: str, expected: str) -> NoReturn:
        raise RunBroken(
            f"environment {self.name} breaks its own word in {call}: {what}, and {expected} is due: mend it there"
        )

    def _observation(self, call: str, given: Any) -> np.ndarray:
        try:
            seen: np.ndarray = np.asarray(given)
        except Exception as error:
            self.refuse(call, f"its observation is no array ({in_words(error)})", "an array of real numbers")
        if seen.shape != self.shape:
            declared = f"shape {self.shape}, as its observation space says,"
            self.refuse(call, f"its observation has shape {seen.shape}", declared)
        if seen.dtype.kind not in NUMBERS or np.ma.is_masked(given):
            masked = " with masked entries" if np.ma.is_masked(given) else ""
            self.refuse(call, f"its observation has type {seen.dtype}{masked}", "an array of real numbers")
        return seen

    def _reward(self, given: Any) -> float:
        try:
            kind = np.asarray(given).dtype.kind
            if np.ndim(given) == 0 and kind in NUMBERS + "O":
                return float(given)
        except Exception:
            kind = "O"
        shape = np.shape(given) if kind in NUMBERS else ()
        what = f"has shape {shape}" if shape else f"is {shortly(given)}"
        self.refuse("step", f"its reward {what}", "a single number")

    def _flag(self, name: str, given: Any) -> bool:
        if type(given) in (np.bool_, int) and given in (0, 1):
            return bool(given)
        self.refuse("step", f"its {name} is {shortly(given)}", "True or False")


def is_named_arrays(given: Any) -> bool:
    """Whether it can be kept in a checkpoint."""
    return isinstance(given, dict) and all(
        isinstance(name, str) and isinstance(array, np.ndarray) and array.dtype.kind in NUMBERS and array.itemsize <= 8
        for name, array in given.items()
    )


def shortly(given: Any) -> str:
    """A value as one short line."""
    try:
        said = repr(given)
    except Exception:
        said = f"a {type(given).__name__}"
    return " ".join(said[:200].split())
