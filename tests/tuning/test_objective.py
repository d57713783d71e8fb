"""What a trial is worth, by numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from saclab.errors import SettingError
from saclab.tuning.objective import Objective, objective_of
from saclab.tuning.plan import first_difference

SLOW = {"mean_return": np.array([1.0, 2.0, 6.0]), "steps": np.array([10, 20, 30]), "seconds": np.array([1.0, 2.5, 4.0])}
NEVER = {"mean_return": np.array([1.0, 1.0]), "steps": np.array([10, 20]), "seconds": np.array([2.0, 3.0])}


@pytest.mark.parametrize(
    ("objective", "value"),
    [
        (Objective("mean"), (3 + 1) / 2),
        (Objective("final"), (6 + 1) / 2),
        (Objective("steps", 2.0), (20 + 2 * 20) / 2),  # PAR2: what never gets there counts twice its length
        (Objective("seconds", 5.0), (4 + 2 * 3) / 2),
    ],
)
def test_the_value_of_a_trial_is_the_mean_of_its_runs(objective, value):
    assert objective.value([SLOW, NEVER]) == pytest.approx(value)


def test_a_way_to_a_score_is_at_least_what_was_spent():
    objective = Objective("steps", 2.0)
    assert objective.reached(SLOW)
    assert not objective.reached(NEVER)
    assert objective.at_least([SLOW, NEVER], [False, False]) == (20 + 20) / 2
    assert objective.at_least([SLOW, NEVER], [False, True]) == (20 + 40) / 2, "one that ended without it counts in full"
    assert objective.at_least([SLOW, None], [False, False]) == 10, "one that has not begun has spent nothing"


@pytest.mark.parametrize(
    ("name", "score", "message"),
    [
        ("speed", None, "use one of mean, final, steps, seconds"),
        ("seconds", None, "objective seconds needs one"),
        ("mean", 3.0, "objective mean has none"),
        ("steps", float("nan"), "use a finite number"),
    ],
)
def test_an_objective_that_cannot_be_is_refused(name, score, message):
    with pytest.raises(SettingError, match=message):
        objective_of(name, score)


def test_a_setting_that_is_none_on_one_side_only_is_a_difference():
    assert first_difference({"a": 1, "b": None}, {"a": 1}) == ("b", None, "nothing")
    assert first_difference({"a": {"c": 1}}, {"a": {"c": 1, "d": None}}) == ("a, d", "nothing", None)
