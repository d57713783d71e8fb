"""What a grid would cost, where its environments do not keep their word."""

from __future__ import annotations

import pytest

from saclab.errors import RunBroken
from saclab.grid.forecast import Kind, measure
from saclab.protocols import make_config

SMALL = {"hidden_layers": (8,), "batch_size": 16, "evaluation_episodes": 1}


@pytest.mark.parametrize("at", [3, 18])
def test_an_environment_that_raises_ends_the_measurement(at):
    """In the random steps, and in those with updates: no run would ever come to its next update."""
    config = make_config("environments.rogue:Rogue-v0", "sac", "quick", 0, {"where": "step", "at": at}, SMALL)
    with pytest.raises(RunBroken, match="raised an error in step"):
        measure(Kind((config,), 0, 1))
