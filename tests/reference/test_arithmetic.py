"""XLA's own products against NumPy's in 64 bits, at the sizes that runs have and at those known to have broken."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.networks.mlp import mlp
from saclab.algorithm.networks.network import Design
from saclab.training.process import compiled
from saclab.variants import VARIANTS, variant_settings

INPUTS, CRITICS = 23, 2
SIZES = [(rows, hidden) for hidden in ((256, 256), (400, 300)) for rows in (1, 100, 256)]
OF_VARIANTS = {variant_settings(variant, "HalfCheetah-v4").layers_of_critic for variant in VARIANTS}
SLOW_SIZES = [(rows, hidden) for hidden in ((256, 256), (400, 300)) for rows in (4096, 16_385, 32_769, 65_537)]
SLOW_SIZES += [(rows, hidden) for hidden in sorted(OF_VARIANTS) for rows in (256, 1024)]  # 512 rows in one joint pass


@pytest.fixture(autouse=True)
def as_users_compile():
    """With the optimisations that conftest.py turns off for the other tests."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


def reference_gradients(vector, sizes, x) -> tuple[np.ndarray, np.ndarray]:
    """Of the sum of y²/2 over the rows: for the parameters f64[P] and the inputs f64[B, I]; tanh between layers."""
    layers, rest = [], vector.astype(np.float64)
    for fan_in, fan_out in itertools.pairwise(sizes):
        weights, bias, rest = np.split(rest, [fan_in * fan_out, (fan_in + 1) * fan_out])
        layers.append((weights.reshape(fan_in, fan_out), bias))
    inputs = [x.astype(np.float64)]
    for weights, bias in layers[:-1]:
        inputs.append(np.tanh(inputs[-1] @ weights + bias))
    slope = inputs[-1] @ layers[-1][0] + layers[-1][1]
    gradients = []
    for (weights, _), given in zip(reversed(layers), reversed(inputs), strict=True):
        gradients = [(given.T @ slope).ravel(), slope.sum(0), *gradients]
        slope = slope @ weights.T * (1 if given is inputs[0] else 1 - given**2)
    return np.concatenate(gradients), slope


@pytest.mark.parametrize(
    ("rows", "hidden"), [*SIZES, *(pytest.param(*size, marks=pytest.mark.slow) for size in SLOW_SIZES)]
)
def test_products_and_their_gradients_are_right_in_every_row(rows, hidden):
    """tanh, since rounding alone turns a unit of relu off here and there, which is as much as a wrong row."""
    network, generator = mlp(INPUTS, hidden, 1, Design("tanh")), np.random.default_rng(0)
    critics = np.asarray(jax.vmap(network.init)(jax.random.split(jax.random.PRNGKey(1), CRITICS)))
    x = generator.standard_normal((rows, INPUTS)).astype(np.float32)

    def loss(critics, x):
        return jnp.sum(0.5 * jnp.square(jax.vmap(network.apply, in_axes=(0, None))(critics, x)))

    of_critics, of_inputs = compiled(jax.grad(loss, argnums=(0, 1)))(critics, x)
    expected = [reference_gradients(critic, (INPUTS, *hidden, 1), x) for critic in critics]
    inputs_expected = sum(slope for _, slope in expected)
    np.testing.assert_allclose(of_inputs, inputs_expected, rtol=0, atol=1e-5 * np.abs(inputs_expected).max())
    for found, (gradient, _) in zip(of_critics, expected, strict=True):
        np.testing.assert_allclose(found, gradient, rtol=0, atol=2e-5 * np.abs(gradient).max())


def test_equal_updates_give_equal_bits(case_of):
    """However XLA's threads share the work."""
    case = case_of("averaged-auto/mlp", batch_size=256, hidden_layers=(256, 256))
    state, batch = case.initial_state(), case.batch(np.random.default_rng(0))
    updated = [jax.tree.map(np.asarray, case.update(state, batch, step=0)) for _ in range(40)]
    for other in updated[1:]:
        jax.tree.map(np.testing.assert_array_equal, other, updated[0])


@pytest.mark.parametrize("rows", [256, 16_385, 32_769])
def test_the_product_that_broke_in_jaxlib_0_10_2_is_right(rows):
    """The case of github.com/jax-ml/jax/issues/39103: without `COMPILER_OPTIONS` the last of 32,769 rows is wrong."""
    numbers = np.arange(rows, dtype=np.float32)
    x = np.stack([numbers, 0 * numbers, 0 * numbers], axis=1)

    def squares(x):
        return jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2))(x)

    np.testing.assert_array_equal(compiled(squares)(x), numbers**2)
