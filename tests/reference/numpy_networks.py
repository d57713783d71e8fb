"""The networks in 64-bit NumPy, each written straight down from its paper, with the gradients of their outputs.

Those of the perceptrons are by hand. The others take theirs by complex steps (Squire and Trapp 1998): the imaginary
part of f(x + ih) is h·f′(x) to the last bit, and nothing about the slope is written down that could share a mistake
with saclab. A network is a vector of parameters, and behind them running statistics; of a batch it learns from, its
forward pass tells the statistics that follow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

Parts = dict[str, np.ndarray]
NOTHING = np.zeros(0)


class Pass(NamedTuple):
    """A forward pass."""

    outputs: np.ndarray
    gradient: Callable[[np.ndarray], np.ndarray]
    """Gradient of the outputs -> of the vector."""
    input_gradient: Callable[[np.ndarray], np.ndarray]
    """Gradient of the outputs -> of the input."""
    statistics: np.ndarray = NOTHING
    """The running ones that follow, as they lie at the vector's end."""


class Perceptron:
    """Dense -> ReLU per hidden layer -> Dense. Weights and bias of each layer, one after the other."""

    statistics_size = 0

    def __init__(self, sizes: tuple[int, ...], projected: bool = False) -> None:
        self.sizes, self.projected = sizes, projected

    def unpack(self, vector: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        layers = []
        for inputs, outputs in itertools.pairwise(self.sizes):
            weights, bias, vector = np.split(vector, [inputs * outputs, (inputs + 1) * outputs])
            layers.append((weights.reshape(inputs, outputs), bias))
        return layers

    def forward(self, vector: np.ndarray, x: np.ndarray, learns: bool, masks: None = None) -> Pass:
        layers, inputs = self.unpack(vector), []
        for number, (weights, bias) in enumerate(layers):
            inputs.append(x)
            x = x @ weights + bias
            if number < len(layers) - 1:
                x = np.maximum(x, 0.0)

        def backward(d_output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            gradients = []
            for number in reversed(range(len(layers))):
                gradients[:0] = [inputs[number].T @ d_output, d_output.sum(axis=0)]
                d_output = d_output @ layers[number][0].T
                if number > 0:
                    d_output = d_output * (inputs[number] > 0)
            return packed(gradients), d_output

        return Pass(x, lambda d: backward(d)[0], lambda d: backward(d)[1])

    def project(self, vector: np.ndarray) -> np.ndarray:
        """Weights with columns of length 1."""
        if not self.projected:
            return vector
        layers = self.unpack(vector)
        dense = packed([part for weights, bias in layers for part in (unit_columns(weights), bias)])
        return np.concatenate([dense, vector[len(dense) :]])


class LayerNormPerceptron(Perceptron):
    """Dense -> dropout -> layer normalisation -> ReLU per hidden layer -> Dense.

    Behind the dense layers lie scale and shift of each normalisation. A mask is what the outputs of a hidden layer are
    multiplied by.
    """

    def affine(self, vector: np.ndarray) -> list[np.ndarray]:
        """Scale and shift of each normalisation, f64[2, W]."""
        widths = self.sizes[1:-1]
        pairs = np.split(vector[-2 * sum(widths) :], np.cumsum(widths)[:-1] * 2)
        return [pair.reshape(2, -1) for pair in pairs]

    def forward(self, vector: np.ndarray, x: np.ndarray, learns: bool, masks: list[np.ndarray] | None = None) -> Pass:
        *hidden, (last, last_bias) = self.unpack(vector)
        affine, kept = self.affine(vector), []
        for number, (weights, bias) in enumerate(hidden):
            mask = 1.0 if masks is None else masks[number]
            dropped = (x @ weights + bias) * mask
            deviation = np.sqrt(dropped.var(axis=1, keepdims=True) + 1e-5)
            normal = (dropped - dropped.mean(axis=1, keepdims=True)) / deviation
            after = normal * affine[number][0] + affine[number][1]
            kept.append((x, mask, deviation, normal, after > 0))
            x = np.maximum(after, 0.0)

        def backward(d_output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            dense, slopes = [x.T @ d_output, d_output.sum(axis=0)], []
            d = d_output @ last.T
            for number in reversed(range(len(hidden))):
                below, mask, deviation, normal, alive = kept[number]
                d = d * alive
                slopes[:0] = [(d * normal).sum(axis=0), d.sum(axis=0)]
                d = d * affine[number][0]
                d = d - d.mean(axis=1, keepdims=True) - normal * (d * normal).mean(axis=1, keepdims=True)
                d = d / deviation * mask
                dense[:0] = [below.T @ d, d.sum(axis=0)]
                d = d @ hidden[number][0].T
            return packed(dense + slopes), d

        return Pass(x @ last + last_bias, lambda d: backward(d)[0], lambda d: backward(d)[1])


def packed(arrays: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(array) for array in arrays])


def unit_columns(weights: np.ndarray) -> np.ndarray:
    return weights / np.sqrt((weights**2).sum(axis=0))


def slopes(function: Callable[[np.ndarray], np.ndarray], point: np.ndarray, count: int | None = None) -> np.ndarray:
    """The gradient of a number at `point`, with respect to its first `count` numbers; 0 for the others."""
    gradient = np.zeros(point.size)
    for index in range(point.size if count is None else count):
        moved = point.astype(np.complex128)
        moved.flat[index] += 1e-30j
        gradient[index] = function(moved).imag / 1e-30
    return gradient.reshape(point.shape)


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(x.real > 0, x, 0)


def moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of each column."""
    mean = x.mean(axis=0)
    return mean, ((x - mean) ** 2).mean(axis=0)


@dataclass
class Blocks:
    """A network of named parts: its outputs by `outputs_of`, and gradients by complex steps."""

    shapes: dict[str, tuple[int, ...]]
    """Of the parts, in the vector's order."""
    projected: bool = False
    """Whether each step ends on the sphere."""

    def outputs_of(self, parts: Parts, x: np.ndarray, learns: bool) -> tuple[np.ndarray, Parts]:
        """Outputs, and the running statistics that follow."""
        raise NotImplementedError

    def unpack(self, vector: np.ndarray) -> Parts:
        ends = np.cumsum([math.prod(shape) for shape in self.shapes.values()])
        assert ends[-1] == len(vector)
        pieces = np.split(vector, ends[:-1])
        return {name: piece.reshape(shape) for (name, shape), piece in zip(self.shapes.items(), pieces, strict=True)}

    @property
    def statistics(self) -> list[str]:
        return [name for name in self.shapes if name.endswith("running") or name == "updates"]

    @property
    def statistics_size(self) -> int:
        return sum(math.prod(self.shapes[name]) for name in self.statistics)

    def forward(self, vector: np.ndarray, x: np.ndarray, learns: bool, masks: None = None) -> Pass:
        outputs, running = self.outputs_of(self.unpack(vector), x, learns)
        followed = packed([running[name] for name in self.statistics]) if running else NOTHING
        learnt = len(vector) - self.statistics_size

        def total(vector: np.ndarray, x: np.ndarray, d: np.ndarray) -> np.ndarray:
            return (self.outputs_of(self.unpack(vector), x, learns)[0] * d).sum()

        return Pass(
            outputs,
            lambda d: slopes(lambda moved: total(moved, x, d), vector, learnt),
            lambda d: slopes(lambda moved: total(vector, moved, d), x),
            followed,
        )

    def project(self, vector: np.ndarray) -> np.ndarray:
        """Kernels with columns of length 1."""
        if not self.projected:
            return vector
        parts = self.unpack(vector)
        for name in parts:
            if name.endswith("kernel"):
                parts[name] = unit_columns(parts[name])
        return packed(list(parts.values()))


class BatchNormPerceptron(Blocks):
    """XQC's, or CrossQ's with batch renormalisation."""

    def __init__(self, sizes: tuple[int, ...], renormalised: bool = False, projected: bool = False) -> None:
        last, widths = len(sizes) - 2, sizes[:-1]
        shapes = {f"{number} kernel": pair for number, pair in enumerate(itertools.pairwise(sizes))}
        biased = range(last + 1) if renormalised else [last]
        shapes |= {f"{number} bias": (sizes[number + 1],) for number in biased}
        shapes |= {f"{number} affine": (2, width) for number, width in enumerate(widths)}
        shapes |= {f"{number} running": (2, width) for number, width in enumerate(widths)}
        super().__init__(shapes | ({"updates": (1,)} if renormalised else {}), projected)
        self.last, self.renormalised = last, renormalised

    def outputs_of(self, parts: Parts, x: np.ndarray, learns: bool) -> tuple[np.ndarray, Parts]:
        followed: Parts = {}

        def normalise(number: int, x: np.ndarray) -> np.ndarray:
            running = parts[f"{number} running"]
            mean, variance = running
            if learns:
                mean, variance = moments(x)
                followed[f"{number} running"] = 0.99 * running + 0.01 * np.stack([mean, variance])
            if learns and self.renormalised and parts["updates"][0].real >= 100_000:
                r, d = renormalisation(mean.real, variance.real, running.real)
                mean, variance = mean - d * np.sqrt(variance) / r, variance / r**2
            scale, shift = parts[f"{number} affine"]
            return scale * (x - mean) / np.sqrt(variance + 1e-3) + shift

        x = normalise(0, x)
        for number in range(self.last):
            x = x @ parts[f"{number} kernel"]
            if self.renormalised:
                x = normalise(number + 1, relu(x + parts[f"{number} bias"]))
            else:
                x = relu(normalise(number + 1, x))
        if learns and self.renormalised:
            followed["updates"] = parts["updates"] + 1
        return x @ parts[f"{self.last} kernel"] + parts[f"{self.last} bias"], followed


def renormalisation(mean: np.ndarray, variance: np.ndarray, running: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The constants r and d of batch renormalisation, within 3 and 5 (Ioffe 2017)."""
    deviation = np.sqrt(running[1] + 1e-3)
    r = np.clip(np.sqrt(variance + 1e-3) / deviation, 1 / 3, 3)
    return r, np.clip((mean - running[0]) / deviation, -5, 5)


class BatchNormResidual(Blocks):
    """FlashSAC's, with blocks whose inner width is four times the outer."""

    def __init__(self, inputs: int, width: int, blocks: int, outputs: int, projected: bool = False) -> None:
        self.blocks = blocks
        normalised = {"inputs": inputs}
        shapes: dict[str, tuple[int, ...]] = {"inputs kernel": (inputs, width)}
        for block in range(blocks):
            normalised |= {f"{block} wide": 4 * width, f"{block} narrow": width}
            shapes |= {f"{block} wide kernel": (width, 4 * width), f"{block} narrow kernel": (4 * width, width)}
        shapes |= {"rms scale": (width,), "outputs kernel": (width, outputs), "outputs bias": (outputs,)}
        shapes |= {f"{name} affine": (2, size) for name, size in normalised.items()}
        super().__init__(shapes | {f"{name} running": (2, size) for name, size in normalised.items()}, projected)

    def outputs_of(self, parts: Parts, x: np.ndarray, learns: bool) -> tuple[np.ndarray, Parts]:
        followed: Parts = {}

        def normalise(name: str, x: np.ndarray) -> np.ndarray:
            mean, variance = running = parts[f"{name} running"]
            if learns:
                mean, variance = moments(x)
                met = np.stack([mean, variance * len(x) / (len(x) - 1)])
                followed[f"{name} running"] = 0.99 * running + 0.01 * met
            scale, shift = parts[f"{name} affine"]
            return scale * (x - mean) / np.sqrt(variance + 1e-5) + shift

        x = normalise("inputs", x) @ parts["inputs kernel"]
        for block in range(self.blocks):
            inside = relu(normalise(f"{block} wide", x @ parts[f"{block} wide kernel"]))
            x = x + relu(normalise(f"{block} narrow", inside @ parts[f"{block} narrow kernel"]))
        x = x / np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-6) * parts["rms scale"]
        return x @ parts["outputs kernel"] + parts["outputs bias"], followed

    def project(self, vector: np.ndarray) -> np.ndarray:
        """Scales too, and scales and shifts together, keep a mean square of 1 for each unit."""
        parts = self.unpack(super().project(vector))
        if self.projected:
            for name in parts:
                if name.endswith("affine") or name == "rms scale":
                    parts[name] = parts[name] * np.sqrt(parts[name].shape[-1] / ((parts[name] ** 2).sum() + 1e-8))
        return packed(list(parts.values()))


class Hyperspherical(Blocks):
    """SimbaV2's; every scaler is stored times its scale over its start."""

    def __init__(
        self, inputs: int, width: int, blocks: int, outputs: int, heads: int = 1, projected: bool = False
    ) -> None:
        self.width, self.blocks, self.heads = width, blocks, heads
        shapes: dict[str, tuple[int, ...]] = {"inputs kernel": (inputs + 1, width), "inputs scaler": (width,)}
        for block in range(blocks):
            shapes |= {f"{block} wide kernel": (width, 4 * width), f"{block} wide scaler": (4 * width,)}
            shapes |= {f"{block} narrow kernel": (4 * width, width), f"{block} alpha": (width,)}
        for head in range(heads):
            shapes |= {f"head {head} hidden kernel": (width, width), f"head {head} scaler": (width,)}
            shapes |= {f"head {head} kernel": (width, outputs // heads), f"head {head} bias": (outputs // heads,)}
        super().__init__(shapes, projected)

    def outputs_of(self, parts: Parts, x: np.ndarray, learns: bool) -> tuple[np.ndarray, Parts]:
        def sphere(x: np.ndarray) -> np.ndarray:
            return x / np.sqrt((x**2).sum(axis=1, keepdims=True))

        x = sphere(np.hstack([x, np.full((len(x), 1), 3.0)]))
        x = sphere(x @ parts["inputs kernel"] * parts["inputs scaler"])
        for block in range(self.blocks):
            inside = relu(x @ parts[f"{block} wide kernel"] * parts[f"{block} wide scaler"]) + 1e-8
            inside = sphere(inside @ parts[f"{block} narrow kernel"])
            alpha = parts[f"{block} alpha"] * (1 / (self.blocks + 1)) / (1 / np.sqrt(self.width))
            x = sphere(x + alpha * (inside - x))
        outputs = []
        for head in range(self.heads):
            hidden = x @ parts[f"head {head} hidden kernel"] * parts[f"head {head} scaler"]
            outputs.append(hidden @ parts[f"head {head} kernel"] + parts[f"head {head} bias"])
        return np.hstack(outputs), {}
