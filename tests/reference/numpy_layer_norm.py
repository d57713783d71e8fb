"""A perceptron with dropout and layer normalisation in 64-bit NumPy: every gradient by hand.

Its layers are pairs: weights and bias of each dense layer, then scale and shift of each normalisation.
"""

from __future__ import annotations

import numpy as np

from .numpy_sac import Layers

Masks = list[np.ndarray]
"""What the outputs of each hidden layer are multiplied by."""


def forward(layers: Layers, x: np.ndarray, masks: Masks | None = None) -> tuple[np.ndarray, list[tuple]]:
    """Output, and what the backward pass needs of each layer."""
    hidden, kept = len(layers) // 2, []
    for number in range(hidden):
        (weights, bias), (scale, shift) = layers[number], layers[hidden + 1 + number]
        mask = 1.0 if masks is None else masks[number]
        dropped = (x @ weights + bias) * mask
        deviation = np.sqrt(dropped.var(axis=1, keepdims=True) + 1e-5)
        normal = (dropped - dropped.mean(axis=1, keepdims=True)) / deviation
        after = normal * scale + shift
        kept.append((x, mask, deviation, normal, after > 0))
        x = np.maximum(after, 0.0)
    weights, bias = layers[hidden]
    return x @ weights + bias, [*kept, (x,)]


def backward(layers: Layers, kept: list[tuple], d_output: np.ndarray) -> tuple[Layers, np.ndarray]:
    """Gradients of the layers, in their order, and of the network's input."""
    hidden = len(layers) // 2
    dense, affine = [(kept[-1][0].T @ d_output, d_output.sum(axis=0))], []
    d = d_output @ layers[hidden][0].T
    for number in reversed(range(hidden)):
        x, mask, deviation, normal, alive = kept[number]
        d = d * alive
        affine.insert(0, ((d * normal).sum(axis=0), d.sum(axis=0)))
        d = d * layers[hidden + 1 + number][0]
        d = (d - d.mean(axis=1, keepdims=True) - normal * (d * normal).mean(axis=1, keepdims=True)) / deviation * mask
        dense.insert(0, (x.T @ d, d.sum(axis=0)))
        d = d @ layers[number][0].T
    return dense + affine, d
