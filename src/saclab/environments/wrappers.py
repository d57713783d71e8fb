"""Wrappers that a run puts around its environment, by their names."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from saclab.errors import SettingError, UserError, in_words, traceback_of, unknown_name

Environment = gymnasium.Env[Any, Any]


class FlattenAction(gymnasium.ActionWrapper[Any, np.ndarray, np.ndarray]):
    """Actions of a Box of any shape as a Box of one dimension; Gymnasium has such a wrapper for observations only."""

    saclab_stateless = True

    def __init__(self, environment: Environment) -> None:
        super().__init__(environment)
        inner = environment.action_space
        if not isinstance(inner, Box):
            raise TypeError(f"its action space is {inner}, and only a Box can be flattened")
        self.shape = inner.shape
        self.action_space = Box(inner.low.ravel(), inner.high.ravel(), dtype=inner.dtype.type)

    def action(self, action: np.ndarray) -> np.ndarray:
        return action.reshape(self.shape)


OWN = {"FlattenAction": FlattenAction}
BETTER = {
    "NormalizeObservation": "use --observation-normalisation running: evaluations and the policy share its moments",
    "NormalizeReward": "use --reward-scaling deviation: stored rewards then have today's scale",
}
"""Wrappers of Gymnasium's whose statistics each environment would have for itself -> what does it right."""


def wrapped(environment: Environment, names: Sequence[str]) -> Environment:
    """`environment` inside the wrappers, the first one innermost.

    Args:
        environment: any.
        names: of a wrapper above or in gymnasium.wrappers; of another one, or of a function that takes an environment
            and gives one, package.module:Name.

    Raises:
        UserError: for a name that is none, or if a wrapper cannot be put around the environment.
    """
    for name in names:
        wrapper = found(name)
        try:
            environment = wrapper(environment)
        except Exception as error:
            refused = SettingError(
                "wrappers", name,
                f"it cannot be put around the environment ({in_words(error)}); one that needs more than the "
                "environment goes into a function of your own: package.module:function",
            )  # fmt: skip
            refused.traceback = traceback_of(error)
            raise refused from error
        if not isinstance(environment, gymnasium.Env):
            raise SettingError("wrappers", name, f"it gave {type(environment).__name__} in place of an environment")
    return environment


def found(name: str) -> Callable[[Environment], Environment]:
    """The wrapper of a name; raises UserError if there is none."""
    module, colon, attribute = name.partition(":")
    if name in BETTER:
        raise SettingError("wrappers", name, BETTER[name])
    if name in OWN:
        return OWN[name]
    if not colon:
        module, attribute = "gymnasium.wrappers", name
        known = {*gymnasium.wrappers.__all__, *OWN} - {"vector"}
        if name not in known:
            raise unknown_name("wrapper", name, known)
    try:
        wrapper: Callable[[Environment], Environment] = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise SettingError("wrappers", name, f"{in_words(error)}; write package.module:Name") from error
    return wrapper


def packages_of(environment: str, wrappers: Sequence[str]) -> list[str]:
    """What would be imported for an id and wrappers: running code that the user may not have meant to run."""
    named = [environment, *wrappers]
    return [package for package, colon, _ in (name.rpartition(":") for name in named) if colon]


def require_import_allowed(environment: str, wrappers: Sequence[str], imports: Sequence[str]) -> None:
    """Refuse names read from disk that would import a package which the user has not named: importing runs code."""
    for package in packages_of(environment, wrappers):
        if package not in imports:
            raise UserError(
                f"this run's environment is {' inside '.join(map(repr, [environment, *wrappers]))}, which imports the "
                f"package {package}: if you trust it, add --imports {package}"
            )
