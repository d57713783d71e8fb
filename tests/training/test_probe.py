"""Known soft values through everything that a run is made of: environments, replay buffer and learner."""

from __future__ import annotations

import math
from contextlib import closing

import numpy as np
import pytest
from environments import tiny  # noqa: F401 - registers them

from saclab.protocols import make_config
from saclab.training.local_engine import LocalEngine

DISCOUNT, ALPHA, REWARD = 0.6, 0.5, 2.0
SETTINGS = {
    "hidden_layers": (16,),
    "batch_size": 32,
    "discount": DISCOUNT,
    "initial_temperature": ALPHA,
    "polyak_rate": 0.05,
    "critic_learning_rate": 5e-3,
    "actor_learning_rate": 5e-3,
    "random_steps": 50,
    "replay_capacity": 500,
    "max_steps": 1050,
}


@pytest.mark.parametrize(
    ("terminal", "worth"),
    [
        (True, REWARD),
        # The future goes on beyond the time limit; the best policy is uniform, of entropy log 2.
        (False, REWARD / (1 - DISCOUNT) + DISCOUNT / (1 - DISCOUNT) * ALPHA * math.log(2)),
    ],
    ids=["terminated", "truncated"],
)
def test_a_constant_reward_is_worth_what_follows_it(terminal, worth):
    """Nothing follows a terminal state; the future goes on beyond a time limit."""
    config = make_config("Constant-v0", "sac", environment_arguments={"terminal": terminal}, overrides=SETTINGS)
    ends = []
    with closing(LocalEngine.new(config)) as engine:
        while engine.run.finish_reason() is None:
            ends += engine.step().ended.get(0, [])
    assert {episode.terminated for episode in ends} == {terminal}
    critics = np.asarray(engine.learner_state.critic.weights)
    values = [engine.learner.q_values(critic, np.array([1.0, 0.3], np.float32)) for critic in critics]
    assert values == pytest.approx([worth, worth], abs=0.1)
