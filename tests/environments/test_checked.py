"""Environments that break their word are refused with what they did; those of any number type are served."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

import saclab
from saclab.errors import RunBroken
from saclab.training.evaluation import Evaluator


class Unruly(gymnasium.Env):
    """Three numbers for one action, unless it is told to give something else.

    Args:
        gives: replaces parts of what `reset` ("start") or `step` ("observation", "reward", "terminated") give.
        at: the step in which it does.
        action: the type of the action space.
    """

    def __init__(self, gives: dict | None = None, at: int = 3, action: str = "float32", render_mode: None = None):
        self.observation_space = Box(-np.inf, np.inf, (3,), np.float64)
        bounds = (-2, 2) if action.startswith("int") else (-0.1, 0.7)
        self.action_space = Box(*bounds, (1,), np.dtype(action).type)
        self.gives, self.at, self.count = gives or {}, at, 0
        self.actions: list = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.array(self.gives.get("start", [0.0] * 3)), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.count += 1
        given = self.gives if self.count == self.at else {}
        return (
            np.array(given.get("observation", [0.0, self.count, 1.0])),
            np.array(given["reward"]) if "reward" in given else 1.0,
            given.get("terminated", False), self.count == 5, {},
        )  # fmt: skip


gymnasium.register("Unruly-v0", Unruly)
SMALL = {"hidden_layers": (8,), "batch_size": 16, "random_steps": 40, "max_steps": 60, "evaluation_interval_steps": 30}


@pytest.mark.parametrize(
    ("gives", "words"),
    [
        ({"observation": [1.0]}, r"in step: its observation has shape \(1,\), and .*\(3,\)"),
        ({"observation": [1.0] * 4}, r"in step: its observation has shape \(4,\)"),
        ({"observation": ["a", "b", "c"]}, "in step: its observation has type"),
        ({"start": [0.0, 0.0]}, r"in reset: its observation has shape \(2,\)"),
        ({"reward": [1.0]}, r"in step: its reward has shape \(1,\)"),
        ({"reward": "much"}, "in step: its reward is .*much"),
        ({"terminated": None}, "in step: its terminated is None, and True or False is due"),
    ],
    ids=["too short", "too long", "words", "reset", "reward of a shape", "reward in words", "flag"],
)
def test_what_does_not_fit_is_refused_in_training_and_in_evaluations(tmp_path, gives, words):
    with pytest.raises(RunBroken, match=words):
        saclab.train("Unruly-v0", protocol="quick", runs=tmp_path, environment_arguments={"gives": gives}, **SMALL)
    with pytest.raises(RunBroken, match=words):
        Evaluator("Unruly-v0", {"gives": gives}).run(lambda observation: np.zeros((len(observation), 1)), [0])


@pytest.mark.parametrize("action", ["float64", "float32", "int64", "int32"])
def test_any_type_of_actions_is_trained_with_and_its_policy_is_read_back(tmp_path, action):
    """The environment asserts that each action lies in its space."""
    run = saclab.train("Unruly-v0", protocol="quick", runs=tmp_path, environment_arguments={"action": action}, **SMALL)
    policy = saclab.load_policy(run.path)
    environment = gymnasium.make("Unruly-v0", action=action)
    for deterministic in (True, False):
        chosen, _ = policy.predict(np.zeros((20, 3)), deterministic=deterministic)
        assert chosen.dtype == environment.action_space.dtype
        assert all(environment.action_space.contains(each) for each in chosen)
