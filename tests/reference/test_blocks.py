"""The networks of FlashSAC and SimbaV2 against plain NumPy in 64 bits: outputs, statistics and gradients."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.network import Design, Network

from . import numpy_blocks

INPUTS, WIDTH, BLOCKS, OUTPUTS, HEADS = 3, 4, 2, 6, 2
NORMALISED = {"inputs": INPUTS} | {
    f"{block} {where}": size for block in range(BLOCKS) for where, size in (("wide", 4 * WIDTH), ("narrow", WIDTH))
}
FLASHSAC = (
    {"inputs kernel": (INPUTS, WIDTH)}
    | {
        f"{block} {where} kernel": shape
        for block in range(BLOCKS)
        for where, shape in (("wide", (WIDTH, 4 * WIDTH)), ("narrow", (4 * WIDTH, WIDTH)))
    }
    | {"rms scale": (WIDTH,), "outputs kernel": (WIDTH, OUTPUTS), "outputs bias": (OUTPUTS,)}
    | {f"{name} affine": (2, size) for name, size in NORMALISED.items()}
    | {f"{name} running": (2, size) for name, size in NORMALISED.items()}
)
SIMBAV2 = {"inputs kernel": (INPUTS + 1, WIDTH), "inputs scaler": (WIDTH,)}
for number in range(BLOCKS):
    SIMBAV2 |= {f"{number} wide kernel": (WIDTH, 4 * WIDTH), f"{number} wide scaler": (4 * WIDTH,)}
    SIMBAV2 |= {f"{number} narrow kernel": (4 * WIDTH, WIDTH), f"{number} alpha": (WIDTH,)}
for number in range(HEADS):
    SIMBAV2 |= {f"head {number} hidden kernel": (WIDTH, WIDTH), f"head {number} scaler": (WIDTH,)}
    SIMBAV2 |= {f"head {number} kernel": (WIDTH, OUTPUTS // HEADS), f"head {number} bias": (OUTPUTS // HEADS,)}

DESIGN = Design(heads=HEADS)
X = np.random.default_rng(1).normal(0.3, 1.5, (7, INPUTS))
WEIGHT = np.random.default_rng(2).normal(size=(7, OUTPUTS))


def taken_apart(vector: np.ndarray, shapes: dict) -> dict[str, np.ndarray]:
    parts, start = {}, 0
    for name, shape in shapes.items():
        count = int(np.prod(shape))
        parts[name], start = vector[start : start + count].reshape(shape), start + count
    assert start == len(vector)
    return parts


def random_vector(network: Network) -> np.ndarray:
    vector = np.random.default_rng(0).normal(0.3, 0.6, network.size)
    if network.statistics:
        vector[-network.statistics :] = np.random.default_rng(3).uniform(0.4, 1.5, network.statistics)
    return vector


def assert_same_gradient(network: Network, vector: np.ndarray, loss: Callable[[np.ndarray, np.ndarray], float]) -> None:
    """JAX's gradient, along a dozen random directions of parameters and inputs, is the slope of `loss`."""

    def ours(vector: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.sum(network.train(vector, x, key=jax.random.PRNGKey(0))[0] * WEIGHT.astype(np.float32))

    of_vector, of_x = jax.jit(jax.grad(ours, (0, 1)))(jnp.float32(vector), jnp.float32(X))
    learnt = network.size - network.statistics
    generator = np.random.default_rng(5)
    for _ in range(12):
        along, along_x = generator.normal(size=network.size), generator.normal(size=X.shape)
        along[learnt:] = 0
        ends = [loss(vector + step * along, X + step * along_x) for step in (1e-6, -1e-6)]
        slope = float(np.asarray(of_vector) @ along + (np.asarray(of_x) * along_x).sum())
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=2e-3, abs=2e-3)


def test_the_residual_network_equals_the_reference():
    network = NETWORKS["batch_norm_residual"](INPUTS, (WIDTH,) * BLOCKS, OUTPUTS, DESIGN)
    vector = random_vector(network)
    parts = taken_apart(vector, FLASHSAC)
    outputs, statistics = jax.jit(network.train)(jnp.float32(vector), jnp.float32(X), key=jax.random.PRNGKey(0))
    expected, met = numpy_blocks.flashsac(parts, BLOCKS, X)
    np.testing.assert_allclose(outputs, expected, rtol=1e-4, atol=1e-4)
    moved = [0.99 * parts[f"{name} running"] + 0.01 * met[name] for name in NORMALISED]
    np.testing.assert_allclose(statistics, np.concatenate([pair.ravel() for pair in moved]), rtol=1e-5)
    running = {name: parts[f"{name} running"] for name in NORMALISED}
    acting, _ = numpy_blocks.flashsac(parts, BLOCKS, X, running)
    np.testing.assert_allclose(network.apply(np.float32(vector), np.float32(X)), acting, rtol=1e-4, atol=1e-4)

    def loss(vector: np.ndarray, x: np.ndarray) -> float:
        return float((numpy_blocks.flashsac(taken_apart(vector, FLASHSAC), BLOCKS, x)[0] * WEIGHT).sum())

    assert_same_gradient(network, vector, loss)


def test_the_hyperspherical_network_equals_the_reference():
    network = NETWORKS["hyperspherical"](INPUTS, (WIDTH,) * BLOCKS, OUTPUTS, DESIGN)
    vector = random_vector(network)

    def outputs(vector: np.ndarray, x: np.ndarray) -> np.ndarray:
        return numpy_blocks.simbav2(taken_apart(vector, SIMBAV2), BLOCKS, WIDTH, HEADS, x)

    acting = network.apply(np.float32(vector), np.float32(X))
    np.testing.assert_allclose(acting, outputs(vector, X), rtol=1e-4, atol=1e-4)
    assert_same_gradient(network, vector, lambda vector, x: float((outputs(vector, x) * WEIGHT).sum()))


def test_the_hyperspherical_network_starts_as_the_authors_does():
    """H = 4, two blocks: scalers √(2/h) and √(2/4h), 1 in the heads, α 1/3 once its storage is undone."""
    network = NETWORKS["hyperspherical"](INPUTS, (WIDTH,) * BLOCKS, OUTPUTS, DESIGN)
    parts = taken_apart(np.asarray(network.init(jax.random.PRNGKey(0))), SIMBAV2)
    for name, expected in (("inputs scaler", 0.5**0.5), ("1 wide scaler", 0.125**0.5), ("head 1 scaler", 1.0)):
        np.testing.assert_allclose(parts[name], expected, rtol=1e-6)
    np.testing.assert_allclose(parts["0 alpha"] * WIDTH**0.5 / 3, 1 / 3, rtol=1e-6)
    for name, part in parts.items():
        if name.endswith("kernel"):
            np.testing.assert_allclose((part**2).sum(axis=0), 1, rtol=1e-5)
