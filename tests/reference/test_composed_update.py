"""saclab's compiled update against the straight-line reference, leaf by leaf, over several updates."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest

from .numpy_sac import Layers, NumpySac, backward, forward

UPDATES = 13  # beyond K = 10 and beyond three snapshots three updates apart
SHARED = (
    "discount", "polyak_rate", "critic_learning_rate", "actor_learning_rate", "temperature_learning_rate",
    "initial_temperature", "temperature", "temperature_gradient", "snapshots", "snapshot_interval", "entropy_window",
    "target_reduction", "actor_reduction", "log_std_minimum", "log_std_maximum", "batch_size",
)  # fmt: skip


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


def reference_of(settings, state, observation_size, action_size) -> NumpySac:
    actor_sizes = (observation_size, *settings.hidden_layers, 2 * action_size)
    critic_sizes = (observation_size + action_size, *settings.hidden_layers, 1)
    return NumpySac(
        unpack(state.actor, actor_sizes),
        [unpack(critic, critic_sizes) for critic in state.critic],
        target_entropy=-action_size if settings.target_entropy is None else settings.target_entropy,
        **{name: getattr(settings, name) for name in SHARED},
    )


def noises(state, batch_size: int, action_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Update t draws from `fold_in(key, t)`: first for the next actions, then for the actor."""
    keys = jax.random.split(jax.random.fold_in(state.key, state.step))
    next_noise, actor_noise = (np.asarray(jax.random.normal(key, (batch_size, action_size))) for key in keys)
    return next_noise.astype(np.float64), actor_noise.astype(np.float64)


def expected_ring(reference: NumpySac) -> np.ndarray:
    """f64[K, C, P]: where the ring keeps each of the averaged targets."""
    size, marks = reference.snapshots, (len(reference.targets) - 1) // reference.snapshot_interval
    ring = [None] * size
    for back, target in enumerate(reference.averaged_targets()):
        ring[(marks - back) % size] = np.stack([pack_layers(layers) for layers in target])
    return np.stack(ring)


def assert_close(actual, expected, what: str) -> None:
    """To the rounding of 32 bits over a dozen updates; a step of Adam is a hundred times as large."""
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=3e-6, err_msg=what)


def assert_same_update(case) -> None:
    state, generator = case.initial_state(seed=3), np.random.default_rng(5)
    first = case.batch(generator)
    observation_size, action_size = first.observation.shape[1], first.action.shape[1]
    reference = reference_of(case.settings, state, observation_size, action_size)
    for number in range(UPDATES):
        batch = case.batch(generator)
        noise = noises(state, case.settings.batch_size, action_size)
        state, metrics = case.update(state, batch)
        expected = reference.update(*(np.asarray(column, np.float64) for column in batch), *noise)

        where = f"after update {number + 1}"
        assert_close(state.actor, pack_layers(reference.actor), f"actor {where}")
        assert_close(state.log_alpha, reference.log_alpha, f"log α {where}")
        assert_close(state.target.snapshots, expected_ring(reference), f"ring {where}")
        table = np.roll(reference.entropy_terms, number + 1, axis=0)
        assert_close(state.target.entropy_terms, table, f"entropy terms {where}")
        adam = state.optimizers.actor[0]
        assert_close(adam.mu, pack(reference.actor_adam.first), f"actor's first moment {where}")
        assert_close(adam.nu, pack(reference.actor_adam.second), f"actor's second moment {where}")
        adam = state.optimizers.critic[0]
        for index, layers in enumerate(reference.critics):
            moments = reference.critic_adams[index]
            assert_close(state.critic[index], pack_layers(layers), f"critic {index} {where}")
            assert_close(adam.mu[index], pack(moments.first), f"critic {index}'s first moment {where}")
            assert_close(adam.nu[index], pack(moments.second), f"critic {index}'s second moment {where}")
        for name, value in metrics._asdict().items():
            assert_close(value, expected[name], f"{name} {where}")
        assert state.step == number + 1


def test_the_composed_update_equals_the_reference(case):
    assert_same_update(case)


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
