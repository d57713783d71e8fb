"""How far the critics are from the truth: their Q against Monte-Carlo soft returns from the same states and actions.

The measure of Chen et al. 2021 ("Randomized Ensembled Double Q-Learning", section 3): the normalised bias
(Q(s, a) − G) / |mean of G|, its mean and its standard deviation over the state-action pairs of a few episodes of the
policy. G is the soft return that SAC's Q stands for (Eq. 1, Eq. 4): the reward, then the discounted rewards and
entropy bonuses that follow; of the latter those that the targets hold, with n_step each n-th one. The reward is the one
that the critics learn from: its terms weighed as they are at that moment, and scaled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from saclab.algorithm.learner import Learner
from saclab.algorithm.networks.network import Array
from saclab.algorithm.policy import Policy
from saclab.algorithm.targets import reduced_q
from saclab.config import Config
from saclab.environments.checked import CheckedEnvironment
from saclab.environments.reward_terms import split_within_run
from saclab.errors import NonFiniteError
from saclab.training import seeds
from saclab.training.requests import Stopped

NEGLIGIBLE = 0.01  # weight γ^n below which what follows a cut-off state is left out


class Critics(NamedTuple):
    """What is judged, on the host."""

    policy: Policy
    actor: np.ndarray
    """f32[P]."""
    q_values: Callable[..., Array]
    """(one critic f32[P], inputs f32[n, O + A]) -> Q f32[n]."""
    critic: np.ndarray
    """f32[C, P]."""
    alpha: float
    discount: float
    n_step: int
    """Rewards in a target before the value: the entropy of the actions between is not part of it."""
    reduction: str
    """How the policy loss reduces the critics to one Q: the setting actor_reduction."""
    reward_scale: float = 1.0
    """What the critics' rewards are divided by: their Q is that of scaled rewards, so the truth must be too."""
    reward_terms: tuple[str, ...] = ()
    reward_weights: tuple[float, ...] = (1.0,)
    """Of the terms and of the remainder: likewise, the truth is that of the reward as it is weighed now."""

    def q(self, observation: np.ndarray, action: np.ndarray) -> np.ndarray:
        """What the policy is trained to raise: f32[n] for f32[n, O] and f32[n, A]."""
        inputs = np.concatenate([observation, action], axis=1)
        each = np.stack([self.q_values(row, inputs) for row in self.critic])
        reduced: np.ndarray = reduced_q(self.reduction, each)
        return reduced


class QBias(NamedTuple):
    """NaN where no state has a known return."""

    pairs: int
    """State-action pairs that were compared."""
    mean_q: float
    mean_return: float
    """Mean of the Monte-Carlo soft returns."""
    mean_bias: float
    """Mean of (Q − G) / |mean of G|."""
    bias_spread: float
    """Its standard deviation over the pairs."""


class Episode(NamedTuple):
    observation: np.ndarray
    """f32[T, O]."""
    action: np.ndarray
    """f32[T, A]."""
    reward: np.ndarray
    """f64[T], weighed."""
    log_prob: np.ndarray
    """f64[T]."""
    terminated: bool


def critics_of(
    config: Config,
    learner: Learner,
    actor: np.ndarray,
    critic: np.ndarray,
    log_alpha: np.ndarray | float,
    reward_scale: float,
    reward_weights: Sequence[float],
) -> Critics:
    """The critics of a run, and what their Q stands for."""
    settings = config.algorithm
    return Critics(
        learner.policy, actor, learner.q_values, critic, float(np.exp(np.asarray(log_alpha))), settings.discount,
        settings.n_step, settings.actor_reduction, reward_scale, settings.terms_of_reward, tuple(reward_weights),
    )  # fmt: skip


def q_bias_at(
    config: Config, critics: Critics, environment: CheckedEnvironment, evaluation: int, should_stop: Callable[[], bool]
) -> QBias:
    """The bias at a run's evaluation number `evaluation`, which says what is drawn; raises Stopped if `should_stop`."""
    return measure_q_bias(
        critics, environment,
        seeds.integers(config.seed, "q_bias", config.training.q_bias_episodes, evaluation),
        seeds.generator(config.seed, "q_bias", evaluation), should_stop,
    )  # fmt: skip


