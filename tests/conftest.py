"""What all tests share: one thread and little optimisation of XLA, and one small learner per case.

XLA's results on the CPU depend on the number of threads; one is what every machine has. The programs here run for
milliseconds and compile for seconds, so most of XLA's optimisations are off, in this process only: what the tests
start by subprocess is the program as users run it.
"""

from __future__ import annotations

import dataclasses
import os

os.environ.setdefault("NPROC", "1")  # before JAX is imported
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # tolerances are those of 32-bit arithmetic, not of TF32

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
import pytest

from saclab.algorithm.learner import Learner, make_learner
from saclab.algorithm.networks import NETWORKS
from saclab.algorithm.types import Batch, LearnerState
from saclab.config import AlgorithmSettings
from saclab.variants import VARIANTS, variant_settings

jax.config.update("jax_disable_most_optimizations", True)
jax.config.update("jax_enable_compilation_cache", False)  # what is compiled so is for no one else

OBSERVATION_SIZE, ACTION_SIZE = 3, 2

# Small, and with rates at which a dozen updates move everything far beyond rounding.
SMALL = {
    "hidden_layers": (8, 7),
    "batch_size": 6,
    "discount": 0.9,
    "polyak_rate": 0.2,
    "critic_learning_rate": 4e-3,
    "actor_learning_rate": 3e-3,
    "temperature_learning_rate": 5e-3,
}


def variant_case(variant: str, network: str) -> AlgorithmSettings:
    return dataclasses.replace(variant_settings(variant, "AnyEnvironment-v0"), network=network, **SMALL)


VARIANT_CASES = {f"{variant}/{network}": variant_case(variant, network) for variant in VARIANTS for network in NETWORKS}
MORE_CASES = {
    "three snapshots, three updates apart, mean for the actor": dataclasses.replace(
        VARIANT_CASES["averaged/mlp"], snapshots=3, snapshot_interval=3, actor_reduction="mean"
    ),
    "three critics, mean in the target": dataclasses.replace(
        VARIANT_CASES["averaged/mlp"], snapshots=2, critics=3, target_reduction="mean"
    ),
    "gradient on α, given target entropy, clipped log-std": dataclasses.replace(
        VARIANT_CASES["sac-auto/mlp"],
        temperature_gradient="alpha",
        initial_temperature=0.5,
        target_entropy=-0.7,
        log_std_minimum=-0.1,
        log_std_maximum=0.1,
    ),
}


class Case(NamedTuple):
    """A learner whose update is compiled once for all tests."""

    settings: AlgorithmSettings
    learner: Learner
    update: Callable[[LearnerState, Batch], tuple]
    traces: list[None]
    """One entry for each time that JAX has traced the update."""

    def initial_state(self, seed: int = 0) -> LearnerState:
        return self.learner.init(jax.random.PRNGKey(seed))

    def batch(self, generator: np.random.Generator) -> Batch:
        """Random transitions, a third of them terminal."""
        size = self.settings.batch_size
        return Batch(
            observation=generator.standard_normal((size, OBSERVATION_SIZE)).astype(np.float32),
            action=generator.uniform(-1, 1, (size, ACTION_SIZE)).astype(np.float32),
            reward=generator.standard_normal(size).astype(np.float32),
            next_observation=generator.standard_normal((size, OBSERVATION_SIZE)).astype(np.float32),
            terminated=(generator.uniform(size=size) < 1 / 3).astype(np.float32),
        )


@lru_cache(maxsize=32)
def make_case(settings: AlgorithmSettings) -> Case:
    learner = make_learner(settings, OBSERVATION_SIZE, ACTION_SIZE)
    traces: list[None] = []

    def update(state: LearnerState, batch: Batch) -> tuple:
        traces.append(None)
        return learner.update(state, batch)

    return Case(settings, learner, jax.jit(update), traces)


@pytest.fixture(params=VARIANT_CASES | MORE_CASES)
def case(request: pytest.FixtureRequest) -> Case:
    """Every variant on every network, and settings that no variant uses."""
    return make_case((VARIANT_CASES | MORE_CASES)[request.param])


@pytest.fixture(params=VARIANT_CASES)
def variant(request: pytest.FixtureRequest) -> Case:
    """Every variant on every network."""
    return make_case(VARIANT_CASES[request.param])


@pytest.fixture
def case_of() -> Callable[..., Case]:
    """`case_of("sac/mlp", snapshots=3)`: a variant with changed settings."""
    return lambda name, **changes: make_case(dataclasses.replace(VARIANT_CASES[name], **changes))
