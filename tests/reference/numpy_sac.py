"""Soft Actor-Critic written straight from the paper's equations in 64-bit NumPy: every gradient of a loss by hand.

It shares no code with saclab but the names of the settings, and is laid out otherwise where it can be: each critic is a
vector of its own, the targets of the past are a list that only grows, and noise is handed in. It is slow and plain on
purpose. `numpy_networks.py` has the networks.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from saclab.settings import AlgorithmSettings


@dataclass
class Adam:
    """Kingma and Ba, Algorithm 1, with a schedule of the learning rate by its own steps."""

    learning_rate: float
    betas: tuple[float, float] = (0.9, 0.999)
    share: Callable[[int], float] = lambda step: 1.0
    """What is left of the learning rate after so many steps."""
    first: np.ndarray | float = 0.0
    second: np.ndarray | float = 0.0
    count: int = 0

    def step(self, parameters: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        rate, (a, b) = self.learning_rate * self.share(self.count), self.betas
        self.count += 1
        self.first = a * self.first + (1 - a) * gradient
        self.second = b * self.second + (1 - b) * gradient**2
        mean = self.first / (1 - a**self.count)
        variance = self.second / (1 - b**self.count)
        return parameters - rate * mean / (np.sqrt(variance) + 1e-8)


def schedule(kind: str, last: float, steps: int) -> Callable[[int], float]:
    """The share of a learning rate that is left after a number of steps."""

    def share(step: int) -> float:
        done = min(step / steps, 1)
        if kind == "linear":
            return 1 + done * (last - 1)
        if kind == "cosine":
            return last + (1 - last) * (1 + math.cos(math.pi * done)) / 2
        return 1.0

    return share


class ScalarHead:
    """Q is the one output."""

    def q(self, outputs: np.ndarray) -> np.ndarray:
        return outputs[:, 0]

    def predict(self, outputs: np.ndarray) -> np.ndarray:
        return outputs

    q_of_prediction = q

    def target(self, prediction: np.ndarray, reward, discount, entropy_term) -> np.ndarray:
        return (reward + discount * (prediction[:, 0] - entropy_term))[:, None]

    def loss(self, outputs: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
        """Eq. 3 of one critic, and its gradient with respect to the outputs."""
        error = outputs - target
        return float(np.mean(error**2) / 2), error / len(error)

    def d_q(self, outputs: np.ndarray) -> np.ndarray:
        """The gradient of each row's Q with respect to its outputs."""
        return np.ones_like(outputs)


