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
BETTER: dict[Any, str] = {
    gymnasium.wrappers.NormalizeObservation: "use --observation-normalisation running: evaluations and the policy "
    "share its moments",
    gymnasium.wrappers.NormalizeReward: "use --reward-scaling deviation: stored rewards then have today's scale",
    gymnasium.wrappers.ClipAction: "leave it out: actions are clipped to the environment's bounds anyway",
}
"""Wrappers of Gymnasium's that are no use here -> what is."""


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
    if name in OWN:
        return OWN[name]
    module, attribute = ("gymnasium.wrappers", name) if ":" not in name else parted(name)
    if ":" not in name:
        known = {*gymnasium.wrappers.__all__, *OWN} - {"vector"}
        if name not in known:
            raise unknown_name("wrapper", name, known)
    try:
        wrapper: Callable[[Environment], Environment] = getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        missing = f"there is no module {error.name}: is its folder on PYTHONPATH, or the package installed?"
        raise SettingError("wrappers", name, missing) from error
    except AttributeError as error:
        raise SettingError("wrappers", name, f"{in_words(error)}; write package.module:Name") from error
    except Exception as error:
        refused = SettingError("wrappers", name, f"its module cannot be imported: {in_words(error)}")
        refused.traceback = traceback_of(error)
        raise refused from error
    if isinstance(wrapper, type) and wrapper in BETTER:
        raise SettingError("wrappers", name, BETTER[wrapper])
    return wrapper


def parted(name: str) -> tuple[str, str]:
    """Module and attribute of package.module:Name; raises SettingError for another form."""
    module, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), *attribute.split("."))):
        raise SettingError("wrappers", name, "write package.module:Name")
    return module, attribute


def require_import_allowed(environment: str, wrappers: Sequence[str], imports: Sequence[str]) -> None:
    """Refuse names read from disk that would import a package which the user has not named: importing runs code."""
    named = {f"environment is {environment!r}": environment.rpartition(":")[0]}
    named |= {f"environment has the wrapper {name!r}": parted(name)[0] for name in wrappers if ":" in name}
    for said, package in named.items():
        if package and package not in imports:
            raise UserError(
                f"this run's {said}, which imports the package {package}: if you trust it, add --imports {package}"
            )
