"""What all tests share: one thread and little optimisation of XLA, and one small learner per case.

XLA's results on the CPU depend on the number of threads; one is what every machine has. The programs here run for
milliseconds and compile for seconds, so most of XLA's optimisations are off, in this process only: what the tests
start by subprocess is the program as users run it.
"""

from __future__ import annotations

import dataclasses
import os
import signal

os.environ.setdefault("NPROC", "1")  # before JAX is imported
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # tolerances are those of 32-bit arithmetic, not of TF32

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from saclab.algorithm.learner import Learner, make_learner
from saclab.algorithm.scalars import Scalars, scalars
from saclab.algorithm.types import Batch, Context, LearnerState
from saclab.settings import AlgorithmSettings, structure
from saclab.training.process import compiled
from saclab.variants import VARIANTS, variant_settings

jax.config.update("jax_disable_most_optimizations", True)
jax.config.update("jax_enable_compilation_cache", False)  # what is compiled so is for no one else
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under `nohup` too, what the tests start hears it

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


def variant_case(variant: str) -> AlgorithmSettings:
    """A variant with its own networks, small."""
    own = variant_settings(variant, "AnyEnvironment-v0")
    small = SMALL | {
        "critic_hidden_layers": (9, 6) if own.critic_hidden_layers else None,
        "hidden_layers": SMALL["hidden_layers"][: len(own.hidden_layers)],
        "critics": min(own.critics, 4),
        "critic_atoms": 5,
        "critic_dropout": 0.25 if own.critic_dropout else 0.0,
        "actor_interval": min(own.actor_interval, 3),
    }
    if own.network in ("batch_norm_residual", "hyperspherical"):  # of one width
        small |= {"critic_hidden_layers": (6, 6), "hidden_layers": (8, 8)[: len(own.hidden_layers)]}
    return dataclasses.replace(own, **small)


VARIANT_CASES = {
    f"{variant}/{settings.network_of_critic}": settings
    for variant, settings in ((variant, variant_case(variant)) for variant in VARIANTS)
}
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
    "actor first and every third update, other betas, a schedule": dataclasses.replace(
        VARIANT_CASES["sac-auto/mlp"],
        update_order=("actor", "temperature", "critic", "targets"),
        actor_interval=3,
        adam_beta_1=0.5,
        adam_beta_2=0.99,
        learning_rate_schedule="linear",
        final_learning_rate_share=0.25,
    ),
    "no target network, larger critics, cosine schedule": dataclasses.replace(
        VARIANT_CASES["sac-auto/mlp"],
        snapshots=0,
        critic_hidden_layers=(9, 5),
        learning_rate_schedule="cosine",
        final_learning_rate_share=0.5,
    ),
    "one pass for both states": dataclasses.replace(VARIANT_CASES["averaged-auto/mlp"], joint_forward=True),
    "a distribution over values, averaged": dataclasses.replace(
        VARIANT_CASES["averaged-auto/mlp"], critic_head="categorical", critic_atoms=7, critic_bound=2.0
    ),
    "quantiles, averaged, of two critics out of three": dataclasses.replace(
        VARIANT_CASES["tqc/mlp"], critics=3, target_critics=2, snapshots=3, dropped_quantiles=1
    ),
    "batch normalisation in one pass without a target network": dataclasses.replace(
        VARIANT_CASES["sac-auto/mlp"],
        network="batch_norm_mlp",
        joint_forward=True,
        snapshots=0,
        actor_joint_forward=True,
    ),
    "batch normalisation of the critics, averaged distributions, unit columns": dataclasses.replace(
        VARIANT_CASES["averaged-auto/mlp"],
        critic_network="batch_norm_mlp",
        joint_forward=True,
        snapshots=3,
        critic_head="categorical",
        critic_atoms=5,
        critic_bound=3.0,
        weight_projection="unit_columns",
    ),
}


class Case(NamedTuple):
    """A learner whose update is compiled once for all tests of its structure."""

    settings: AlgorithmSettings
    learner: Learner
    numbers: Scalars
    compiled: Callable[..., LearnerState]
    traces: list[None]
    """One entry for each time that JAX has traced the update."""

    def initial_state(self, seed: int = 0) -> LearnerState:
        return self.learner.init(self.numbers, jax.random.PRNGKey(seed))

    def update(self, state: LearnerState, batch: Batch, step: int) -> LearnerState:
        """The update after `step` others."""
        return self.compiled(self.numbers, state, batch, context(step))

    def report(self, state: LearnerState) -> dict[str, float]:
        """What the last update reported."""
        return dict(zip(self.learner.metrics, np.asarray(state.report).tolist(), strict=True))

    def batch(self, generator: np.random.Generator) -> Batch:
        """Random transitions, a third of them terminal."""
        size = self.settings.batch_size
        return Batch(
            observation=generator.standard_normal((size, OBSERVATION_SIZE)).astype(np.float32),
            action=generator.uniform(-1, 1, (size, ACTION_SIZE)).astype(np.float32),
            reward_terms=generator.standard_normal((size, 1)).astype(np.float32),
            next_observation=generator.standard_normal((size, OBSERVATION_SIZE)).astype(np.float32),
            terminated=(generator.uniform(size=size) < 1 / 3).astype(np.float32),
        )


def context(step: int) -> Context:
    """Rewards as they come."""
    return Context(np.int32(step), np.ones(1, np.float32), np.float32(1))


@lru_cache(maxsize=32)
def compiled_learner(shape: AlgorithmSettings) -> tuple[Learner, Callable[..., LearnerState], list[None]]:
    learner = make_learner(shape, OBSERVATION_SIZE, ACTION_SIZE)
    traces: list[None] = []

    def update(*arguments: Any) -> LearnerState:
        traces.append(None)
        return learner.update(*arguments)

    return learner, compiled(update), traces


def make_case(settings: AlgorithmSettings) -> Case:
    learner, compiled, traces = compiled_learner(structure(settings))
    return Case(settings, learner, scalars(settings, ACTION_SIZE, planned_updates=10), compiled, traces)


DEAREST = "simbav2/hyperspherical", "flashsac/batch_norm_residual", "xqc/batch_norm_mlp"
"""Cases that compile for many seconds; their networks are fast cases of reference/test_networks.py."""


def as_parameters(cases: dict[str, AlgorithmSettings]) -> list[Any]:
    """Each case by its name; one that only combines values that earlier cases have is slow, and so are the dearest."""
    seen: set[tuple[str, str]] = set()
    parameters = []
    for name, settings in cases.items():
        values = {(setting, repr(value)) for setting, value in dataclasses.asdict(settings).items()}
        fast = values - seen and name not in DEAREST
        parameters.append(pytest.param(name, marks=[] if fast else pytest.mark.slow))
        seen |= values
    return parameters


@pytest.fixture(params=as_parameters(VARIANT_CASES | MORE_CASES))
def case(request: pytest.FixtureRequest) -> Case:
    """Every variant, and settings that no variant uses."""
    return make_case((VARIANT_CASES | MORE_CASES)[request.param])


@pytest.fixture(params=as_parameters(VARIANT_CASES))
def variant(request: pytest.FixtureRequest) -> Case:
    """Every variant."""
    return make_case(VARIANT_CASES[request.param])


@pytest.fixture
def case_of() -> Callable[..., Case]:
    """`case_of("sac/mlp", snapshots=3)`: a variant with changed settings."""
    return lambda name, **changes: make_case(dataclasses.replace(VARIANT_CASES[name], **changes))
