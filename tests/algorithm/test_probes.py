"""Problems whose soft values are known on paper: the learner must find them, entropy included.

Every problem is a stream of synthetic batches, one observation and one action wide. Where the reward does not depend
on the action, the best policy is the uniform one, of entropy log 2 on [-1, 1].
"""

from __future__ import annotations

import math
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.learner import make_learner
from saclab.algorithm.scalars import scalars
from saclab.algorithm.types import Batch, Context
from saclab.settings import AlgorithmSettings

DISCOUNT, ALPHA, UPDATES, BATCH = 0.6, 0.5, 1000, 32
UNIFORM_ENTROPY = math.log(2)
SETTINGS = {
    "discount": DISCOUNT,
    "initial_temperature": ALPHA,
    "batch_size": BATCH,
    "hidden_layers": (16,),
    "polyak_rate": 0.05,
    "critic_learning_rate": 5e-3,
    "actor_learning_rate": 5e-3,
    "temperature_learning_rate": 5e-3,
}


@lru_cache(maxsize=8)
def trainer(settings: AlgorithmSettings):
    learner, numbers = make_learner(settings, 1, 1), scalars(settings, 1)

    def update(state, batch_and_step):
        batch, step = batch_and_step
        state = learner.update(numbers, state, batch, Context(step, jnp.ones(1), jnp.float32(1)))
        return state, state.report

    return learner, numbers, jax.jit(lambda state, batches: jax.lax.scan(update, state, (batches, jnp.arange(UPDATES))))


def stream(reward, state, next_state, terminated, action) -> Batch:
    """All updates' batches, from arrays or numbers that fit [UPDATES, BATCH]."""
    columns = (np.broadcast_to(x, (UPDATES, BATCH)).astype(np.float32) for x in (reward, state, next_state, terminated))
    reward, state, next_state, terminated = columns
    return Batch(state[..., None], action[..., None], reward[..., None], next_state[..., None], terminated)


def uniform_actions() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (UPDATES, BATCH)).astype(np.float32)


class Trained:
    """A learner after a stream of batches."""

    def __init__(self, batches: Batch, **changes) -> None:
        settings = AlgorithmSettings(**{**SETTINGS, **changes})
        self.learner, numbers, train = trainer(settings)
        self.state, reports = train(self.learner.init(numbers, jax.random.PRNGKey(0)), batches)
        self.metrics = dict(zip(self.learner.metrics, np.mean(reports[-100:], axis=0).tolist(), strict=True))

    def q(self, state: float, action: float = 0.3) -> list[float]:
        """Each critic's value."""
        inputs = np.array([state, action], np.float32)
        return [float(self.learner.q_values(critic, inputs)) for critic in np.asarray(self.state.critic.weights)]

    def actions(self, state: float) -> np.ndarray:
        count = 20_000
        noise = np.random.default_rng(0).standard_normal((count, 1)).astype(np.float32)
        observation = np.full((count, 1), state, np.float32)
        return self.learner.policy.act(np.asarray(self.state.actor.weights), observation, noise)[:, 0]


def test_a_one_step_episode_is_worth_its_reward_without_any_entropy():
    trained = Trained(stream(reward=2.0, state=1.0, next_state=1.0, terminated=1, action=uniform_actions()))
    assert trained.q(1.0) == pytest.approx([2.0, 2.0], abs=0.05)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"snapshots": 3, "snapshot_interval": 5},
        {"critic_head": "categorical", "critic_bound": 8.0, "critic_atoms": 33},
        {"network": "batch_norm_mlp", "snapshots": 0, "joint_forward": True},
    ],
    ids=["sac", "averaged", "categorical", "batch norm without target"],
)
def test_an_episode_that_only_time_ends_is_worth_all_its_future(changes):
    """Rewards and entropies."""
    batches = stream(reward=2.0, state=1.0, next_state=1.0, terminated=0, action=uniform_actions())
    trained = Trained(batches, **changes)
    assert trained.metrics["entropy"] == pytest.approx(UNIFORM_ENTROPY, abs=0.05)  # batch statistics are noisy
    worth = 2.0 / (1 - DISCOUNT) + DISCOUNT / (1 - DISCOUNT) * ALPHA * UNIFORM_ENTROPY  # 5 + 0.52
    assert trained.q(1.0) == pytest.approx([worth, worth], abs=0.08)


def test_values_go_back_along_a_chain():
    """The last state has its reward, the one before it the discounted soft value."""
    first = np.arange(BATCH) % 2 == 0
    batches = stream(
        reward=np.where(first, -1.0, 3.0),
        state=np.where(first, -1.0, 1.0),
        next_state=np.where(first, 1.0, 0.0),
        terminated=~first,
        action=uniform_actions(),
    )
    trained = Trained(batches)
    assert trained.q(1.0) == pytest.approx([3.0, 3.0], abs=0.08)
    before = -1.0 + DISCOUNT * (3.0 + ALPHA * UNIFORM_ENTROPY)  # 1.01, of which entropy 0.21
    assert trained.q(-1.0) == pytest.approx([before, before], abs=0.08)


def test_the_policy_prefers_rewarded_actions_as_the_temperature_allows():
    actions = uniform_actions()
    trained = Trained(stream(reward=2 * actions, state=1.0, next_state=1.0, terminated=1, action=actions))
    # The best policy is proportional to exp(2a / α) on [-1, 1]: mean coth(2/α) - α/2
    assert trained.actions(1.0).mean() == pytest.approx(1 / math.tanh(2 / ALPHA) - ALPHA / 2, abs=0.05)
    assert trained.q(1.0, 0.5) == pytest.approx([1.0, 1.0], abs=0.1)


def test_the_learned_temperature_brings_the_target_entropy():
    actions = uniform_actions()
    batches = stream(reward=-3 * actions**2, state=1.0, next_state=1.0, terminated=1, action=actions)
    trained = Trained(batches, temperature="learned", target_entropy=0.0)
    # exp(-3a²/α) is close to a Gaussian of variance α/6, whose entropy ½ log(2πe α/6) is 0 at α = 6/(2πe)
    assert trained.metrics["entropy"] == pytest.approx(0.0, abs=0.05)
    assert trained.metrics["temperature"] == pytest.approx(6 / (2 * math.pi * math.e), rel=0.15)
