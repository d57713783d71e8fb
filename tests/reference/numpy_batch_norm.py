"""Perceptrons with batch normalisation in 64-bit NumPy: every gradient by hand, through the batch's own moments too.

A network is its kernels, its biases (zero where there are none) and the pairs of scale and shift of its normalisations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

EPSILON = 1e-3


@dataclass
class Normalised:
    """One normalisation of a batch, and its gradients."""

    x: np.ndarray
    scale: np.ndarray
    shift: np.ndarray
    ratio: np.ndarray | float = 1.0
    """r of batch renormalisation: the batch's variance is divided by its square."""
    correction: np.ndarray | float = 0.0
    """d: the batch's mean is moved by d · σ / r."""

    def __post_init__(self) -> None:
        self.mean, self.variance = self.x.mean(axis=0), self.x.var(axis=0)
        self.deviation = np.sqrt(self.variance / self.ratio**2 + EPSILON)
        centre = self.mean - self.correction * np.sqrt(self.variance) / self.ratio
        self.normal = (self.x - centre) / self.deviation
        self.output = self.normal * self.scale + self.shift

    def backward(self, d: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Gradients of x, and of scale and shift."""
        affine = (d * self.normal).sum(axis=0), d.sum(axis=0)
        d = d * self.scale
        count, centred = len(self.x), self.x - self.mean
        d_centre = -d.sum(axis=0) / self.deviation
        d_variance = -(d * self.normal).sum(axis=0) / (2 * self.deviation**2 * self.ratio**2)
        d_variance -= d_centre * self.correction / (2 * np.sqrt(self.variance) * self.ratio)
        return d / self.deviation + d_centre / count + d_variance * 2 * centred / count, affine


def renormalisation(x: np.ndarray, running_mean: np.ndarray, running_variance: np.ndarray) -> tuple:
    """R and d of batch renormalisation for a batch, within 3 and 5."""
    deviation = np.sqrt(running_variance + EPSILON)
    ratio = np.clip(np.sqrt(x.var(axis=0) + EPSILON) / deviation, 1 / 3, 3)
    return ratio, np.clip((x.mean(axis=0) - running_mean) / deviation, -5, 5)


def forward_backward(layers: list, x: np.ndarray, d_output: np.ndarray, running: list | None = None) -> tuple:
    """Output of a network, the moments that its normalisations met, and the gradients of its parts and of its input.

    Args:
        layers: kernels, biases and pairs of scale and shift.
        x: of the whole batch.
        d_output: the gradient of the output.
        running: mean and variance of each normalisation, for CrossQ's order with batch renormalisation past its
            warm-up; None is XQC's order with plain batch normalisation.
    """
    kernels, biases, affine = layers

    def normalised(number: int, x: np.ndarray) -> Normalised:
        corrections = (1.0, 0.0) if running is None else renormalisation(x, *running[number])
        return Normalised(x, *affine[number], *corrections)

    norms, inputs, alive = [normalised(0, x)], [], []
    x = norms[0].output
    for number, kernel in enumerate(kernels[:-1]):
        inputs.append(x)
        y = x @ kernel + biases[number]
        if running is None:
            norms.append(normalised(number + 1, y))
            alive.append(norms[-1].output > 0)
            x = np.maximum(norms[-1].output, 0)
        else:
            alive.append(y > 0)
            norms.append(normalised(number + 1, np.maximum(y, 0)))
            x = norms[-1].output
    output = x @ kernels[-1] + biases[-1]

    d_kernels, d_biases, d_affine = [x.T @ d_output], [d_output.sum(axis=0)], []
    d = d_output @ kernels[-1].T
    for number in reversed(range(len(kernels) - 1)):
        if running is None:
            d, pair = norms[number + 1].backward(d * alive[number])
        else:
            d, pair = norms[number + 1].backward(d)
            d = d * alive[number]
        d_affine.insert(0, pair)
        d_biases.insert(0, d.sum(axis=0))
        d_kernels.insert(0, inputs[number].T @ d)
        d = d @ kernels[number].T
    d, pair = norms[0].backward(d)
    moments = [(norm.mean, norm.variance) for norm in norms]
    return output, moments, (d_kernels, d_biases, [pair, *d_affine]), d
