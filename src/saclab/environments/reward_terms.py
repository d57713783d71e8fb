"""The terms that a reward is the sum of, as an environment tells them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, SupportsFloat

import numpy as np

from saclab.errors import NonFiniteError, RunBroken, SettingError
from saclab.limits import LARGEST_FLOAT


def split_reward(
    environment: str,
    reward: SupportsFloat,
    info: Mapping[str, Any],
    names: Sequence[str],
    scheduled: Collection[str] = (),
) -> tuple[float, ...]:
    """The named terms of one step, and the remainder: their sum is the reward, up to rounding.

    Args:
        environment: its id, for errors.
        reward: what the step gave.
        info: what the step told beside it, such as `reward_forward` and `reward_ctrl`.
        names: of the terms; none leaves the reward itself as the only term.
        scheduled: those that `reward_schedule` alone names, for errors.

    Raises:
        SettingError: if the step does not tell a term.
        NonFiniteError: if a term is more than 32 bits can hold, or not a number.
    """
    terms = []
    for name in names:
        if name not in info:
            known = ", ".join(key for key, value in info.items() if np.ndim(value) == 0) or "none"
            setting = "reward_schedule" if name in scheduled else "reward_terms"
            raise SettingError(setting, name, f"{environment} does not tell it in the info of a step: it tells {known}")
        terms.append(float(info[name]))
        if not abs(terms[-1]) <= LARGEST_FLOAT:
            raise NonFiniteError(f"{environment} gave the reward term {name} = {terms[-1]}")
    return *terms, float(reward) - sum(terms)


def split_within_run(
    environment: str, reward: SupportsFloat, info: Mapping[str, Any], names: Sequence[str]
) -> tuple[float, ...]:
    """The same for a run under way; raises RunBroken if a term is missing that its environment told at first."""
    try:
        return split_reward(environment, reward, info, names)
    except SettingError as error:
        raise RunBroken(f"reward term {error.value!r}: {error.way_out}, though it did in the first step") from error
