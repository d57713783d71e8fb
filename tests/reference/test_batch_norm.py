"""The networks with batch normalisation against plain NumPy in 64 bits: outputs, statistics and gradients."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.batch_norm_mlp import WARM_UPDATES
from saclab.algorithm.networks.network import Design

from .numpy_batch_norm import forward_backward

SIZES = (3, 6, 5, 2)


def parts_of(vector: np.ndarray, renormalised: bool) -> tuple[list, list]:
    """[kernels, biases, affine], and the running moments, of a packed vector; missing biases are zero."""
    vector, pairs = list(np.asarray(vector, np.float64)), list(itertools.pairwise(SIZES))

    def take(*shape: int) -> np.ndarray:
        count = int(np.prod(shape))
        taken, vector[:] = vector[:count], vector[count:]
        return np.array(taken).reshape(shape)

    kernels = [take(*pair) for pair in pairs]
    biases = [take(width) if renormalised or number == 2 else np.zeros(width) for number, width in enumerate(SIZES[1:])]
    affine, running = ([tuple(take(2, width)) for width in SIZES[:-1]] for _ in range(2))
    return [kernels, biases, affine], running


def packed(gradients: tuple, renormalised: bool) -> np.ndarray:
    kernels, biases, affine = gradients
    kept = biases if renormalised else biases[-1:]
    return np.concatenate([np.ravel(part) for part in [*kernels, *kept, *affine]])


@pytest.mark.parametrize(
    ("name", "updates"), [("batch_norm_mlp", 0), ("batch_renorm_mlp", WARM_UPDATES)], ids=["batch norm", "renorm"]
)
def test_a_network_that_learns_equals_the_reference(name, updates):
    generator, renormalised = np.random.default_rng(4), name == "batch_renorm_mlp"
    network = NETWORKS[name](SIZES[0], SIZES[1:-1], SIZES[-1], Design())
    vector = generator.normal(0.2, 0.7, network.size).astype(np.float32)
    vector[-network.statistics :] = generator.uniform(0.3, 1.5, network.statistics)
    if renormalised:
        vector[-1] = updates
    x = generator.normal(0.5, 1.5, (9, 3)).astype(np.float32)
    weight = generator.normal(size=(9, 2)).astype(np.float32)

    def loss(vector, x):
        outputs, statistics = network.train(vector, x, key=jax.random.PRNGKey(0))
        return jnp.sum(outputs * weight), (outputs, statistics)

    gradient = jax.jit(jax.grad(loss, (0, 1), has_aux=True))
    (d_vector, d_x), (outputs, statistics) = gradient(jnp.asarray(vector), jnp.asarray(x))
    layers, running = parts_of(vector, renormalised)
    output, moments, gradients, d_input = forward_backward(
        layers, x.astype(np.float64), weight.astype(np.float64), running if renormalised else None
    )
    np.testing.assert_allclose(outputs, output, rtol=1e-4, atol=1e-5)
    expected = packed(gradients, renormalised)
    np.testing.assert_allclose(d_vector[: len(expected)], expected, rtol=1e-3, atol=2e-4)
    np.testing.assert_allclose(d_x, d_input, rtol=1e-3, atol=2e-4)
    moved = [0.99 * np.stack(old) + 0.01 * np.stack(new) for old, new in zip(running, moments, strict=True)]
    moved = np.concatenate([*(pair.ravel() for pair in moved), *[[updates + 1]] * renormalised])
    np.testing.assert_allclose(statistics, moved, rtol=1e-5)


def test_the_reference_agrees_with_finite_differences():
    generator = np.random.default_rng(0)
    x, weight = generator.normal(0.5, 1.5, (9, 3)), generator.normal(size=(9, 2))
    network = NETWORKS["batch_norm_mlp"](SIZES[0], SIZES[1:-1], SIZES[-1], Design())
    layers, _ = parts_of(generator.normal(0.2, 0.7, network.size), renormalised=False)
    *_, (d_kernels, _, _), d_x = forward_backward(layers, x, weight)
    kernel, place = layers[0][0], (1, 2)

    def value() -> float:
        return float((forward_backward(layers, x, weight)[0] * weight).sum())

    for array, index, slope in ((kernel, place, d_kernels[0][place]), (x, (4, 1), d_x[4, 1])):
        before = array[index]
        ends = []
        for change in (1e-6, -1e-6):
            array[index] = before + change
            ends.append(value())
        array[index] = before
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope, rel=1e-4)
