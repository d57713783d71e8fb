"""saclab's compiled update against the straight-line reference, leaf by leaf, over several updates.

In 32 bits, as it runs, and in 64 bits, where nothing is left to rounding: there batch normalisation takes part too. Its
small batches multiply rounding, and a shift that the next normalisation takes away has no gradient but rounding, of
which Adam makes whole steps.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
import pytest
from conftest import ACTION_SIZE, MORE_CASES, OBSERVATION_SIZE, VARIANT_CASES, as_parameters, context, make_case
from jax.extend.random import threefry_2x32

from saclab.algorithm.types import Context

from .conftest import cast
from .numpy_networks import (
    BatchNormPerceptron,
    BatchNormResidual,
    Hyperspherical,
    LayerNormPerceptron,
    Perceptron,
)
from .numpy_sac import Draws, NumpySac

ALL_CASES = VARIANT_CASES | MORE_CASES

UPDATES = 13  # beyond K = 10 and beyond three snapshots three updates apart
REWARD_SCALE = 1.75
"""Of the cases that scale rewards."""


def network_of(name: str, sizes: tuple[int, ...], settings, heads: int):
    """The reference of a network of the learner's."""
    projected = settings.weight_projection == "unit_columns"
    width, blocks = sizes[1], len(sizes) - 2
    return {
        "mlp": lambda: Perceptron(sizes, projected),
        "layer_norm_mlp": lambda: LayerNormPerceptron(sizes, projected),
        "batch_norm_mlp": lambda: BatchNormPerceptron(sizes, projected=projected),
        "batch_renorm_mlp": lambda: BatchNormPerceptron(sizes, renormalised=True, projected=projected),
        "batch_norm_residual": lambda: BatchNormResidual(sizes[0], width, blocks, sizes[-1], projected),
        "hyperspherical": lambda: Hyperspherical(sizes[0], width, blocks, sizes[-1], heads, projected),
    }[name]()


def reference_of(case, state) -> NumpySac:
    settings = case.settings
    outputs = 1 if settings.critic_head == "scalar" else settings.critic_atoms
    actor_sizes = (OBSERVATION_SIZE, *settings.hidden_layers, 2 * ACTION_SIZE)
    critic_sizes = (OBSERVATION_SIZE + ACTION_SIZE, *settings.layers_of_critic, outputs)
    entropy = settings.target_entropy
    return NumpySac(
        (
            network_of(settings.network, actor_sizes, settings, heads=2),
            network_of(settings.network_of_critic, critic_sizes, settings, heads=1),
        ),
        own_part(settings, state.actor.weights, OBSERVATION_SIZE),
        [own_part(settings, critic, OBSERVATION_SIZE + ACTION_SIZE) for critic in state.critic.weights],
        settings,
        target_entropy=settings.target_entropy_per_action * ACTION_SIZE if entropy is None else entropy,
        updates=int(case.numbers["planned_updates"]),
    )


def own_part(settings, vectors, inputs: int) -> np.ndarray:
    """In 64 bits, without the moments behind a network that normalises observations: the reference does it before."""
    vectors = np.asarray(vectors, np.float64)
    return vectors[..., : -2 * inputs] if settings.observation_normalisation == "running" else vectors


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
    if settings.critic_dropout == 0:
        return None
    keys = jax.random.split(key, len(settings.layers_of_critic))
    return [
        mask(layer_key, (settings.batch_size, width), settings.critic_dropout)
        for layer_key, width in zip(keys, settings.layers_of_critic, strict=True)
    ]


