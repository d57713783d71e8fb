"""Long rounds of updates in a run group are made in parts, so that a stop comes between two; long estimates too."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from unittest import mock

import numpy as np
import pytest
from resume.helpers import assert_same_run

from saclab.batch import engine as engines
from saclab.batch.engine import DeviceEngine, end_of_part
from saclab.training.checkpoint import newest_first
from saclab.training.events import Interrupted
from saclab.training.local_engine import LocalEngine
from saclab.training.requests import Requests

from .helpers import config, engine_of, folders, mixed, train

ROUND = 12
LONG = {"update_interval": 10, "updates_per_interval": ROUND, "max_steps": 130}


@pytest.fixture(autouse=True)
def short_parts(monkeypatch):
    """Of four updates of three runs."""
    monkeypatch.setattr(engines, "LONGEST_CALL", 15)
    monkeypatch.setattr(engines, "SHORTEST_PART", 3)


@pytest.mark.parametrize(
    ("due", "longest", "ends"),
    [(1, 8, [1]), (20, 64, [20]), (20, 8, [6, 13, 20]), (12, 5, [4, 8, 12]), (9, 8, [4, 9])],
)
def test_the_parts_of_a_round_are_of_one_size_wherever_it_goes_on(due, longest, ends):
    """By hand; from each number of updates it goes on to the end of the part in which it lies."""
    for made in range(due):
        assert end_of_part(made, due, longest) == next(end for end in ends if end > made)


def test_no_updates_due_is_no_part():
    assert end_of_part(0, 0, 8) == 0


@contextmanager
def pausing_after(updates: int, requests: Requests) -> Iterator[None]:
    """Ask for a stop when the group has made so many updates."""
    real = DeviceEngine.make_updates

    def make_updates(engine, should_pause):
        def asked():
            if engine.updates == updates:
                requests.stop = 1
            return should_pause()

        real(engine, asked)

    with mock.patch.object(DeviceEngine, "make_updates", make_updates):
        yield


@pytest.mark.slow
def test_a_round_that_is_always_to_pause_still_goes_on():
    """As where checkpoints are due all the time: each call makes a part at least."""
    with closing(engine_of(mixed(**LONG))) as group:
        while group.updates < ROUND:
            before = group.steps, group.updates
            if group.runs[0].updates_left > 0:
                group.make_updates(lambda: True)
            else:
                group.step(lambda: True)
            assert (group.steps, group.updates) > before


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1])
def test_a_stop_between_two_parts_goes_on_bit_for_bit(tmp_path, delay):
    """In the first round, and in a later one of which two parts are made."""
    configs = mixed(acting_delay=delay, **LONG)
    train(tmp_path / "straight", configs)
    for updates in (4, 3 * ROUND + 8):
        requests = Requests()
        with pausing_after(updates, requests):
            told = train(tmp_path / "stopped", configs, requests=requests)
        steps = 60 + 10 * -(-updates // ROUND)
        assert [event for _, event in told[-3:]] == [Interrupted(steps)] * 3
        for folder in folders(tmp_path / "stopped", configs):
            assert newest_first(folder / "checkpoints")[0].name == f"step-{steps:012d}-update-{updates:012d}"
    train(tmp_path / "stopped", configs)
    for index in range(3):
        assert_same_run(tmp_path / f"straight/run-{index}", tmp_path / f"stopped/run-{index}")


@pytest.mark.parametrize("delay", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_rounds_in_parts_are_those_of_the_run_alone(delay):
    """Actions and networks, with a learning rate at which each update shows; the rows that are drawn to the bit."""
    own = config(acting_delay=delay, actor_learning_rate=0.03, critic_learning_rate=0.03, **LONG)
    others = [config("sac-auto", seed, acting_delay=delay, **LONG) for seed in (1, 2)]
    with closing(LocalEngine.new(own)) as alone, closing(engine_of([own, *others])) as group:
        while group.steps < 95:
            alone.step()
            group.step()
        ours, theirs = group.snapshot(0), alone.snapshot(0)
        assert ours.run.counters.updates == theirs.run.counters.updates == 3 * ROUND
        assert ours.run.sampling.bit_generator.state == theirs.run.sampling.bit_generator.state
        np.testing.assert_allclose(ours.replay.rows[:95], theirs.replay.rows[:95], atol=0.01)
        np.testing.assert_allclose(ours.learner.actor.weights, theirs.learner.actor.weights, atol=0.01)
        np.testing.assert_allclose(ours.behaviour, theirs.behaviour, atol=0.01)


def test_a_run_that_breaks_in_a_long_round_is_left_as_it_was_before(tmp_path):
    """The others make the rest of the round without it."""
    with closing(engine_of(mixed(**LONG))) as group:
        while group.steps < 79:
            group.step()
        with mock.patch.object(group.pool, "step", breaking(group.pool.step)):
            broken = group.step().broken
        assert broken[1].snapshot.run.counters.updates == ROUND
        assert group.runs[0].updates_left > 0
        group.drop(1)
        group.make_updates()
        assert [run.counters.updates for run in group.runs] == [2 * ROUND, ROUND, 2 * ROUND]


def breaking(step):
    from saclab.errors import RunBroken

    return lambda action: step(action) | {1: RunBroken("it broke")}


@pytest.mark.slow
def test_a_stop_within_the_q_bias_of_a_group_goes_on_bit_for_bit(tmp_path):
    """The estimate takes the workers longer than the stop."""
    configs = mixed(q_bias_episodes=2, **LONG)
    train(tmp_path / "straight", configs)
    requests, real = Requests(), DeviceEngine.measure_q_bias

    def measure(engine, runs, should_stop):
        requests.stop = 1
        return real(engine, runs, should_stop)

    with mock.patch.object(DeviceEngine, "measure_q_bias", measure):
        told = train(tmp_path / "stopped", configs, requests=requests)
    assert told[-1][1] == Interrupted(90)
    for folder in folders(tmp_path / "stopped", configs):
        assert newest_first(folder / "checkpoints")[0].name == "step-000000000090-untested"
    train(tmp_path / "stopped", configs)
    for index in range(3):
        assert_same_run(tmp_path / f"straight/run-{index}", tmp_path / f"stopped/run-{index}")
