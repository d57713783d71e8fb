"""2N steps in one go are N steps, a checkpoint, and N steps by a fresh run, to the last bit of every file."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from axes import AXES, TOGETHER

from saclab.training import checkpoint, loop, starts
from saclab.training.checkpoint import newest_first, read_manifest
from saclab.training.events import Evaluated, Interrupted, Started
from saclab.training.local_engine import LocalEngine
from saclab.training.requests import Requests
from saclab.variants import VARIANTS

from .helpers import STEPS, assert_same_run, finish, lines_of, request_at, small_config, stop_at, vanish_after

ENVIRONMENTS = ("HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4")
MATRIX = [(environment, "averaged-auto") for environment in ENVIRONMENTS] + [
    ("Humanoid-v4" if row.needs else "Hopper-v4", name) for name, row in VARIANTS.items()
]
HALF = STEPS // 2  # a multiple of 1 and 3 environments


@pytest.fixture(scope="module", autouse=True)
def several_segments():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "SEGMENT_ROWS", 40)
        yield


def assert_exact(config, folder: Path) -> None:
    """Stopped once and vanished once, both in the middle of episodes."""
    straight, broken = folder / "straight", folder / "broken"
    finish(config, straight)
    stop_at(HALF, config, broken)
    state = read_manifest(newest_first(broken / "checkpoints")[0]).state
    assert any(environment["length"] > 0 for environment in state["environments"])
    vanish_after(HALF + 30, config, broken)
    finish(config, broken)
    assert [line["from_step"] for line in lines_of(broken / "sessions.jsonl")] == [0, HALF, HALF + 30]
    assert_same_run(straight, broken)


@pytest.mark.slow
@pytest.mark.parametrize("environments", [1, 3])
@pytest.mark.parametrize(("environment", "variant"), sorted(set(MATRIX)))
def test_every_variant_continues_exactly(environment, variant, environments, tmp_path):
    assert_exact(small_config(environment, variant, environments), tmp_path)


@pytest.mark.slow
def test_every_axis_at_once_continues_exactly(tmp_path):
    assert_exact(small_config("HalfCheetah-v4", environments=3, critic_hidden_layers=(8,), **TOGETHER), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("axis", AXES)
def test_every_axis_continues_exactly(axis, tmp_path):
    assert_exact(small_config("HalfCheetah-v4", environments=3, **AXES[axis]), tmp_path)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    config, folder = small_config("Hopper-v4", environments=3), tmp_path_factory.mktemp("straight")
    return config, folder, finish(config, folder)


def test_a_run_whose_policy_acts_late_continues_exactly(tmp_path):
    assert_exact(small_config("Hopper-v4", acting_delay=1, update_interval=7), tmp_path)


def test_three_environments_continue_exactly(straight, tmp_path):
    config, folder, _ = straight
    vanish_after(HALF, config, tmp_path)
    finish(config, tmp_path)
    assert_same_run(folder, tmp_path)


@pytest.mark.parametrize("calls", [0, 5], ids=["before its first step", "after some steps"])
@pytest.mark.parametrize("which", ["first", "last"])
def test_an_evaluation_is_broken_off_on_request_and_made_anew(straight, tmp_path, calls, which):
    """An evaluation of twenty long episodes takes longer than anyone who sends SIGTERM waits."""
    config, folder, events = straight
    evaluations = [event for event in events if isinstance(event, Evaluated)]
    begun_at = evaluations[0 if which == "first" else -1].steps
    requests, real, seen = Requests(), LocalEngine.evaluate, []

    def evaluate(engine, runs, should_stop):
        def asked():
            seen.append(engine.run.counters.steps)
            if len([step for step in seen if step == begun_at]) > calls:
                requests.stop = 15
            return should_stop()

        return real(engine, runs, asked)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LocalEngine, "evaluate", evaluate)
        assert list(loop.train(config, tmp_path, requests))[-1] == Interrupted(begun_at)
    assert len([step for step in seen if step == begun_at]) == calls + 1
    resumed = finish(config, tmp_path)
    assert resumed[0].resumed_at_step == begun_at
    assert [event.steps for event in resumed if isinstance(event, Evaluated)] == [
        event.steps for event in evaluations if event.steps >= begun_at
    ]
    assert_same_run(folder, tmp_path)


def test_a_finished_run_that_lost_its_last_word_says_it_again(straight, tmp_path):
    """Killed between the last checkpoint and result.json."""
    config, folder, _ = straight
    finish(config, tmp_path)
    (tmp_path / "result.json").unlink()
    assert isinstance(finish(config, tmp_path)[0], Started)
    assert_same_run(folder, tmp_path)


def test_a_run_can_be_stopped_before_its_first_update_and_after_every_step(straight, tmp_path):
    config, folder, _ = straight
    for step in (3, 60, 63, 237):
        stop_at(step, config, tmp_path)
    finish(config, tmp_path)
    assert_same_run(folder, tmp_path)


def test_a_request_to_save_changes_nothing(straight, tmp_path):
    config, folder, _ = straight
    requests = Requests()
    with request_at(HALF, requests, "save"):
        list(loop.train(config, tmp_path, requests))
    assert_same_run(folder, tmp_path)


def test_the_comparison_sees_one_changed_bit(straight, tmp_path):
    config, folder, _ = straight
    stop_at(HALF, config, tmp_path)
    real = starts.from_checkpoint

    def from_checkpoint(*arguments):
        start = real(*arguments)
        actor = np.array(start.learner.actor.weights)
        actor[0] = np.nextafter(actor[0], np.float32(math.inf))
        return start._replace(learner=start.learner._replace(actor=start.learner.actor._replace(weights=actor)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(starts, "from_checkpoint", from_checkpoint)
        finish(config, tmp_path)
    with pytest.raises(AssertionError):
        assert_same_run(folder, tmp_path)
