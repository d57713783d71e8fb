"""Reward schedules in a run group: each run has its own, with the weights that it would have alone."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from resume.helpers import assert_same_run

from saclab.batch import engine as engines
from saclab.config import Config
from saclab.training import loop
from saclab.training.requests import Requests
from saclab.training.run_folder import read_run

from .helpers import config, engine_of, failures, folders, tiny_environments, train
from .test_batch import assert_close
from .test_long_rounds import LONG, ROUND, pausing_after

SCHEDULES = [
    {"reward_schedule": ("right: 1@0.1 -1@0.9", "left: 0@0.1 1@1")},
    {"reward_schedule": ("right: 2@return=-1 1@return=1", "left: 3@0")},  # every return is 0
    {"reward_terms": ("right", "left"), "reward_weights": (0.5, 2.0)},
]


def scheduled(prefix: str, **changes: object) -> list[Config]:
    """Runs of one group, with learning rates at which the weights of each update show."""
    fast = {"actor_learning_rate": 0.01, "critic_learning_rate": 0.01, "reward_scaling": "deviation"}
    return [
        config("sac-auto", seed, prefix + "Leaning-v0", **{**fast, "q_bias_episodes": 5, **schedule, **changes})
        for seed, schedule in enumerate(SCHEDULES)
    ]


@pytest.fixture(autouse=True)
def short_parts(monkeypatch):
    """A long round is made in three parts of four updates."""
    monkeypatch.setattr(engines, "LONGEST_CALL", 15)
    monkeypatch.setattr(engines, "SHORTEST_PART", 3)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"acting_delay": 0}, LONG])
def test_each_run_has_the_weights_that_it_has_alone(tmp_path, monkeypatch, changes):
    """Weights and terms in every evaluation, losses in every window, the critics' bias of the weighed reward."""
    with tiny_environments(monkeypatch) as prefix:
        configs = scheduled(prefix, **changes)
        assert failures(train(tmp_path, configs)) == {}
        for own, folder in zip(configs, folders(tmp_path, configs), strict=True):
            list(loop.train(own, tmp_path / "alone" / folder.name))
            ours, theirs = read_run(folder), read_run(tmp_path / "alone" / folder.name)
            assert_close(ours, theirs)
            for part in ("reward_terms", "q_bias"):
                mine, other = getattr(ours, part), getattr(theirs, part)
                for name in mine.keys() - {"seconds"}:
                    tolerance = 0 if name.startswith("weight") else 0.02
                    np.testing.assert_allclose(mine[name], other[name], tolerance, tolerance, err_msg=name)
        weights = [read_run(folder).reward_terms["weight_right"].tolist() for folder in folders(tmp_path, configs)]
    assert weights[0][-1] < 0 < weights[0][0] < 1, "on the slope"
    assert {*weights[1]} == {1.5}
    assert {*weights[2]} == {0.5}


@pytest.mark.slow
def test_a_group_that_stops_within_a_round_on_a_slope_goes_on_bit_for_bit(tmp_path, monkeypatch):
    with tiny_environments(monkeypatch) as prefix:
        configs = scheduled(prefix, **LONG)
        train(tmp_path / "straight", configs)
        requests = Requests()
        with pausing_after(3 * ROUND + 8, requests):
            train(tmp_path / "stopped", configs, requests=requests)
        assert requests.stop
        train(tmp_path / "stopped", configs)
        for index in range(len(configs)):
            assert_same_run(tmp_path / f"straight/run-{index}", tmp_path / f"stopped/run-{index}")


def test_the_scale_of_each_run_is_that_of_its_weighed_rewards(monkeypatch):
    """Episodes of one step, of which twice the action counts, or nothing: their deviation by hand."""
    terms = {"reward_terms": ("right", "left"), "reward_scaling": "deviation"}
    weights = [(2.0, 0.0), (0.0, 0.0), (0.0, -3.0)]
    with tiny_environments(monkeypatch) as prefix:
        configs = [config("sac", 0, prefix + "Leaning-v0", reward_weights=own, **terms) for own in weights]
        with closing(engine_of(configs)) as group:
            for _ in range(40):
                group.step()
            for index, (right, left) in enumerate(weights):
                found = group.snapshot(index)
                action = np.array(found.replay.layout.unpack(found.replay.rows[:40]).action[:, 0], np.float64)
                expected = abs(right - left) * action.std()
                assert float(found.run.reward_scale.value) == pytest.approx(expected, rel=1e-3, abs=0.01)
