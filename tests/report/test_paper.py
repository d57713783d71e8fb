"""The paper's numbers, as data."""

import numpy as np
import pytest

from saclab.report.paper import TABLE_2, paper_curves
from saclab.variants import VARIANTS


@pytest.mark.parametrize("environment", TABLE_2)
def test_curves_belong_to_the_systems_of_table_2(environment):
    curves = paper_curves(environment)
    assert curves.keys() == TABLE_2[environment].keys()
    assert curves.keys() == {variant.paper_name for variant in VARIANTS.values()} - {None}
    for name, curve in curves.items():
        assert len(curve.episode) == len(curve.evaluation_return) > 20
        assert (np.diff(curve.episode) > 0).all()
        assert curve.evaluation_return.max() < TABLE_2[environment][name] + 800  # else misread


def test_an_environment_outside_the_paper_has_no_curve():
    assert paper_curves("Pendulum-v1") == {}
