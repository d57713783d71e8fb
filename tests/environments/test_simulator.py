"""An episode captured in the middle goes on, bit for bit, in a fresh instance."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest

from saclab.environments.make import make_environment
from saclab.environments.simulator import capture_state, restore_state

from . import tiny  # noqa: F401 - registers them

EXACT = (
    "HalfCheetah-v4", "HalfCheetah-v5", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Ant-v5", "Humanoid-v4", "Humanoid-v5",
    "Pendulum-v1", "MountainCarContinuous-v0", "InvertedPendulum-v4", "Reacher-v4", "Pusher-v5", "Swimmer-v4",
)  # fmt: skip
BEFORE, AFTER = 7, 60


def go_on(environment, actions) -> list[np.ndarray]:
    """Observation, reward and ends of each step; episodes follow each other."""
    rows = []
    for action in actions:
        observation, reward, terminated, truncated, _ = environment.step(action)
        if terminated or truncated:
            observation, _ = environment.reset()
        rows.append(np.concatenate([observation, [reward, terminated, truncated]]))
    return rows


@pytest.mark.parametrize("name", EXACT)
def test_a_captured_episode_goes_on_bit_for_bit_in_a_fresh_instance(name):
    first = make_environment(name)
    first.reset(seed=1)
    first.action_space.seed(2)
    actions = [first.action_space.sample() for _ in range(BEFORE + AFTER)]
    go_on(first, actions[:BEFORE])
    state = capture_state(first)
    expected = go_on(first, actions[BEFORE:])  # what was captured must not change with it

    fresh = make_environment(name)
    fresh.reset(seed=99)
    go_on(fresh, actions[:3])
    restore_state(fresh, state)
    for step, (ours, theirs) in enumerate(zip(expected, go_on(fresh, actions[BEFORE:]), strict=True)):
        np.testing.assert_array_equal(ours, theirs, err_msg=f"step {step + 1} after the restore")


def test_episodes_end_within_the_steps_that_are_compared():
    """Otherwise the test above would not see that the generator of the next episodes is restored."""
    environment = make_environment("Hopper-v4")
    environment.reset(seed=1)
    environment.action_space.seed(2)
    rows = go_on(environment, [environment.action_space.sample() for _ in range(BEFORE + AFTER)])
    assert sum(row[-2] for row in rows[BEFORE:]) >= 1


def test_the_time_limit_is_restored():
    first, fresh = make_environment("Pendulum-v1"), make_environment("Pendulum-v1")
    first.reset(seed=0), fresh.reset(seed=1)
    for _ in range(190):
        first.step(np.zeros(1))
    restore_state(fresh, capture_state(first))
    ends = [fresh.step(np.zeros(1))[3] for _ in range(10)]
    assert ends == [False] * 9 + [True]


def test_what_saclab_does_not_know_is_not_captured():
    """Neither a simulator nor a wrapper whose state decides how the episode goes on."""
    unknown = make_environment("Counting-v0")
    unknown.reset(seed=0)
    assert capture_state(unknown) is None
    wrapped = gymnasium.wrappers.FrameStackObservation(make_environment("Pendulum-v1"), 2)
    wrapped.reset(seed=0)
    assert capture_state(wrapped) is None


def test_an_environment_may_bring_its_own_capture():
    environment = make_environment("CapturableCounting-v0")
    environment.reset(seed=0)
    environment.step(np.zeros(1))
    state = capture_state(environment)
    assert state["physics"]["counters"].tolist() == [1, 1]
    assert state["elapsed_steps"] == [1]


@pytest.mark.parametrize("kind", [np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64])
def test_whatever_its_generator_an_episode_goes_on_by_way_of_json(kind):
    """Some kinds have arrays in their state."""
    first, fresh = make_environment("Pendulum-v1"), make_environment("Pendulum-v1")
    for environment in (first, fresh):
        environment.reset(seed=0)
        environment.unwrapped.np_random = np.random.Generator(kind(5 if environment is first else 6))
    first.unwrapped.np_random.standard_normal(7)
    state = capture_state(first)
    restore_state(fresh, state | {"generator": json.loads(json.dumps(state["generator"]))})
    np.testing.assert_array_equal(first.reset()[0], fresh.reset()[0])


def test_a_generator_of_another_kind_is_refused():
    first, fresh = make_environment("Pendulum-v1"), make_environment("Pendulum-v1")
    first.reset(seed=0), fresh.reset(seed=0)
    fresh.unwrapped.np_random = np.random.Generator(np.random.Philox(1))
    with pytest.raises(ValueError, match="state must be for a Philox"):
        restore_state(fresh, capture_state(first))
