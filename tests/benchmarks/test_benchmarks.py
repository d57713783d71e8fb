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

LIMIT = {"limit": {"updates_per_second": 200.0, "averaged": 100.0}}
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
        {"saclab": result(ours), "SBX": result(theirs)} | LIMIT
        for ours, theirs in ((100.0, 50.0), (50.0, 10.0), (150.0, 50.0))
    ]
    assert tables.row("case", "saclab", rounds)[:5] == ["case", "saclab", "100 (50–150)", "0.50 (0.25–0.75)", ""]
    assert tables.row("", "SBX", rounds)[2:5] == ["50 (10–50)", "0.25 (0.05–0.25)", "3.00× (2.00–5.00)"]


def test_a_table_takes_its_place_and_nothing_else():
    text = "before\n<!-- speed -->\nold\n<!-- /speed -->\nafter"
    assert tables.replace_between(text, "speed", "new") == "before\n<!-- speed -->\nnew\n<!-- /speed -->\nafter"
    with pytest.raises(SystemExit, match="no place"):
        tables.replace_between("nothing here", "speed", "new")


@pytest.mark.parametrize(
    ("name", "page"), [("speed", "docs/speed.md"), ("peers", "README.md"), ("batches", "docs/where-to-run.md")]
)
def test_the_tables_of_the_pages_are_made_from_the_results(name, page):
    text = (Path(__file__).parents[2] / page).read_text()
    assert tables.replace_between(text, name, tables.made(name)) == text


def test_the_short_table_tells_the_least_and_the_most():
    cases = {
        case: {"rounds": [{name: result(rate) for name, rate in zip(("saclab", *tables.PEER_ROWS), rates)} | LIMIT]}
        for case, rates in {
            "HalfCheetah-v4, 1:5, single run": (100.0, 50.0, 80.0, 10.0),
            "HalfCheetah-v4, 1:5, grid": (200.0, 50.0, 100.0, 10.0),
        }.items()
    }
    lines = tables.peers_table({"cases": cases}).splitlines()
    assert "in up to 2 cases" in lines[0]
    assert lines[2] == "| saclab | 100 (100–100) | 200 (200–200) |  |"
    assert lines[3] == "| Stable-Baselines3 | 50 (50–50) | 50 (50–50) | 2.00 to 4.00× |"
    assert lines[5] == "| Tianshou | 10 (10–10) | 10 (10–10) | 10.00 to 20.00× |"
