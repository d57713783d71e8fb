"""What a run group computes is what each of its runs would compute alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from axes import AXES

from saclab.algorithm.scalars import pack, scalars
from saclab.algorithm.types import Context
from saclab.batch.program import Program, StepInputs
from saclab.replay import RowLayout, Windows
from saclab.settings import structure
from saclab.training import seeds
from saclab.training.learners import compiled_init, compiled_update, named_leaves

from .helpers import config, mixed

LEARNING = {name: changes for name, changes in AXES.items() if "reward" not in name}
LAYOUT = RowLayout(3, 2)
CAPACITY = 50


def stacked(trees):
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


EACH = {"one snapshot": {"snapshots": 1}, "three snapshots": {"snapshots": 3}} | LEARNING
FAST = "three steps"


@pytest.mark.parametrize(
    "changes", [pytest.param(EACH[name], id=name, marks=[] if name == FAST else pytest.mark.slow) for name in EACH]
)
def test_each_slot_is_updated_by_its_own_numbers(changes):
    """Fixed and learned α, γ, τ, learning rates and the snapshot interval differ; rows are stored, then drawn."""
    settings = [each.algorithm for each in mixed(batch_size=16, **changes)]
    settings.append(config(batch_size=16, snapshot_interval=4, temperature="fixed", initial_temperature=0.0,
                           **changes).algorithm)  # fmt: skip
    numbers, shape = [pack(scalars(each, 2)) for each in settings], structure(settings[0])
    init, update = compiled_init(shape, LAYOUT), compiled_update(shape, LAYOUT)
    states = [init(own, seeds.learner_key(run)) for run, own in enumerate(numbers)]
    random = np.random.default_rng(0)
    rows = random.standard_normal((len(settings), CAPACITY, LAYOUT.width)).astype(np.float32)
    rows[:, np.arange(2, CAPACITY), :3] = rows[:, np.arange(CAPACITY - 2), 6:9]  # two episodes, one after another
    rows[..., 9] = random.uniform(size=rows.shape[:2]) < 0.2  # or some
    drawn = random.integers(0, CAPACITY, (len(settings), 5, 16), np.int32)

    program = Program(shape, LAYOUT, environments=2, slots=len(settings))
    newest = rows[:, [CAPACITY - 1, 0]]  # two environments: the second row wraps around
    before = rows.copy()
    before[:, [CAPACITY - 1, 0]] = 0
    position = np.full(len(settings), CAPACITY - 1, np.int32)
    packed = program.inputs(5).pack(len(settings), rows=newest, position=position, drawn=drawn)
    state, replay, metrics = program.advance(
        5, stacked(numbers), program.put(stacked(states)), program.put(before), program.put(packed),
        Context(np.int32(0), np.ones((len(settings), 1), np.float32), np.ones(len(settings), np.float32)),
    )  # fmt: skip
    np.testing.assert_array_equal(replay, rows)
    # Batch normalisation leaves gradients that are 0 but for rounding, and Adam makes whole steps of them: with it the
    # reports must agree, which five updates have entered, and not the weights.
    normalised = "network" in changes
    tolerance = 2e-3 if normalised else 2e-5
    for run, own in enumerate(numbers):
        expected = states[run]
        for turn in range(5):
            now = Context(np.int32(turn), np.ones(1, np.float32), np.float32(1))
            batch = rows[run][drawn[run, turn]]
            if shape.n_step > 1:
                batch = Windows(LAYOUT, shape.n_step, 2).packed(rows[run], drawn[run, turn], 1)
                assert set(batch[:, -1]) == {1, 2, 3}
            expected, values = update(own, expected, batch, now)
            np.testing.assert_allclose(metrics[run, turn], values, rtol=2e-4, atol=tolerance)
        found = named_leaves(jax.tree.map(lambda leaf, run=run: leaf[run], state))
        assert found.keys() == named_leaves(expected).keys()
        for name, value in ({} if normalised else named_leaves(expected)).items():
            np.testing.assert_allclose(found[name], value, rtol=1e-3, atol=tolerance, err_msg=f"{run}{name}")


def test_actions_are_those_of_each_runs_policy():
    configs = mixed()
    shape = structure(configs[0].algorithm)
    init = compiled_init(shape, LAYOUT)
    actors = [init(pack(scalars(each.algorithm, 2)), seeds.learner_key(each.seed)).actor.weights for each in configs]
    program = Program(shape, LAYOUT, environments=4, slots=3)
    random = np.random.default_rng(1)
    observation = random.standard_normal((3, 4, 3)).astype(np.float32)
    noise = random.standard_normal((3, 4, 2)).astype(np.float32)
    packed = program.inputs(1).pack(3, observation=observation, noise=noise)
    action = program.act(stacked(actors), packed)
    for run, actor in enumerate(actors):
        expected = program.learner.policy.act(np.asarray(actor), observation[run], noise[run])
        np.testing.assert_allclose(action[run], expected, rtol=1e-5, atol=1e-6)


def test_the_inputs_of_a_step_are_taken_apart_bit_for_bit():
    """Also numbers that are no normal floating-point numbers, and whole numbers, whose bits are tiny ones."""
    inputs = StepInputs(LAYOUT, environments=2, updates=3, batch_size=4)
    parts = {
        "observation": np.array([[[np.nan, -0.0, 1e-42], [1, 2, 3]]], np.float32),
        "noise": np.arange(4, dtype=np.float32).reshape(1, 2, 2),
        "rows": np.arange(2 * LAYOUT.width, dtype=np.float32).reshape(1, 2, -1),
        "position": np.array([7], np.int32),
        "drawn": np.arange(12, dtype=np.int32).reshape(1, 3, 4),
    }
    packed = inputs.pack(2, **parts)
    assert packed.shape == (2, 6 + 4 + 2 * LAYOUT.width + 1 + 12)
    assert (packed[1] == 0).all()
    for name, part in parts.items():
        found = np.asarray(jax.jit(lambda slot, name=name: inputs.unpack(slot, name))(jnp.asarray(packed[0])))
        assert found.dtype == part.dtype
        assert found.tobytes() == part[0].tobytes(), name


def test_runs_that_differ_in_plain_numbers_share_what_is_compiled():
    first, second, other = (each.algorithm for each in (*mixed()[1:], config(snapshots=2)))
    assert first != second
    for compiled in (compiled_init, compiled_update):
        assert compiled(structure(first), LAYOUT) is compiled(structure(second), LAYOUT)
        assert compiled(structure(first), LAYOUT) is not compiled(structure(other), LAYOUT)
