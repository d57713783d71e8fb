"""Soft Actor-Critic written straight from the paper's equations in 64-bit NumPy: every gradient by hand.

It shares no code with saclab and is laid out otherwise where it can be: parameters are lists of (weights, bias), the
targets of the past are a list that only grows, and noise is handed in. It is slow and plain on purpose.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

Layers = list[tuple[np.ndarray, np.ndarray]]
"""Weights [inputs, outputs] and bias [outputs] of each layer."""


def forward(layers: Layers, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Output of a ReLU perceptron, and the input of each layer."""
    inputs = []
    for number, (weights, bias) in enumerate(layers):
        inputs.append(x)
        x = x @ weights + bias
        if number < len(layers) - 1:
            x = np.maximum(x, 0.0)
    return x, inputs


def backward(layers: Layers, inputs: list[np.ndarray], d_output: np.ndarray) -> tuple[Layers, np.ndarray]:
    """Gradients of the layers and of the network's input."""
    gradients: Layers = []
    for number in reversed(range(len(layers))):
        weights, _ = layers[number]
        gradients.insert(0, (inputs[number].T @ d_output, d_output.sum(axis=0)))
        d_output = d_output @ weights.T
        if number > 0:
            d_output = d_output * (inputs[number] > 0)
    return gradients, d_output


@dataclass
class Adam:
    """Kingma and Ba, Algorithm 1."""

    learning_rate: float
    first: list[np.ndarray] = field(default_factory=list)
    second: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def step(self, parameters: list[np.ndarray], gradients: list[np.ndarray]) -> list[np.ndarray]:
        if not self.first:
            self.first = [np.zeros_like(p) for p in parameters]
            self.second = [np.zeros_like(p) for p in parameters]
        self.count += 1
        changed = []
        for i, (parameter, gradient) in enumerate(zip(parameters, gradients, strict=True)):
            self.first[i] = 0.9 * self.first[i] + 0.1 * gradient
            self.second[i] = 0.999 * self.second[i] + 0.001 * gradient**2
            mean = self.first[i] / (1 - 0.9**self.count)
            variance = self.second[i] / (1 - 0.999**self.count)
            changed.append(parameter - self.learning_rate * mean / (np.sqrt(variance) + 1e-8))
        return changed

    def step_layers(self, layers: Layers, gradients: Layers) -> Layers:
        return paired(self.step([x for layer in layers for x in layer], [x for layer in gradients for x in layer]))


def paired(flat: list[np.ndarray]) -> Layers:
    return list(zip(flat[::2], flat[1::2], strict=True))


