"""The networks against plain NumPy in 64 bits: outputs, running statistics, gradients and projections."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.batch_norm_mlp import WARM_UPDATES
from saclab.algorithm.networks.network import Design, Network

from . import numpy_networks as references

INPUTS, HIDDEN, OUTPUTS, HEADS, ROWS = 3, (4, 4), 6, 2, 9
SIZES = (INPUTS, *HIDDEN, OUTPUTS)
REFERENCES: dict[str, Callable[..., object]] = {
    "mlp": lambda projected: references.Perceptron(SIZES, projected),
    "layer_norm_mlp": lambda projected: references.LayerNormPerceptron(SIZES, projected),
    "batch_norm_mlp": lambda projected: references.BatchNormPerceptron(SIZES, projected=projected),
    "batch_renorm_mlp": lambda projected: references.BatchNormPerceptron(SIZES, True, projected),
    "batch_norm_residual": lambda projected: references.BatchNormResidual(INPUTS, 4, 2, OUTPUTS, projected),
    "hyperspherical": lambda projected: references.Hyperspherical(INPUTS, 4, 2, OUTPUTS, HEADS, projected),
}
X = np.random.default_rng(1).normal(0.3, 1.5, (ROWS, INPUTS))
D_OUTPUTS = np.random.default_rng(2).normal(size=(ROWS, OUTPUTS))


def network_of(name: str, projection: str = "none") -> Network:
    return NETWORKS[name](INPUTS, HIDDEN, OUTPUTS, Design(projection=projection, heads=HEADS))


def some_vector(name: str, network: Network) -> np.ndarray:
    """Numbers far from the first ones; batch renormalisation is past its warm-up."""
    vector = np.random.default_rng(0).normal(0.3, 0.6, network.size)
    if network.statistics:
        vector[-network.statistics :] = np.random.default_rng(3).uniform(0.4, 1.5, network.statistics)
    if name == "batch_renorm_mlp":
        vector[-1] = WARM_UPDATES
    return vector


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_equals_its_reference(name):
    network, reference = network_of(name), REFERENCES[name](projected=False)
    vector = some_vector(name, network)
    expected = reference.forward(vector, X, learns=True)

    def loss(vector, x):
        outputs, statistics = network.train(vector, x, key=jax.random.PRNGKey(0))
        return jnp.sum(outputs * D_OUTPUTS.astype(np.float32)), (outputs, statistics)

    gradients = jax.jit(jax.grad(loss, (0, 1), has_aux=True))
    (gradient, input_gradient), (outputs, statistics) = gradients(jnp.float32(vector), jnp.float32(X))
    close = {"rtol": 1e-3, "atol": 2e-4}
    np.testing.assert_allclose(outputs, expected.outputs, **close)
    np.testing.assert_allclose(statistics, expected.statistics, rtol=1e-5)
    np.testing.assert_allclose(gradient, expected.gradient(D_OUTPUTS), **close)
    np.testing.assert_allclose(input_gradient, expected.input_gradient(D_OUTPUTS), **close)
    acting = network.apply(np.float32(vector), np.float32(X))
    np.testing.assert_allclose(acting, reference.forward(vector, X, learns=False).outputs, **close)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_projection_equals_its_reference(name):
    network = network_of(name, "unit_columns")
    vector = some_vector(name, network)
    projected = REFERENCES[name](projected=True).project(vector)
    np.testing.assert_allclose(network.project(jnp.float32(vector)), projected, rtol=1e-5)
    assert not np.allclose(projected, vector)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_references_gradients_are_slopes(name):
    """By finite differences along a dozen random directions; of batch renormalisation before it corrects anything,
    since its gradient takes the correction for a constant.
    """
    reference = REFERENCES[name](projected=False)
    vector, generator = some_vector(name, network_of(name)), np.random.default_rng(5)
    if name == "batch_renorm_mlp":
        vector[-1] = 0
    masks = [generator.integers(0, 2, (ROWS, width)) * 2.0 for width in HIDDEN]

    def loss(vector: np.ndarray, x: np.ndarray) -> float:
        return (reference.forward(vector, x, True, masks).outputs * D_OUTPUTS).sum()

    learns = reference.forward(vector, X, True, masks)
    gradient, input_gradient = learns.gradient(D_OUTPUTS), learns.input_gradient(D_OUTPUTS)
    learnt = len(vector) - len(learns.statistics)
    assert not gradient[learnt:].any()
    for _ in range(12):
        along, along_x = generator.normal(size=vector.size), generator.normal(size=X.shape)
        along[learnt:] = 0
        ends = [loss(vector + step * along, X + step * along_x) for step in (1e-6, -1e-6)]
        assert gradient @ along + (input_gradient * along_x).sum() == pytest.approx(
            (ends[0] - ends[1]) / 2e-6, rel=1e-5
        )


def test_the_hyperspherical_network_starts_as_the_authors_does():
    """H = 4, two blocks: scalers √(2/h) and √(2/4h), 1 in the heads, α 1/3 once its storage is undone."""
    network = network_of("hyperspherical")
    parts = REFERENCES["hyperspherical"](projected=False).unpack(np.asarray(network.init(jax.random.PRNGKey(0))))
    for name, expected in (("inputs scaler", 0.5**0.5), ("1 wide scaler", 0.125**0.5), ("head 1 scaler", 1.0)):
        np.testing.assert_allclose(parts[name], expected, rtol=1e-6)
    np.testing.assert_allclose(parts["0 alpha"] * 4**0.5 / 3, 1 / 3, rtol=1e-6)
    for name, part in parts.items():
        if name.endswith("kernel"):
            np.testing.assert_allclose((part**2).sum(axis=0), 1, rtol=1e-5)
