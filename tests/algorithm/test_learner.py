"""Every variant on every network: finite, pure, compiled once, and the same alone, in a scan and side by side."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from saclab.algorithm.types import Metrics


def named(tree) -> dict[str, np.ndarray]:
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def after(case, updates: int, seed: int = 0):
    """The states after 0, 1, … updates, and the metrics of each."""
    states, metrics, generator = [case.initial_state(seed)], [], np.random.default_rng(seed)
    for _ in range(updates):
        state, report = case.update(states[-1], case.batch(generator))
        states.append(state)
        metrics.append(report)
    return states, metrics


def assert_equal(first, second) -> None:
    first, second = named(first), named(second)
    assert first.keys() == second.keys()
    for name, leaf in first.items():
        np.testing.assert_array_equal(leaf, second[name], err_msg=name)


def test_updates_are_finite_and_compiled_once(case):
    states, metrics = after(case, 3)
    after(case, 3, seed=1)
    for leaf in (*named(states[-1]).values(), *named(metrics).values()):
        assert np.isfinite(leaf).all()
    assert len(case.traces) == 1


def test_shapes_and_types_of_the_state_never_change(case):
    states, _ = after(case, 2)
    first, last = named(states[0]), named(states[-1])
    assert {name: (leaf.shape, leaf.dtype) for name, leaf in first.items()} == {
        name: (leaf.shape, leaf.dtype) for name, leaf in last.items()
    }
    assert {leaf.dtype.name for leaf in last.values()} == {"float32", "int32", "uint32"}


def test_metrics_are_single_numbers(case):
    _, metrics = after(case, 1)
    assert [value.shape for value in metrics[0]] == [()] * len(Metrics._fields)


def test_the_right_leaves_change_at_every_update(case):
    states, _ = after(case, 3)
    learned = case.settings.temperature == "learned"
    for before, now in itertools.pairwise(states):
        old, new = named(before), named(now)
        changed = {name for name in old if not np.array_equal(old[name], new[name])}
        expected = set(old) - {".key"} - (set() if learned else {".log_alpha"})
        assert changed == expected
    assert [int(state.step) for state in states] == [0, 1, 2, 3]


def test_every_critic_changes_in_its_own_way(case):
    states, _ = after(case, 1)
    change = np.asarray(states[1].critic - states[0].critic)
    for first in range(len(change)):
        assert np.abs(change[first]).max() > 0
        for second in range(first):
            assert not np.array_equal(change[first], change[second])


def test_one_snapshot_changes_at_each_update_and_the_others_stay(case):
    states, _ = after(case, 3)
    for before, now in itertools.pairwise(states):
        old, new = np.asarray(before.target.snapshots), np.asarray(now.target.snapshots)
        changed = [k for k in range(len(old)) if not np.array_equal(old[k], new[k])]
        assert changed == [int(now.step) // case.settings.snapshot_interval % case.settings.snapshots]


def test_the_temperature_moves_only_where_it_is_learned(case):
    states, metrics = after(case, 2)
    learned = case.settings.temperature == "learned"
    assert (states[2].log_alpha != states[0].log_alpha) == learned
    assert metrics[0].temperature == pytest.approx(case.settings.initial_temperature, rel=1e-6)
    assert (metrics[1].temperature != metrics[0].temperature) == learned


def test_the_same_input_gives_the_same_output_and_the_input_stays(variant):
    state, batch = variant.initial_state(), variant.batch(np.random.default_rng(0))
    before = jax.tree.map(np.array, (state, batch))
    first, second = variant.update(state, batch), variant.update(state, batch)
    assert_equal(first, second)
    assert_equal((state, batch), before)


def test_another_key_or_another_step_draws_other_noise(case_of):
    case = case_of("sac/mlp")
    state, batch = case.initial_state(), case.batch(np.random.default_rng(0))
    entropies = {
        float(case.update(state._replace(**change), batch)[1].entropy)
        for change in ({}, {"key": state.key + 1}, {"step": state.step + 1})
    }
    assert len(entropies) == 3


def test_scanned_and_side_by_side_it_equals_repeated_calls(variant):
    """Three learners, vmapped over a scan of three updates, against three loops."""
    runs = [after(variant, 3, seed) for seed in range(3)]
    generators = [np.random.default_rng(seed) for seed in range(3)]
    batches = [jax.tree.map(lambda *x: np.stack(x), *[variant.batch(g) for _ in range(3)]) for g in generators]
    starts, batches = (jax.tree.map(lambda *x: jnp.stack(x), *x) for x in ([run[0][0] for run in runs], batches))

    together = jax.jit(jax.vmap(lambda state, stack: jax.lax.scan(variant.learner.update, state, stack)))
    final, metrics = together(starts, batches)

    for index, (states, reports) in enumerate(runs):
        alone = named((states[-1], jax.tree.map(lambda *x: jnp.stack(x), *reports)))
        side_by_side = named(jax.tree.map(lambda leaf, i=index: leaf[i], (final, metrics)))
        assert alone.keys() == side_by_side.keys()
        for name, leaf in alone.items():
            np.testing.assert_allclose(side_by_side[name], leaf, rtol=1e-4, atol=2e-6, err_msg=name)


def test_averaging_over_one_snapshot_or_minibatch_is_sac_by_its_settings(case_of):
    plain = case_of("sac/mlp").settings
    assert case_of("averaged/mlp", snapshots=1).settings == plain
    assert case_of("averaged-auto/mlp", snapshots=1).settings == case_of("sac-auto/mlp").settings
    assert case_of("averaged-entropy/mlp", entropy_window=1).settings == plain


def test_averaging_over_one_snapshot_is_sac_bit_for_bit_whatever_the_interval(case_of):
    """The ring of one takes the same path through the code as ten do."""
    plain, _ = after(case_of("sac/mlp"), 6)
    averaged, _ = after(case_of("averaged/mlp", snapshots=1, snapshot_interval=4), 6)
    assert_equal(plain[-1], averaged[-1])


def test_averaging_over_snapshots_differs_from_sac_as_soon_as_the_snapshots_do(case_of):
    plain, plain_metrics = after(case_of("sac/mlp"), 3)
    averaged, averaged_metrics = after(case_of("averaged/mlp"), 3)
    assert np.abs(plain[1].critic - averaged[1].critic).max() < 1e-6  # all snapshots are still the same network
    assert np.abs(plain[3].critic - averaged[3].critic).max() > 1e-4
    assert [float(m.snapshot_spread) > 1e-4 for m in averaged_metrics] == [False, True, True]
    assert [float(m.snapshot_spread) for m in plain_metrics] == [0, 0, 0]


def test_a_fixed_temperature_of_zero_is_finite_and_leaves_the_entropy_out(case_of):
    case = case_of("sac/mlp")  # α is part of the state, so the compiled update is the same
    state, generator = case_of("sac/mlp", initial_temperature=0.0).initial_state(), np.random.default_rng(0)
    for _ in range(3):
        state, metrics = case.update(state, case.batch(generator))
        assert all(np.isfinite(value) for value in metrics)
        assert metrics.temperature == 0
    assert np.isfinite(state.actor).all()
    assert np.isfinite(state.critic).all()
    assert np.asarray(state.target.entropy_terms).tolist() == [[0] * case.settings.batch_size]


def test_the_numpy_policy_of_a_trained_actor_acts_like_the_jax_one(variant):
    state = after(variant, 3)[0][-1]
    observation = np.random.default_rng(0).standard_normal((5, 3)).astype(np.float32)
    policy = variant.learner.policy
    on_host = policy.mode(np.asarray(state.actor), observation)
    assert isinstance(on_host, np.ndarray)
    np.testing.assert_allclose(on_host, policy.mode(state.actor, jnp.asarray(observation)), rtol=1e-5, atol=1e-6)
