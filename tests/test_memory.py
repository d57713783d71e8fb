"""The forecast of a run's memory: never more than what XLA takes, and refused by its largest part."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from saclab import memory
from saclab.algorithm.types import Context
from saclab.config import Config
from saclab.errors import SettingError
from saclab.memory import needed_memory, require_memory
from saclab.protocols import make_config
from saclab.replay import RowLayout
from saclab.settings import structure
from saclab.training.learners import compiled_init, compiled_update, numbers_of

LAYOUT = RowLayout(376, 17)  # Humanoid-v4: 771 numbers
SMALL = {"hidden_layers": (16,), "batch_size": 32}


def config(**overrides: object) -> Config:
    return make_config("Humanoid-v4", overrides={**SMALL, **overrides})


@pytest.fixture
def one_gib(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 2**30)


def test_a_buffer_that_does_not_fit_is_refused_with_its_size(one_gib):
    require_memory(config(replay_capacity=347_000), LAYOUT)  # 347000 · 771 · 4 = 0.9966 GiB
    with pytest.raises(SettingError, match=r"replay_capacity = 1000000: .*771 numbers take 2\.87 GiB.*1\.00 GiB") as e:
        require_memory(config(), LAYOUT)
    advised = int(str(e.value).split("--replay-capacity ")[1].split()[0])
    assert 200_000 < advised < 348_000
    require_memory(config(replay_capacity=advised), LAYOUT)


def test_several_runs_at_once_need_several_buffers(one_gib):
    with pytest.raises(SettingError, match=r"in each of 3 runs at once.*or a smaller --workers"):
        require_memory(config(replay_capacity=200_000), LAYOUT, runs_at_once=3)
    require_memory(config(replay_capacity=200_000), LAYOUT)


@pytest.mark.parametrize(
    ("overrides", "refused"),
    [
        ({"hidden_layers": (10**8, 10**8)}, r"hidden_layers = \(100000000, 100000000\): .*484,\d+,\d+\.\d\d GiB"),
        ({"hidden_layers": (4096, 4096), "snapshots": 100}, r"hidden_layers = .* target networks take 1\d\.\d\d GiB"),
        ({"batch_size": 10_000, "hidden_layers": (8192,)}, r"batch_size = 10000: .* GiB.*smaller --batch-size"),
        ({"entropy_window": 10**7}, r"batch_size = 32: .* take 1\.19 GiB"),
        ({"critic_head": "categorical", "critic_atoms": 10_000}, r"batch_size = 32: .* GiB"),
        ({"batch_size": 512, "n_step": 1000}, r"batch_size = 512: .* take 1\.4\d GiB"),
    ],
)
def test_networks_and_batches_that_do_not_fit_are_refused(one_gib, overrides, refused):
    with pytest.raises(SettingError, match=refused):
        require_memory(config(replay_capacity=10_000, **overrides), LAYOUT)


def test_a_system_that_does_not_tell_its_memory_refuses_nothing(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    require_memory(config(replay_capacity=10**12), LAYOUT)


LARGE = {
    "networks": {"hidden_layers": (256, 256)},
    "categorical": {"critic_head": "categorical", "critic_atoms": 151, "batch_size": 128},
    "snapshots": {"hidden_layers": (256, 256), "snapshots": 10},
    "batch": {"hidden_layers": (128, 128), "batch_size": 2048},
    "policy": {"hidden_layers": (512, 512), "critic_hidden_layers": (16,)},
    "batch_norm": {"hidden_layers": (256,), "network": "batch_norm_mlp", "joint_forward": True, "batch_size": 1024},
    "entropy": {"entropy_window": 100_000},
    "quantile": {
        "critic_head": "quantile",
        "critic_atoms": 25,
        "critics": 5,
        "target_reduction": "truncated",
        "dropped_quantiles": 20,
        "batch_size": 128,
    },
    "ensemble": {"critics": 10, "target_critics": 2, "hidden_layers": (128, 128), "snapshots": 4, "batch_size": 512},
}
QUICK = ("categorical", "entropy")


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in LARGE])
def test_the_forecast_is_a_lower_bound_of_what_xla_takes(name):
    """And not a small part of it, so that what it lets pass is not much too large."""
    settings = config(**LARGE[name])
    needed, shape = needed_memory(settings, LAYOUT), structure(settings.algorithm)
    numbers = numbers_of(settings, LAYOUT)
    state = jax.eval_shape(compiled_init(shape, LAYOUT), numbers, jax.random.PRNGKey(0))
    rows = jax.ShapeDtypeStruct((shape.batch_size, LAYOUT.width), np.float32)
    context = Context(np.int32(0), np.ones(1, np.float32), np.float32(1))
    taken = compiled_update(shape, LAYOUT).lower(numbers, state, rows, context).compile().memory_analysis()
    sizes = taken.argument_size_in_bytes + taken.temp_size_in_bytes
    assert sizes / 6 < needed.networks + needed.batch < sizes


def test_the_networks_are_those_of_the_learner():
    """Weights, moments and targets, to the last number; the forecast's gradient is the only other part."""
    settings = config(hidden_layers=(5, 7), critic_hidden_layers=(3,), snapshots=4, critics=3)
    state = jax.eval_shape(
        compiled_init(structure(settings.algorithm), LAYOUT), numbers_of(settings, LAYOUT), jax.random.PRNGKey(0)
    )
    held = [leaf.size for leaf in jax.tree.leaves((state.actor, state.critic, state.targets)) if leaf.size > 1]
    gradient = max(state.actor.weights.size, state.critic.weights.size)
    assert memory.network_numbers(settings.algorithm, LAYOUT) == sum(held) + gradient
