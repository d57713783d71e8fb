"""saclab's compiled update against the straight-line reference, leaf by leaf, over several updates."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest
from conftest import ACTION_SIZE, MORE_CASES, OBSERVATION_SIZE, VARIANT_CASES, as_parameters, make_case

from . import numpy_layer_norm
from .numpy_sac import Draws, Layers, NumpySac, backward, forward

ALL_CASES = VARIANT_CASES | MORE_CASES

UPDATES = 13  # beyond K = 10 and beyond three snapshots three updates apart


CRITIC_NETWORKS = {"mlp": None, "layer_norm_mlp": numpy_layer_norm}


def known(settings) -> bool:
    """Whether the reference knows the networks; `test_networks.py` looks after the others."""
    return settings.network == "mlp" and settings.network_of_critic in CRITIC_NETWORKS


def unpack(parameters, sizes, normalised: tuple[int, ...] = ()) -> Layers:
    """The weight matrices and biases of a packed network in 64 bits, then scales and shifts of so many units."""
    parameters, layers = np.asarray(parameters, np.float64), []
    for inputs, outputs in itertools.pairwise(sizes):
        weights, bias, parameters = np.split(parameters, [inputs * outputs, (inputs + 1) * outputs])
        layers.append((weights.reshape(inputs, outputs), bias))
    for width in normalised:
        scale, shift, parameters = np.split(parameters, [width, 2 * width])
        layers.append((scale, shift))
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
    normalised = settings.layers_of_critic if settings.network_of_critic == "layer_norm_mlp" else ()
    return NumpySac(
        unpack(state.actor.weights, actor_sizes),
        [unpack(critic, critic_sizes, normalised) for critic in state.critic.weights],
        settings,
        target_entropy=-ACTION_SIZE if settings.target_entropy is None else settings.target_entropy,
        updates=int(case.numbers["planned_updates"]),
        critic_network=CRITIC_NETWORKS[settings.network_of_critic],
    )


def draws(state, step: int, settings) -> Draws:
    """Update t draws from `fold_in(key, t)`: a key for the critics' update, one for the actor's.

    Each is that of a noise; with 1 folded in, that of the networks that learn; with 2, of the critics in the policy's
    loss; with 3, of the choice of critics: the first of a permutation.
    """
    fold, split = jax.random.fold_in, jax.random.split
    keys = split(fold(state.key, step))
    shape = settings.batch_size, ACTION_SIZE
    next_noise, actor_noise = (np.asarray(jax.random.normal(key, shape), np.float64) for key in keys)
    order = jax.random.permutation(fold(keys[0], 3), settings.critics).tolist()
    chosen = list(range(settings.critics)) if settings.target_critics is None else order[: settings.target_critics]
    networks = fold(keys[0], 1)
    return Draws(
        next_noise,
        actor_noise,
        chosen,
        [masks(key, settings) for key in split(networks, settings.critics)],
        [masks(key, settings) for key in split(fold(networks, 1), (1, len(chosen)))[0]],
        [masks(key, settings) for key in split(fold(keys[1], 2), settings.critics)],
    )


def masks(key, settings) -> list[np.ndarray] | None:
    """What dropout multiplies the outputs of each hidden layer by: 0 for the rate's share of 16-bit numbers."""
    rate, widths = settings.critic_dropout, settings.layers_of_critic
    if rate == 0:
        return None
    drawn = [
        np.asarray(jax.random.bits(layer_key, (settings.batch_size, width), "uint16"))
        for layer_key, width in zip(jax.random.split(key, len(widths)), widths, strict=True)
    ]
    return [(bits >= rate * 65536) / (1 - rate) for bits in drawn]


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
        columns = [np.asarray(column, np.float64) for column in batch if column is not None]
        columns[2] = columns[2][:, 0]  # one term: the reward
        drawn = draws(state, step, case.settings)
        state = case.update(state, batch, step)
        expected = reference.update(*columns, drawn)

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


@pytest.mark.parametrize("name", as_parameters({name: case for name, case in ALL_CASES.items() if known(case)}))
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
