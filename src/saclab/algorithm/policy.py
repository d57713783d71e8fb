"""The tanh-Gaussian policy (Appendix A of the paper). Every function takes NumPy as well as JAX arrays."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from saclab.algorithm.networks import policy_network
from saclab.algorithm.networks.network import Array, Network
from saclab.settings import AlgorithmSettings


class Policy(NamedTuple):
    """A network whose output is the mean and log standard deviation of a Gaussian, squashed by tanh."""

    network: Network
    log_std_minimum: float
    log_std_maximum: float
    bounded: Callable[[Array, float, float], Array]
    """One of BOUNDINGS."""

    def distribution(self, parameters: Array, observation: Array) -> tuple[Array, Array]:
        """Mean and log standard deviation before the tanh: two f32[..., A] for f32[..., O]."""
        return self._distribution(self.network.apply(parameters, observation))

    def _distribution(self, output: Array) -> tuple[Array, Array]:
        size = output.shape[-1] // 2
        return output[..., :size], self.bounded(output[..., size:], self.log_std_minimum, self.log_std_maximum)

    def mode(self, parameters: Array, observation: Array) -> Array:
        """The deterministic action, tanh of the mean: f32[..., A] in [-1, 1]."""
        output = self.network.apply(parameters, observation)
        mean = output[..., : output.shape[-1] // 2]
        return mean.__array_namespace__().tanh(mean)

    def act(self, parameters: Array, observation: Array, noise: Array) -> Array:
        """The action of `sample` without its log-density: f32[..., A] in [-1, 1]."""
        mean, log_std = self.distribution(parameters, observation)
        xp = mean.__array_namespace__()
        return xp.tanh(mean + xp.exp(log_std) * noise)

    def sample(self, parameters: Array, observation: Array, noise: Array) -> tuple[Array, Array]:
        """An action f32[..., A] in [-1, 1] for standard normal `noise` f32[..., A], and its log-density f32[...]."""
        mean, log_std = self.distribution(parameters, observation)
        return squash(mean, log_std, noise)

    def train_sample(self, parameters: Array, observation: Array, noise: Array, key: Array) -> tuple[Array, ...]:
        """Do as `sample` while the network learns; also the running statistics f32[S] that follow.

        Rows of the observations beyond those of `noise` only enter the statistics of the batch.
        """
        output, statistics = self.network.train(parameters, observation, key=key)
        return *squash(*self._distribution(output[: len(noise)]), noise), statistics


def clipped(raw: Array, lowest: float, highest: float) -> Array:
    xp = raw.__array_namespace__()
    return xp.minimum(xp.maximum(raw, lowest), highest)  # NumPy's clip takes longer


def spanned(raw: Array, lowest: float, highest: float) -> Array:
    """Between the bounds by a tanh; 0 lies in their middle."""
    return lowest + 0.5 * (highest - lowest) * (1 + raw.__array_namespace__().tanh(raw))


BOUNDINGS: dict[str, Callable[[Array, float, float], Array]] = {"clip": clipped, "tanh": spanned}
"""Name -> (raw log standard deviation, its bounds) -> log standard deviation."""


def squash(mean: Array, log_std: Array, noise: Array) -> tuple[Array, Array]:
    """tanh(mean + std·noise) and its log-density (Eq. 14, with the change of variables of the tanh).

    The correction log(1 − tanh²u) is written 2(log 2 − u − softplus(−2u)), which is exact for every u; the usual
    log(1 − tanh²u + ε) is wrong by more the closer an action lies to a bound.
    """
    xp = mean.__array_namespace__()
    u = mean + xp.exp(log_std) * noise
    gaussian = -0.5 * noise * noise - log_std - 0.5 * math.log(2 * math.pi)
    log_slope = 2 * (math.log(2) - u - xp.logaddexp(xp.zeros_like(u), -2 * u))
    return xp.tanh(u), xp.sum(gaussian - log_slope, axis=-1)


def make_policy(settings: AlgorithmSettings, observation_size: int, action_size: int) -> Policy:
    """The policy for observations f32[..., observation_size] and actions f32[..., action_size]."""
    network = policy_network(settings, observation_size, 2 * action_size)
    return Policy(network, settings.log_std_minimum, settings.log_std_maximum, BOUNDINGS[settings.log_std_bounding])
