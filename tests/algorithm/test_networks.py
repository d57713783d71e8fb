"""The networks: by hand, against finite differences, and the same in NumPy and in JAX."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.networks.batch_norm_mlp import (
    EPSILON,
    MOMENTUM,
    WARM_UPDATES,
    batch_norm_mlp,
    normalise,
    renormalised_moments,
)
from saclab.algorithm.networks.layer_norm_mlp import draws, dropped_out
from saclab.algorithm.networks.network import ACTIVATIONS, INITIALISATIONS, Design


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_an_activation_is_the_one_of_its_name(name):
    x = np.linspace(-5, 5, 101, dtype=np.float32)
    known = {"relu": jax.nn.relu, "tanh": jnp.tanh, "elu": jax.nn.elu, "silu": jax.nn.silu, "gelu": jax.nn.gelu}
    np.testing.assert_allclose(ACTIVATIONS[name](x), known[name](x), rtol=1e-5, atol=1e-6)


def test_an_mlp_by_hand():
    network = NETWORKS["mlp"](2, (2,), 1, Design("relu"))
    #              [[1, -1], [2, 0]]      [0, 3]     [[1], [-2]]  [0.5]
    parameters = np.array([1.0, -1.0, 2.0, 0.0, 0.0, 3.0, 1.0, -2.0, 0.5])
    assert network.size == len(parameters)
    # (1, 1): hidden 3, 2 -> 3 - 4 + 0.5;   (-1, 0): hidden -1 -> 0, 4 -> -8 + 0.5
    assert network.apply(parameters, np.array([[1.0, 1.0], [-1.0, 0.0]])).tolist() == [[-0.5], [-7.5]]


def test_inputs_that_belong_side_by_side_may_come_apart():
    network = NETWORKS["mlp"](3, (5,), 2, Design("tanh"))
    parameters = np.asarray(network.init(jax.random.PRNGKey(0)))
    x = np.random.default_rng(0).standard_normal((4, 3)).astype(np.float32)
    whole = network.apply(parameters, x)
    np.testing.assert_allclose(network.apply(parameters, x[:, :2], x[:, 2:]), whole, rtol=1e-5)

    def total(*inputs):
        return jnp.sum(network.apply(jnp.asarray(parameters), *inputs))

    np.testing.assert_allclose(jax.grad(total, 1)(x[:, :2], x[:, 2:]), jax.grad(total)(x)[:, 2:], rtol=1e-5)


def test_weights_start_uniform_within_one_over_the_root_of_the_inputs():
    """So do the biases."""
    network = NETWORKS["mlp"](100, (400,), 1, Design("relu"))
    first = np.asarray(network.init(jax.random.PRNGKey(0)))[: 101 * 400]
    assert np.abs(first).max() == pytest.approx(0.1, rel=1e-3)
    assert first.std() == pytest.approx(0.1 / math.sqrt(3), rel=0.02)
    assert abs(first.mean()) < 0.001


KEY = jax.random.PRNGKey(0)


def random_vector(network) -> np.ndarray:
    """Parameters and statistics away from their start; the variances stay above zero."""
    vector = np.random.default_rng(0).normal(0, 0.5, network.size).astype(np.float32)
    return np.where(np.arange(network.size) >= network.size - network.statistics, np.abs(vector) + 0.5, vector)


def batch(rows: int = 6) -> np.ndarray:
    return np.random.default_rng(1).normal(1.0, 2.0, (rows, 3)).astype(np.float32)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("projection", ["none", "unit_columns"])
def test_a_network_has_the_shapes_it_says(name, projection):
    network = NETWORKS[name](3, (5, 4), 2, Design("relu", projection))
    vector = network.init(KEY)
    outputs, statistics = network.train(vector, batch(), key=KEY)
    assert vector.shape == network.project(vector).shape == (network.size,)
    assert outputs.shape == network.apply(vector, batch()).shape == (6, 2)
    assert statistics.shape == (network.statistics,)
    assert network.remember(vector, statistics).shape == vector.shape


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_acts_the_same_in_numpy_and_in_jax(name):
    network = NETWORKS[name](3, (5, 4), 2, Design("elu"))
    vector = random_vector(network)
    ours = network.apply(vector, batch())
    assert isinstance(ours, np.ndarray)
    np.testing.assert_allclose(ours, network.apply(jnp.asarray(vector), jnp.asarray(batch())), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NETWORKS)
def test_unit_columns_have_length_one_and_leave_the_rest(name):
    network = NETWORKS[name](3, (4,), 2, Design("relu", "unit_columns"))
    vector = random_vector(network)
    rows = 4 if name == "hyperspherical" else 3  # one input is always 3
    first = np.asarray(network.project(vector))[: rows * 4].reshape(rows, 4)
    np.testing.assert_allclose((first**2).sum(axis=0), 1, rtol=1e-5)
    before = vector[: rows * 4].reshape(rows, 4)
    np.testing.assert_allclose(first, before / np.sqrt((before**2).sum(0)), rtol=1e-5)
    kept = slice(network.size - network.statistics, network.size)
    np.testing.assert_array_equal(np.asarray(network.project(vector))[kept], vector[kept])


def test_joint_statistics_by_hand():
    x = jnp.array([[0.0], [2.0], [10.0], [12.0]])  # s = 0, 2 and s' = 10, 12: mean 6, variance 26
    normalised = normalise(x, (x.mean(0), x.var(0)), (jnp.ones(1), jnp.zeros(1)), EPSILON)
    np.testing.assert_allclose(normalised[:, 0], [-1.177, -0.784, 0.784, 1.177], atol=1e-3)


def test_running_statistics_move_by_one_hundredth():
    network = batch_norm_mlp(3, (4,), 1, Design())
    _, statistics = network.train(network.init(KEY), batch(), key=KEY)
    inputs = np.asarray(statistics[:6]).reshape(2, 3)  # of the inputs; they start at 0 and 1
    np.testing.assert_allclose(inputs[0], (1 - MOMENTUM) * batch().mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(inputs[1], MOMENTUM + (1 - MOMENTUM) * batch().var(axis=0), rtol=1e-4)


def test_with_the_statistics_of_its_batch_a_network_acts_as_it_learns():
    network = batch_norm_mlp(3, (4,), 2, Design())
    vector = random_vector(network)
    learning, statistics = network.train(vector, batch(), key=KEY)
    running = vector[network.size - network.statistics :]
    of_batch = (np.asarray(statistics) - MOMENTUM * running) / (1 - MOMENTUM)
    acting = network.apply(network.remember(jnp.asarray(vector), jnp.asarray(of_batch)), jnp.asarray(batch()))
    np.testing.assert_allclose(acting, learning, rtol=2e-3, atol=2e-3)


def straight_line(vector: np.ndarray, x: np.ndarray) -> np.ndarray:
    """batch_norm_mlp(3, (4,), 2) while it learns, in 64 bits, written out."""

    def norm(x, scale, bias):
        centred = x - x.mean(axis=0)
        return centred / np.sqrt((centred**2).mean(axis=0) + EPSILON) * scale + bias

    first, second, last_bias, vector = vector[:12], vector[12:20], vector[20:22], vector[22:]
    x = norm(x, vector[:3], vector[3:6]) @ first.reshape(3, 4)
    x = np.maximum(norm(x, vector[6:10], vector[10:14]), 0)
    return x @ second.reshape(4, 2) + last_bias


def test_batch_normalisation_and_its_gradient_equal_the_reference():
    network = batch_norm_mlp(3, (4,), 2, Design())
    vector, x = random_vector(network).astype(np.float64), batch().astype(np.float64)
    weight = np.random.default_rng(2).standard_normal((6, 2))
    parameters = network.size - network.statistics

    def loss(vector):
        return (straight_line(vector, x) * weight).sum()

    def ours(vector):
        return jnp.sum(network.train(vector, batch(), key=KEY)[0] * weight.astype(np.float32))

    np.testing.assert_allclose(network.train(vector.astype(np.float32), batch(), key=KEY)[0], straight_line(vector, x),
                               rtol=1e-4, atol=1e-5)  # fmt: skip
    slope = np.asarray(jax.grad(ours)(jnp.asarray(vector, jnp.float32)))
    for index in range(parameters):
        change = np.zeros_like(vector)
        change[index] = 1e-6
        expected = (loss(vector + change) - loss(vector - change)) / 2e-6
        assert slope[index] == pytest.approx(expected, rel=1e-3, abs=1e-3), index
    assert not slope[parameters:].any()  # no gradient goes through the running statistics


def test_a_layer_norm_mlp_by_hand():
    network = NETWORKS["layer_norm_mlp"](2, (2,), 1, Design(dropout=0.5))
    #              [[1, -1], [2, 0]]      [0, 3]     [[1], [-2]]  [0.5] scale: 3, 4; shift: 1, 5
    parameters = np.array([1.0, -1.0, 2.0, 0.0, 0.0, 3.0, 1.0, -2.0, 0.5, 3.0, 4.0, 1.0, 5.0])
    assert network.size == len(parameters)
    # (1, 1): 3, 2, normalised 1, -1 -> 4, 1 -> 4 - 2 + 0.5;   (-1, 0): -1, 4, normalised -1, 1 -> 0, 9 -> -18 + 0.5
    outputs = network.apply(parameters, np.array([[1.0, 1.0], [-1.0, 0.0]]))
    np.testing.assert_allclose(outputs, [[2.5], [-17.5]], rtol=1e-4)


def test_dropout_leaves_out_its_share_and_keeps_the_mean():
    left = np.asarray(dropped_out(jnp.full((200, 500), 3.0), KEY, 0.25))
    assert set(np.unique(left)) == {0.0, 4.0}
    assert (left == 0).mean() == pytest.approx(0.25, abs=0.007)  # five standard deviations
    assert len(np.unique((left == 0).sum(axis=0))) > 10, "each unit is left out by itself"


def test_dropout_draws_sixteen_even_bits_for_each_unit_by_itself():
    drawn = np.asarray(draws(KEY, (333, 301)))
    assert (drawn.shape, drawn.dtype) == ((333, 301), np.uint16)
    counts = np.histogram(drawn, bins=256, range=(0, 2**16))[0]
    expected = drawn.size / 256
    assert ((counts - expected) ** 2 / expected).sum() == pytest.approx(255, abs=6 * np.sqrt(2 * 255))  # χ²
    for apart in (1, 2, 3, 4, 301, drawn.size // 2):
        related = np.corrcoef(drawn.ravel()[:-apart], drawn.ravel()[apart:])[0, 1]
        assert abs(related) < 6 / np.sqrt(drawn.size - apart), apart
    assert not np.array_equal(drawn, np.asarray(draws(jax.random.PRNGKey(9), (333, 301))))


def test_dropout_acts_while_a_network_learns_only():
    network = NETWORKS["layer_norm_mlp"](3, (5, 4), 2, Design(dropout=0.5))
    vector = jnp.asarray(random_vector(network))
    learning = [np.asarray(network.train(vector, batch(), key=key)[0]) for key in (KEY, jax.random.PRNGKey(9))]
    assert np.abs(learning[0] - learning[1]).max() > 0.01
    without = NETWORKS["layer_norm_mlp"](3, (5, 4), 2, Design())
    learnt, _ = without.train(vector, batch(), key=KEY)
    np.testing.assert_array_equal(learnt, network.apply(vector, jnp.asarray(batch())))


def test_xavier_weights_are_uniform_up_to_their_bound_and_biases_zero():
    layer = np.asarray(INITIALISATIONS["xavier"](KEY, 100, 500))
    weights, bias = layer[:50_000], layer[50_000:]
    assert np.abs(weights).max() == pytest.approx(0.1, rel=1e-3)  # √(6 / 600)
    assert weights.std() == pytest.approx(0.1 / 3**0.5, rel=0.02)
    assert not bias.any()


@pytest.mark.parametrize(("updates", "expected"), [(WARM_UPDATES - 1, 0.9999), (WARM_UPDATES, 2.997)])
def test_batch_renormalisation_by_hand(updates, expected):
    """A batch of mean 1 and variance 4, running moments of 0 and 1: x = 3 comes out as 3 once they have settled."""
    moments = [jnp.array([1.0]), jnp.array([4.0])]
    mean, variance = renormalised_moments(*moments, jnp.array([[0.0], [1.0]]), jnp.array([float(updates)]))
    normal = normalise(jnp.array([[3.0]]), (mean, variance), (jnp.ones(1), jnp.zeros(1)), EPSILON)
    np.testing.assert_allclose(normal, [[expected]], atol=5e-4)


@pytest.mark.parametrize("name", NETWORKS)
def test_rows_that_are_all_alike_have_a_finite_gradient(name):
    """A batch of one, or a unit that is the same in every row: a variance of exactly 0."""
    network = NETWORKS[name](3, (4,), 2, Design("tanh"))
    vector, x = jnp.asarray(random_vector(network)), jnp.ones((3, 3), jnp.float32)
    gradient = jax.jit(jax.grad(lambda vector: jnp.sum(network.train(vector, x, key=KEY)[0] ** 2)))(vector)
    assert np.isfinite(gradient).all()