def measure_q_bias(
    critics: Critics,
    environment: CheckedEnvironment,
    episode_seeds: Sequence[int],
    generator: np.random.Generator,
    should_stop: Callable[[], bool] = lambda: False,
) -> QBias:
    """Play one episode per seed with the stochastic policy, and compare.

    Raises:
        NonFiniteError: if the environment gives an observation or a reward that is not finite.
        Stopped: when `should_stop`.
    """
    episodes = [play(critics, environment, seed, generator, should_stop) for seed in episode_seeds]
    scaled = [episode._replace(reward=episode.reward / critics.reward_scale) for episode in episodes]
    known = [known_returns(episode, critics.alpha, critics.discount, critics.n_step) for episode in scaled]
    returns = np.concatenate(known)
    q = np.concatenate([
        critics.q(episode.observation[: len(part)], episode.action[: len(part)])
        for episode, part in zip(episodes, known, strict=True)
    ])  # fmt: skip
    if len(returns) == 0:
        return QBias(0, math.nan, math.nan, math.nan, math.nan)
    bias = (q - returns) / max(abs(float(returns.mean())), 1e-8)
    return QBias(len(returns), float(q.mean()), float(returns.mean()), float(bias.mean()), float(bias.std()))


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused at the end
def play(
    critics: Critics,
    environment: CheckedEnvironment,
    seed: int,
    generator: np.random.Generator,
    should_stop: Callable[[], bool],
) -> Episode:
    """One episode of the stochastic policy."""
    observation, spec = environment.reset(seed), environment.spec
    rows: list[tuple[np.ndarray, np.ndarray, float, float]] = []
    act: Callable[..., tuple[np.ndarray, np.ndarray]] = critics.policy.sample
    while True:
        if should_stop():
            raise Stopped
        seen = np.array(observation, np.float32)[None]  # the environment may write over its own
        noise = generator.standard_normal((1, spec.action_size), np.float32)
        action, log_prob = act(critics.actor, seen, noise)
        observation, reward, terminated, truncated, info = environment.step(spec.scale_action(action)[0])
        terms = split_within_run(environment.name, reward, info, critics.reward_terms)
        weighed = sum(weight * term for weight, term in zip(critics.reward_weights, terms, strict=True))
        rows.append((seen[0], action[0], weighed, float(log_prob[0])))
        if terminated or truncated:
            break
    if not (np.isfinite(observation).all() and all(np.isfinite([*seen, reward]).all() for seen, _, reward, _ in rows)):
        raise NonFiniteError(
            f"an episode for the Q bias of {environment.name} gave an observation or a reward that is not finite: "
            "check the environment, or wrap it so that it ends the episode before it diverges"
        )
    observations, actions, rewards, log_probs = (np.array(column) for column in zip(*rows, strict=True))
    return Episode(observations, actions, rewards, log_probs, terminated)


def known_returns(episode: Episode, alpha: float, discount: float, n_step: int = 1) -> np.ndarray:
    """Soft returns of the first steps, f64[k]: G_t = Σ_{i<m} γⁱ r_{t+i} + γᵐ (G_{t+m} − α log π(a_{t+m}|s_{t+m})).

    m is n_step, or what is left of the episode, as in the targets: with m of 1 every action's entropy counts, otherwise
    that of each m-th one.

    All of an episode that ended in a terminal state are known. One that was cut off by a time limit says nothing of
    what would have followed, so only its steps count from where on that has a negligible weight.
    """
    steps = len(episode.reward)
    returns, bonus = np.zeros(steps + 1), np.append(-alpha * episode.log_prob, 0.0)
    powers = discount ** np.arange(n_step + 1)
    for step in reversed(range(steps)):
        m = min(n_step, steps - step)
        rewards = powers[:m] @ episode.reward[step : step + m]
        returns[step] = rewards + powers[m] * (returns[step + m] + bonus[step + m])
    if episode.terminated:
        return returns[:-1]
    return returns[: max(0, steps - steps_before_a_cut(discount))]


def steps_before_a_cut(discount: float) -> int:
    """How many steps before a time limit what would have followed it still counts."""
    return math.ceil(math.log(NEGLIGIBLE) / math.log(discount)) if discount > 0 else 1


def nothing_known(discount: float) -> str:
    """What to say of a measurement without pairs."""
    return (
        "the Q bias has nothing to compare with: no episode reached a terminal state, and of one that a time limit "
        f"cuts off the last {steps_before_a_cut(discount)} steps have no known return at discount {discount:g}: longer "
        "episodes, a lower discount or, to save the time, q_bias_episodes 0"
    )