def mask(key, shape: tuple[int, int], rate: float) -> np.ndarray:
    blocks = -(-shape[0] * shape[1] // 4)
    words = np.asarray(threefry_2x32(key, np.arange(2 * blocks, dtype=np.uint32)))
    draws = np.column_stack([words & 0xFFFF, words >> 16]).ravel()[: shape[0] * shape[1]]
    return (draws >= rate * 65536).reshape(shape) / (1 - rate)


def expected_ring(reference: NumpySac) -> np.ndarray:
    """f64[K, C, P]: where the ring keeps each of the averaged targets."""
    size = reference.settings.snapshots
    marks = (len(reference.targets) - 1) // reference.settings.snapshot_interval
    ring = [None] * size
    for back, target in enumerate(reference.averaged_targets()):
        ring[(marks - back) % size] = np.stack(target)
    return np.stack(ring)


def context_of(case, step: int, generator: np.random.Generator) -> Context:
    """What a run would know: a reward scale and moments of observations, where the case uses them."""
    settings = case.settings
    given = context(step)
    if settings.reward_scaling != "none":
        given = given._replace(reward_scale=np.float32(REWARD_SCALE))
    if settings.observation_normalisation == "running":
        mean, deviation = generator.normal(size=OBSERVATION_SIZE), generator.uniform(0.5, 2, OBSERVATION_SIZE)
        given = given._replace(observation_moments=np.stack([mean, deviation]).astype(np.float32))
    return given


def columns_of(batch, given: Context) -> list[np.ndarray]:
    """The batch in 64 bits as the reference takes it: rewards scaled and observations normalised."""
    observation, action, rewards, next_observation, terminated = (
        np.asarray(column, np.float64) for column in batch if column is not None
    )
    mean, deviation = (0.0, 1.0) if given.observation_moments is None else np.float64(given.observation_moments)
    observation, next_observation = ((each - mean) / deviation for each in (observation, next_observation))
    return [observation, action, rewards[:, 0] / np.float64(given.reward_scale), next_observation, terminated]


class Comparison(NamedTuple):
    """How close they must be; a step of Adam is a hundred times as large at the least."""

    number: type
    relative: float
    absolute: float

    def close(self, actual, expected, what: str) -> None:
        np.testing.assert_allclose(actual, expected, rtol=self.relative, atol=self.absolute, err_msg=what)

    def same_trained(self, trained, vector, adam, inputs: int, settings, what: str) -> None:
        """The actor or one critic, and Adam's moments."""
        self.close(own_part(settings, trained.weights, inputs), vector, what)
        self.close(own_part(settings, trained.moments.mu, inputs), adam.first, f"{what}: first moment")
        second = own_part(settings, trained.moments.nu, inputs)  # of squares, which are small
        small = 1e-12 if self.number is np.float64 else self.absolute
        np.testing.assert_allclose(second, adam.second, self.relative, small, err_msg=f"{what}: second moment")


IN_32_BITS, IN_64_BITS = Comparison(np.float32, 1e-4, 3e-6), Comparison(np.float64, 1e-6, 1e-7)


def assert_same_update(case, comparison: Comparison) -> None:
    settings, both = case.settings, OBSERVATION_SIZE + ACTION_SIZE
    case = case._replace(numbers=cast(case.numbers, comparison.number))
    state, generator = case.initial_state(seed=3), np.random.default_rng(5)
    reference = reference_of(case, state)
    for step in range(UPDATES):
        batch, given = cast(case.batch(generator), comparison.number), context_of(case, step, generator)
        drawn = draws(state, step, settings)
        state = case.compiled(case.numbers, state, batch, given)
        expected = reference.update(*columns_of(batch, given), drawn)

        where = f"after update {step + 1}"
        actor = reference.actor, reference.actor_adam
        comparison.same_trained(state.actor, *actor, OBSERVATION_SIZE, settings, f"actor {where}")
        for index, critic in enumerate(zip(reference.critics, reference.critic_adams, strict=True)):
            trained = jax.tree.map(lambda array, index=index: array[index] if array.ndim else array, state.critic)
            comparison.same_trained(trained, *critic, both, settings, f"critic {index} {where}")
        comparison.close(state.temperature.weights, reference.log_alpha, f"log α {where}")
        if settings.snapshots:
            comparison.close(own_part(settings, state.targets, both), expected_ring(reference), f"ring {where}")
        table = np.roll(reference.entropy_terms, step + 1, axis=0)
        comparison.close(state.entropy_terms, table, f"entropy terms {where}")
        expected |= {"reward_scale": given.reward_scale}
        for name, value in case.report(state).items():
            comparison.close(value, expected[name], f"{name} {where}")


def with_batch_norm(settings) -> bool:
    return any(name.startswith("batch_") for name in (settings.network, settings.network_of_critic))


WITHOUT_BATCH_NORM = {name: settings for name, settings in ALL_CASES.items() if not with_batch_norm(settings)}


@pytest.mark.parametrize("name", as_parameters(WITHOUT_BATCH_NORM))
def test_the_composed_update_equals_the_reference(name):
    assert_same_update(make_case(ALL_CASES[name]), IN_32_BITS)


@pytest.mark.usefixtures("sixty_four_bits")
@pytest.mark.parametrize(
    "name",
    [name if name == "sac-auto/mlp" else pytest.param(name, marks=pytest.mark.slow) for name in ALL_CASES],
)
def test_the_composed_update_equals_the_reference_in_64_bits(name):
    settings = ALL_CASES[name]
    rounded = {key: float(np.float32(x)) for key, x in dataclasses.asdict(settings).items() if isinstance(x, float)}
    assert_same_update(make_case(dataclasses.replace(settings, **rounded)), IN_64_BITS)


def test_it_also_does_with_all_of_xlas_optimisations(case_of):
    """One case compiled as users run it; conftest.py turns most optimisations off for the others."""
    case = case_of("averaged-auto/mlp", snapshots=2)
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        assert_same_update(case, IN_32_BITS)
    finally:
        jax.config.update("jax_disable_most_optimizations", True)
