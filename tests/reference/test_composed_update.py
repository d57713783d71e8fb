"""saclab's compiled update against the straight-line reference, leaf by leaf, over several updates."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest
from conftest import ACTION_SIZE, MORE_CASES, OBSERVATION_SIZE, VARIANT_CASES, make_case

from .numpy_sac import Layers, NumpySac, backward, forward

ALL_CASES = VARIANT_CASES | MORE_CASES

UPDATES = 13  # beyond K = 10 and beyond three snapshots three updates apart


def batch_normalised(settings) -> bool:
    """The reference knows perceptrons only; `test_networks.py` looks after the others."""
    return "batch_norm_mlp" in (settings.network, settings.network_of_critic)


def unpack(parameters, sizes) -> Layers:
    """The weight matrices and biases of a packed network, in 64 bits."""
    parameters, layers = np.asarray(parameters, np.float64), []
    for inputs, outputs in itertools.pairwise(sizes):
        weights, bias, parameters = np.split(parameters, [inputs * outputs, (inputs + 1) * outputs])
        layers.append((weights.reshape(inputs, outputs), bias))
    assert parameters.size == 0
    return layers


def pack(arrays) -> np.ndarray:
    return np.concatenate([np.ravel(array) for array in arrays])


def pack_layers(layers: Layers) -> np.ndarray:
    return pack([array for layer in layers for array in layer])


def reference_of(case, state) -> NumpySac:
    settings = case.settings
    outputs = 1 if settings.critic_head == "scalar" else settings.critic_atoms
    actor_sizes = (OBSERVATION_SIZE, *settings.hidden_layers, 2 * ACTION_SIZE)
    critic_sizes = (OBSERVATION_SIZE + ACTION_SIZE, *settings.layers_of_critic, outputs)
    return NumpySac(
        unpack(state.actor.weights, actor_sizes),
        [unpack(critic, critic_sizes) for critic in state.critic.weights],
        settings,
        target_entropy=-ACTION_SIZE if settings.target_entropy is None else settings.target_entropy,
        updates=int(case.numbers["planned_updates"]),
    )


def noises(state, step: int, batch_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Update t draws from `fold_in(key, t)`: first for the next actions, then for the actor."""
    keys = jax.random.split(jax.random.fold_in(state.key, step))
    next_noise, actor_noise = (np.asarray(jax.random.normal(key, (batch_size, ACTION_SIZE))) for key in keys)
    return next_noise.astype(np.float64), actor_noise.astype(np.float64)


def expected_ring(reference: NumpySac) -> np.ndarray:
    """f64[K, C, P]: where the ring keeps each of the averaged targets."""
    size = reference.settings.snapshots
    marks = (len(reference.targets) - 1) // reference.settings.snapshot_interval
    ring = [None] * size
    for back, target in enumerate(reference.averaged_targets()):
        ring[(marks - back) % size] = np.stack([pack_layers(layers) for layers in target])
    return np.stack(ring)


def assert_close(actual, expected, what: str) -> None:
    """They agree to the rounding of 32 bits over a dozen updates; a step of Adam is a hundred times as large."""
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=3e-6, err_msg=what)


def assert_same_update(case) -> None:
    state, generator = case.initial_state(seed=3), np.random.default_rng(5)
    reference = reference_of(case, state)
    for step in range(UPDATES):
        batch = case.batch(generator)
        columns = [np.asarray(column, np.float64) for column in batch]
        columns[2] = columns[2][:, 0]  # one term: the reward
        noise = noises(state, step, case.settings.batch_size)
        state = case.update(state, batch, step)
        expected = reference.update(*columns, *noise)

        where = f"after update {step + 1}"
        assert_close(state.actor.weights, pack_layers(reference.actor), f"actor {where}")
        assert_close(state.temperature.weights, reference.log_alpha, f"log α {where}")
        if case.settings.snapshots:
            assert_close(state.targets, expected_ring(reference), f"ring {where}")
        table = np.roll(reference.entropy_terms, step + 1, axis=0)
        assert_close(state.entropy_terms, table, f"entropy terms {where}")
        adam = state.actor.moments
        assert_close(adam.mu, pack(reference.actor_adam.first), f"actor's first moment {where}")
        assert_close(adam.nu, pack(reference.actor_adam.second), f"actor's second moment {where}")
        adam = state.critic.moments
        for index, layers in enumerate(reference.critics):
            moments = reference.critic_adams[index]
            assert_close(state.critic.weights[index], pack_layers(layers), f"critic {index} {where}")
            assert_close(adam.mu[index], pack(moments.first), f"critic {index}'s first moment {where}")
            assert_close(adam.nu[index], pack(moments.second), f"critic {index}'s second moment {where}")
        for name, value in case.report(state).items():
            assert_close(value, expected[name], f"{name} {where}")


@pytest.mark.parametrize("name", [name for name, settings in ALL_CASES.items() if not batch_normalised(settings)])
def test_the_composed_update_equals_the_reference(name):
    assert_same_update(make_case(ALL_CASES[name]))


def test_it_also_does_with_all_of_xlas_optimisations(case_of):
    """One case compiled as users run it; conftest.py turns most optimisations off for the others."""
    case = case_of("averaged-auto/mlp", snapshots=2)
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        assert_same_update(case)
    finally:
        jax.config.update("jax_disable_most_optimizations", True)


def test_the_reference_backward_pass_agrees_with_finite_differences():
    generator, sizes = np.random.default_rng(0), (3, 5, 4, 2)
    packed = generator.standard_normal(sum((a + 1) * b for a, b in itertools.pairwise(sizes)))
    x, weight = generator.standard_normal((7, 3)), generator.standard_normal((7, 2))

    def loss(parameters, point):
        return (forward(unpack(parameters, sizes), point)[0] * weight).sum()

    layers = unpack(packed, sizes)
    gradients, d_x = backward(layers, forward(layers, x)[1], weight)
    for index, slope in enumerate(pack_layers(gradients)):
        change = np.zeros_like(packed)
        change[index] = 1e-6
        assert (loss(packed + change, x) - loss(packed - change, x)) / 2e-6 == pytest.approx(slope, abs=1e-6)
    change = np.zeros_like(x)
    change[2, 1] = 1e-6
    assert (loss(packed, x + change) - loss(packed, x - change)) / 2e-6 == pytest.approx(d_x[2, 1], abs=1e-6)
