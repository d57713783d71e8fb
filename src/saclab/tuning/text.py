"""What a tune says of itself, in lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from saclab.tuning.plan import TunePlan
from saclab.tuning.space import value_text, values_of
from saclab.tuning.study import WHY, is_complete, value_in_words
from saclab.tuning.tuner import Tune

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial


def beginning(tune: Tune) -> str:
    """How many trials there are to be, and whether the variant's own settings are among them."""
    told = f"{tune.trials} trials, of which {len(tune.ended_before)} have ended already"
    outside = ", ".join(f"{name} {value_text(value)}" for name, value in tune.plan.own_outside.items())
    return f"{told}; the variant's own settings are none of them: {outside} is not searched" if outside else told


def trial_line(trial: FrozenTrial, plan: TunePlan) -> str:
    """What came of a trial, with its settings."""
    value = value_in_words(trial, plan) if is_complete(trial) else f"given up: {trial.user_attrs.get(WHY)}"
    settings = values_of(plan.space, trial.params)
    listed = ", ".join(f"{name} {value_text(value)}" for name, value in settings.items())
    return f"trial {trial.number}: {value}  ({listed})"