class NumpySac:
    """The state of a learner and its update."""

    def __init__(
        self,
        actor: Layers,
        critics: list[Layers],
        *,
        discount: float,
        polyak_rate: float,
        critic_learning_rate: float,
        actor_learning_rate: float,
        temperature_learning_rate: float,
        initial_temperature: float,
        temperature: str,
        temperature_gradient: str,
        target_entropy: float,
        snapshots: int,
        snapshot_interval: int,
        entropy_window: int,
        target_reduction: str,
        actor_reduction: str,
        log_std_minimum: float,
        log_std_maximum: float,
        batch_size: int,
    ) -> None:
        self.actor, self.critics = actor, critics
        self.discount, self.polyak_rate = discount, polyak_rate
        self.log_alpha = math.log(initial_temperature)
        self.learned, self.temperature_gradient = temperature == "learned", temperature_gradient
        self.target_entropy = target_entropy
        self.snapshots, self.snapshot_interval = snapshots, snapshot_interval
        self.target_reduction, self.actor_reduction = target_reduction, actor_reduction
        self.log_std_range = log_std_minimum, log_std_maximum
        self.targets: list[list[Layers]] = [critics]
        """The target critics after 0, 1, 2, … updates."""
        self.entropy_terms = deque([np.zeros(batch_size)] * entropy_window, maxlen=entropy_window)
        self.actor_adam = Adam(actor_learning_rate)
        self.critic_adams = [Adam(critic_learning_rate) for _ in critics]
        self.temperature_adam = Adam(temperature_learning_rate)

    def averaged_targets(self) -> list[list[Layers]]:
        """The K target critics of Eq. 9: the present one, then those left behind, newest first.

        One is left behind at every `snapshot_interval`-th update, as it was before that update; before there are
        enough of them, the first target stands for the missing ones.
        """
        updates = len(self.targets) - 1
        marks = updates // self.snapshot_interval
        left_behind = [(marks - back) * self.snapshot_interval - 1 for back in range(self.snapshots - 1)]
        return [self.targets[-1]] + [self.targets[max(0, when)] for when in left_behind]

    def sample(self, observation: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple]:
        """Actions, log-densities, and what the backward pass needs (Appendix A)."""
        output, inputs = forward(self.actor, observation)
        mean, raw = np.split(output, 2, axis=1)
        log_std = np.clip(raw, *self.log_std_range)
        u = mean + np.exp(log_std) * noise
        action = np.tanh(u)
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = (gaussian - np.log(1 - action**2)).sum(axis=1)
        inside = (raw > self.log_std_range[0]) & (raw < self.log_std_range[1])
        return action, log_prob, (inputs, log_std, inside)

    def update(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        next_observation: np.ndarray,
        terminated: np.ndarray,
        next_noise: np.ndarray,
        actor_noise: np.ndarray,
    ) -> dict[str, float]:
        """One update of critics, actor, temperature, target; what `Metrics` reports."""
        batch = len(reward)
        alpha = math.exp(self.log_alpha)

        # Eq. 4 and 9: the value of the next state.
        next_action, next_log_prob, _ = self.sample(next_observation, next_noise)
        values = []
        for target in self.averaged_targets():
            q = [forward(layers, np.hstack([next_observation, next_action]))[0][:, 0] for layers in target]
            values.append(np.min(q, axis=0) if self.target_reduction == "minimum" else np.mean(q, axis=0))
        self.entropy_terms.append(alpha * next_log_prob)
        value = sum(values) / len(values) - sum(self.entropy_terms) / len(self.entropy_terms)
        y = reward + self.discount * (1 - terminated) * value

        # Eq. 3: each critic towards y.
        critic_loss, predictions, changed = 0.0, [], []
        for layers, adam in zip(self.critics, self.critic_adams, strict=True):
            q, inputs = forward(layers, np.hstack([observation, action]))
            error = q[:, 0] - y
            critic_loss += np.mean(error**2) / 2
            gradients, _ = backward(layers, inputs, error[:, None] / batch)
            changed.append(adam.step_layers(layers, gradients))
            predictions.append(q[:, 0])
        self.critics = changed

        # Eq. 5 on the changed critics: the actor, through the reparametrised action.
        sampled, log_prob, (inputs, log_std, inside) = self.sample(observation, actor_noise)
        passes = [forward(layers, np.hstack([observation, sampled])) for layers in self.critics]
        q = np.array([output[:, 0] for output, _ in passes])
        if self.actor_reduction == "minimum":
            share = (np.arange(len(q))[:, None] == q.argmin(axis=0)).astype(float)
        else:
            share = np.full_like(q, 1 / len(q))
        actor_loss = np.mean(alpha * log_prob - (share * q).sum(axis=0))
        d_action = np.zeros_like(sampled)
        for layers, (_, critic_inputs), weight in zip(self.critics, passes, share, strict=True):
            _, d_input = backward(layers, critic_inputs, -weight[:, None] / batch)
            d_action += d_input[:, observation.shape[1] :]
        d_u = d_action * (1 - sampled**2) + alpha / batch * 2 * sampled  # d log π / du = 2 tanh u
        d_log_std = (d_u * np.exp(log_std) * actor_noise - alpha / batch) * inside
        gradients, _ = backward(self.actor, inputs, np.hstack([d_u, d_log_std]))
        self.actor = self.actor_adam.step_layers(self.actor, gradients)

        # Eq. 8: the temperature, from the log-densities of the actor before its change.
        temperature_loss = 0.0
        if self.learned:
            excess = np.mean(-log_prob - self.target_entropy)
            on_alpha = self.temperature_gradient == "alpha"
            temperature_loss = (alpha if on_alpha else self.log_alpha) * excess
            gradient = alpha * excess if on_alpha else excess  # both with respect to log α
            (self.log_alpha,) = self.temperature_adam.step([np.array(self.log_alpha)], [np.array(gradient)])

        # Eq. 2: the target moves towards the changed critics.
        self.targets.append(
            [
                [
                    tuple((1 - self.polyak_rate) * old + self.polyak_rate * new for old, new in zip(before, now))
                    for before, now in zip(target, critic)
                ]
                for target, critic in zip(self.targets[-1], self.critics)
            ]
        )
        return {
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            "temperature_loss": temperature_loss,
            "temperature": alpha,
            "entropy": -np.mean(log_prob),
            "q_mean": np.mean(predictions),
            "q_spread": np.mean(np.std(predictions, axis=0)),
            "target_mean": np.mean(y),
            "snapshot_spread": np.mean(np.std(values, axis=0)),
        }
