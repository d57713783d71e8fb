"""Run by test_suites.py in an environment that has dm_control, gymnasium-robotics and MuJoCo 3; not collected here."""

from __future__ import annotations

import numpy as np
import pytest
from resume.helpers import assert_same_run, finish, small_config, stop_at

from saclab.environments.make import make_environment
from saclab.environments.simulator import capture_state, restore_state
from saclab.playback import evaluate

FLAT = ["FlattenObservation"]
# Plain ones, one of each kind that changes the model when an episode starts, one with another integrator.
TASKS = (
    "cheetah-run", "humanoid-walk", "hopper-hop", "dog-run", "point_mass-hard", "reacher-easy", "finger-turn_hard",
    "fish-swim", "manipulator-insert_peg", "stacker-stack_2", "cartpole-swingup", "ball_in_cup-catch",
    "quadruped-run", "quadruped-escape",
)  # fmt: skip


def go_on(environment, actions) -> list[np.ndarray]:
    rows = []
    for action in actions:
        observation, reward, terminated, truncated, _ = environment.step(action)
        rows.append(np.concatenate([observation, [reward, terminated, truncated]]))
    observation, _ = environment.reset()  # the generator of the next episodes goes on as well
    return [*rows, observation]


FETCH = ("FetchReach-v4", "FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4", "FetchReachDense-v4")
NAMES = [f"shimmy:dm_control/{task}-v0" for task in TASKS] + [f"gymnasium_robotics:{task}" for task in FETCH]


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_goes_on_bit_for_bit_in_a_fresh_instance(name):
    first = make_environment(name, wrappers=FLAT)
    first.reset(seed=1)
    first.action_space.seed(2)
    actions = [first.action_space.sample() for _ in range(30)]
    go_on(first, actions[:5])
    for action in actions[:5]:
        first.step(action)
    state = capture_state(first)
    expected = go_on(first, actions[5:])
    fresh = make_environment(name, wrappers=FLAT)
    fresh.reset(seed=99)
    fresh.step(actions[0])
    restore_state(fresh, state)
    for step, (ours, theirs) in enumerate(zip(expected, go_on(fresh, actions[5:]), strict=True)):
        np.testing.assert_array_equal(ours, theirs, err_msg=f"step {step + 1} after the restore")


@pytest.mark.parametrize(
    "name",
    [
        "shimmy:dm_control/reach_site_features-v0",
        "shimmy:dm_control/lqr-lqr_2_1-v0",
        "gymnasium_robotics:HandReach-v3",
    ],
)
def test_what_keeps_more_is_not_captured(name):
    environment = make_environment(name, wrappers=FLAT)
    environment.reset(seed=0)
    assert capture_state(environment) is None


def test_a_run_on_the_suite_continues_exactly_and_its_policy_is_evaluated(tmp_path):
    config = small_config("shimmy:dm_control/reacher-easy-v0", environments=3, wrappers=FLAT)
    finish(config, tmp_path / "straight")
    stop_at(90, config, tmp_path / "stopped")
    finish(config, tmp_path / "stopped")
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")
    assert evaluate(tmp_path / "straight", 1, 0, imports=["shimmy"]).lengths == [1000]


def test_a_run_on_fetch_continues_exactly(tmp_path):
    config = small_config("gymnasium_robotics:FetchPush-v4", environments=3, wrappers=FLAT)
    finish(config, tmp_path / "straight")
    stop_at(90, config, tmp_path / "stopped")
    finish(config, tmp_path / "stopped")
    assert_same_run(tmp_path / "straight", tmp_path / "stopped")
    assert evaluate(tmp_path / "straight", 1, 0, imports=["gymnasium_robotics"]).lengths == [50]