class CategoricalHead:
    """The outputs are logits of evenly spaced values."""

    def __init__(self, atoms: int, bound: float) -> None:
        self.values = np.array([-bound + 2 * bound * i / (atoms - 1) for i in range(atoms)])

    def predict(self, outputs: np.ndarray) -> np.ndarray:
        e = np.exp(outputs)
        return e / e.sum(axis=1, keepdims=True)

    def q_of_prediction(self, probability: np.ndarray) -> np.ndarray:
        return probability @ self.values

    def q(self, outputs: np.ndarray) -> np.ndarray:
        return self.predict(outputs) @ self.values

    def target(self, prediction: np.ndarray, reward, discount, entropy_term) -> np.ndarray:
        """C51's projection, row by row and value by value."""
        target, step = np.zeros_like(prediction), self.values[1] - self.values[0]
        for row in range(len(prediction)):
            for i, probability in enumerate(prediction[row]):
                moved = reward[row] + discount[row] * (self.values[i] - entropy_term[row])
                place = (min(max(moved, self.values[0]), self.values[-1]) - self.values[0]) / step
                below = min(math.floor(place), len(self.values) - 2)
                target[row, below] += probability * (below + 1 - place)
                target[row, below + 1] += probability * (place - below)
        return target

    def loss(self, outputs: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
        probability = self.predict(outputs)
        return float(-(target * np.log(probability)).sum(axis=1).mean()), (probability - target) / len(outputs)

    def d_q(self, outputs: np.ndarray) -> np.ndarray:
        probability = self.predict(outputs)
        return probability * (self.values - (probability @ self.values)[:, None])


class QuantileHead:
    """The outputs are quantiles at the levels (i + ½)/n."""

    def __init__(self, atoms: int) -> None:
        self.levels = [(i + 0.5) / atoms for i in range(atoms)]

    def predict(self, outputs: np.ndarray) -> np.ndarray:
        return outputs

    def q(self, outputs: np.ndarray) -> np.ndarray:
        return outputs.mean(axis=1)

    q_of_prediction = q

    def target(self, prediction: np.ndarray, reward, discount, entropy_term) -> np.ndarray:
        return reward[:, None] + discount[:, None] * (prediction - entropy_term[:, None])

    def loss(self, outputs: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
        """Row by row, quantile by quantile, number by number."""
        total, slope = 0.0, np.zeros_like(outputs)
        pairs = outputs.size * target.shape[1]
        for row, quantiles in enumerate(outputs):
            for i, (quantile, level) in enumerate(zip(quantiles, self.levels, strict=True)):
                for error in target[row] - quantile:
                    weight = abs(level - (error < 0))
                    total += weight * (error**2 / 2 if abs(error) <= 1 else abs(error) - 0.5) / pairs
                    slope[row, i] -= weight * max(-1.0, min(1.0, error)) / pairs
        return total, slope

    def d_q(self, outputs: np.ndarray) -> np.ndarray:
        return np.full_like(outputs, 1 / outputs.shape[1])


def reduced(name: str, predictions: np.ndarray, q: np.ndarray, dropped: int) -> np.ndarray:
    """One prediction of all critics', [critics, rows, n]."""
    if name == "minimum":
        return predictions[q.argmin(axis=0), np.arange(q.shape[1])]
    if name == "mean":
        return predictions.mean(axis=0)
    rows = [sorted(value for critic in predictions[:, row] for value in critic) for row in range(q.shape[1])]
    return np.array([values[: len(values) - dropped * len(predictions)] for values in rows])


@dataclass
class Draws:
    """What an update draws at random."""

    next_noise: np.ndarray
    """Of the next actions, [rows, action]."""
    actor_noise: np.ndarray
    chosen: list[int]
    """The critics that value the next state."""
    critic_masks: list
    """Dropout of each critic that learns, as its network takes it."""
    target_masks: list
    """Of each chosen critic, in every snapshot."""
    actor_masks: list
    """Of each critic in the policy's loss."""


class NumpySac:
    """The state of a learner and its update."""

    def __init__(
        self,
        networks: tuple[Any, Any],
        actor: np.ndarray,
        critics: list[np.ndarray],
        settings: AlgorithmSettings,
        target_entropy: float,
        updates: int,
    ) -> None:
        """`networks` are the actor's and each critic's; `updates` is the length of the learning rates' schedule."""
        self.actor_network, self.critic_network = networks
        self.actor, self.critics, self.settings = actor, critics, settings
        self.log_alpha = math.log(settings.initial_temperature)
        self.target_entropy = target_entropy
        atoms, bound = settings.critic_atoms, settings.critic_bound
        heads = {"scalar": ScalarHead, "categorical": lambda: CategoricalHead(atoms, bound)}
        self.head = (heads | {"quantile": lambda: QuantileHead(atoms)})[settings.critic_head]()
        self.targets: list[list[np.ndarray]] = [critics]
        """The target critics after 0, 1, 2, … updates."""
        window = settings.entropy_window
        self.entropy_terms = deque([np.zeros(settings.batch_size)] * window, maxlen=window)
        betas = settings.adam_beta_1, settings.adam_beta_2
        share = schedule(settings.learning_rate_schedule, settings.final_learning_rate_share, updates)
        self.actor_adam = Adam(settings.actor_learning_rate, betas, share)
        self.critic_adams = [Adam(settings.critic_learning_rate, betas, share) for _ in critics]
        self.temperature_adam = Adam(settings.temperature_learning_rate, betas, share)
        self.report: dict[str, float] = {}
        self.updates = 0

    def averaged_targets(self) -> list[list[np.ndarray]]:
        """The K target critics of Eq. 9: the present one, then those left behind, newest first.

        One is left behind at every `snapshot_interval`-th update, as it was before that update; before there are
        enough of them, the first target stands for the missing ones.
        """
        count, interval = self.settings.snapshots, self.settings.snapshot_interval
        if count == 0:
            return [self.critics]
        marks = (len(self.targets) - 1) // interval
        left_behind = [(marks - back) * interval - 1 for back in range(count - 1)]
        return [self.targets[-1]] + [self.targets[max(0, when)] for when in left_behind]

    def sample(self, output: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Actions, log-densities, log deviations, and how these change with the network's outputs (Appendix A)."""
        mean, raw = np.split(output, 2, axis=1)
        low, high = self.settings.log_std_minimum, self.settings.log_std_maximum
        if self.settings.log_std_bounding == "clip":
            log_std, slope = np.clip(raw, low, high), (raw > low) & (raw < high)
        else:
            log_std = low + (high - low) * (np.tanh(raw) + 1) / 2
            slope = (high - low) / 2 / np.cosh(raw) ** 2
        u = mean + np.exp(log_std) * noise
        action = np.tanh(u)
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = (gaussian + 2 * np.log(np.cosh(u))).sum(axis=1)  # d tanh u / du = 1 / cosh² u
        return action, log_prob, log_std, slope

    def update(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        next_observation: np.ndarray,
        terminated: np.ndarray,
        draws: Draws,
    ) -> dict[str, float]:
        """One update of everything; what it reports."""
        self.report["temperature"] = math.exp(self.log_alpha)
        acts = self.updates % self.settings.actor_interval == 0
        for part in self.settings.update_order:
            if part == "critic":
                self.update_critic(observation, action, reward, next_observation, terminated, draws)
            if part == "actor" and acts:
                self.update_actor(observation, next_observation, draws)
            if part == "temperature" and acts:
                self.update_temperature()
            if part == "targets":
                self.update_targets()
        self.updates += 1
        return self.report

    def update_critic(self, observation, action, reward, next_observation, terminated, draws) -> None:
        settings, network = self.settings, self.critic_network
        # Eq. 4 and 9: the value of the next state.
        acts = self.actor_network.forward(self.actor, next_observation, learns=False)
        next_action, next_log_prob, *_ = self.sample(acts.outputs, draws.next_noise)
        now, then = np.hstack([observation, action]), np.hstack([next_observation, next_action])
        rows, joint = len(now), settings.joint_forward
        values = []
        for target in self.averaged_targets():
            seen = np.vstack([now, then]) if joint else then
            outputs = [
                network.forward(target[i], seen, True, masks).outputs[-rows:]
                for i, masks in zip(draws.chosen, draws.target_masks, strict=True)
            ]
            predictions = np.array([self.head.predict(output) for output in outputs])
            q = np.array([self.head.q(output) for output in outputs])
            values.append(reduced(settings.target_reduction, predictions, q, settings.dropped_quantiles))
        prediction = sum(values) / len(values)
        self.entropy_terms.append(math.exp(self.log_alpha) * next_log_prob)
        entropy_term = sum(self.entropy_terms) / len(self.entropy_terms)
        y = self.head.target(prediction, reward, settings.discount * (1 - terminated), entropy_term)

        # Eq. 3: each critic towards y. Rows of the next state in the same pass only count for its statistics.
        critic_loss, predicted, changed = 0.0, [], []
        for critic, adam, masks in zip(self.critics, self.critic_adams, draws.critic_masks, strict=True):
            learns = network.forward(critic, np.vstack([now, then]) if joint else now, True, masks)
            loss, d_outputs = self.head.loss(learns.outputs[:rows], y)
            gradient = learns.gradient(padded(d_outputs, len(learns.outputs)))
            changed.append(stepped(network, adam, critic, gradient, learns.statistics))
            predicted.append(self.head.q(learns.outputs[:rows]))
            critic_loss += loss
        self.critics = changed
        self.report |= {
            "critic_loss": critic_loss,
            "q_mean": np.mean(predicted),
            "q_spread": np.mean(np.std(predicted, axis=0)),
            "target_mean": np.mean(self.head.q_of_prediction(y)),
            "snapshot_spread": np.mean(np.std([self.head.q_of_prediction(one) for one in values], axis=0)),
        }

    def update_actor(self, observation, next_observation, draws) -> None:
        # Eq. 5 on the critics as they are now: the actor, through the reparametrised action.
        rows, alpha, noise = len(observation), math.exp(self.log_alpha), draws.actor_noise
        seen = np.vstack([observation, next_observation]) if self.settings.actor_joint_forward else observation
        learns = self.actor_network.forward(self.actor, seen, learns=True)
        sampled, log_prob, log_std, slope = self.sample(learns.outputs[:rows], noise)
        critics_learn = self.settings.critic_mode_for_actor == "training"
        passes = [
            self.critic_network.forward(critic, np.hstack([observation, sampled]), critics_learn, masks)
            for critic, masks in zip(self.critics, draws.actor_masks, strict=True)
        ]
        q = np.array([self.head.q(each.outputs) for each in passes])
        if self.settings.actor_reduction == "minimum":
            share = (np.arange(len(q))[:, None] == q.argmin(axis=0)).astype(float)
        else:
            share = np.full_like(q, 1 / len(q))
        d_action = np.zeros_like(sampled)
        for each, weight in zip(passes, share, strict=True):
            d_outputs = -weight[:, None] / rows * self.head.d_q(each.outputs)
            d_action += each.input_gradient(d_outputs)[:, observation.shape[1] :]
        d_u = d_action * (1 - sampled**2) + alpha / rows * 2 * sampled  # d log π / du = 2 tanh u
        d_raw = (d_u * np.exp(log_std) * noise - alpha / rows) * slope
        gradient = learns.gradient(padded(np.hstack([d_u, d_raw]), len(seen)))
        self.actor = stepped(self.actor_network, self.actor_adam, self.actor, gradient, learns.statistics)
        self.report["actor_loss"] = np.mean(alpha * log_prob - (share * q).sum(axis=0))
        self.report["entropy"] = -np.mean(log_prob)

    def update_temperature(self) -> None:
        # Eq. 8: the temperature, from the log-densities of the actor before its change.
        if self.settings.temperature == "fixed":
            self.report["temperature_loss"] = 0.0
            return
        alpha, excess = math.exp(self.log_alpha), self.report["entropy"] - self.target_entropy
        on_alpha = self.settings.temperature_gradient == "alpha"
        self.report["temperature_loss"] = (alpha if on_alpha else self.log_alpha) * excess
        gradient = alpha * excess if on_alpha else excess  # both with respect to log α
        self.log_alpha = self.temperature_adam.step(self.log_alpha, gradient)

    def update_targets(self) -> None:
        # Eq. 2: the target moves towards the changed critics.
        rate = self.settings.polyak_rate
        pairs = zip(self.targets[-1], self.critics, strict=True)
        self.targets.append([(1 - rate) * target + rate * critic for target, critic in pairs])


def padded(rows: np.ndarray, count: int) -> np.ndarray:
    """With rows of zeros behind them, `count` in all."""
    return np.vstack([rows, np.zeros((count - len(rows), rows.shape[1]))])


def stepped(network: Any, adam: Adam, vector: np.ndarray, gradient: np.ndarray, statistics: np.ndarray) -> np.ndarray:
    """A network's vector after a step of Adam, its projection, and with the running statistics that follow."""
    vector = network.project(adam.step(vector, gradient))
    return np.concatenate([vector[: len(vector) - len(statistics)], statistics])
