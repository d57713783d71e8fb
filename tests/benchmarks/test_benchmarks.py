"""What the benchmarks' claims rest on: the count of operations, and that a table says what the results say."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from saclab.replay import RowLayout
from saclab.settings import AlgorithmSettings

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import tables
from operations import update_operations

B, O, A, H, C = 7, 5, 3, 11, 2  # noqa: E741


@pytest.mark.parametrize(("snapshots", "interval"), [(1, 1), (4, 1), (1, 3)])
def test_the_operations_of_an_update_by_hand(snapshots, interval):
    settings = AlgorithmSettings(batch_size=B, hidden_layers=(H,), snapshots=snapshots, actor_interval=interval)
    actor = O * H + H * 2 * A
    critic = C * ((O + A) * H + H)
    target = actor + snapshots * critic
    critic_pass = critic + critic + C * H  # forward, the weights' gradient, the hidden layer's; none for the inputs
    policy_gradient = C * H + C * H * A + 2 * A * H + actor  # through the critic to the action alone, then the actor
    multiplications = target + critic_pass + (actor + critic + policy_gradient) / interval
    assert update_operations(settings, RowLayout(O, A)) == pytest.approx(2 * B * multiplications)


def result(rate: float) -> dict:
    return {
        "updates_per_second": rate, "cpu_seconds_per_1000_updates": 9.0, "first_update_seconds": 3.0,
        "peak_bytes": 2**20, "versions": {"sbx-rl": "1.2"},
    }  # fmt: skip


def test_a_row_holds_medians_and_ratios_within_rounds():
    rounds = [
        {"limit": {"updates_per_second": 200.0, "averaged": 100.0}, "saclab": result(ours), "SBX": result(theirs)}
        for ours, theirs in ((100.0, 50.0), (50.0, 10.0), (150.0, 50.0))
    ]
    assert tables.row("case", "saclab", rounds)[:5] == ["case", "saclab", "100 (50–150)", "0.50", ""]
    assert tables.row("", "SBX", rounds)[2:5] == ["50 (10–50)", "0.25", "3.00×"]


def test_a_table_takes_its_place_and_nothing_else():
    text = "before\n<!-- speed -->\nold\n<!-- /speed -->\nafter"
    assert tables.replace_between(text, "speed", "new") == "before\n<!-- speed -->\nnew\n<!-- /speed -->\nafter"
    with pytest.raises(SystemExit, match="no place"):
        tables.replace_between("nothing here", "speed", "new")
