"""Every variant: finite, pure, compiled once, and the same alone, in a scan and side by side."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import VARIANT_CASES, context

from saclab.algorithm.learner import Parts
from saclab.settings import AlgorithmSettings


def named(tree) -> dict[str, np.ndarray]:
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def after(case, updates: int, seed: int = 0):
    """The states after 0, 1, … updates, and the report of each."""
    states, generator = [case.initial_state(seed)], np.random.default_rng(seed)
    for step in range(updates):
        states.append(case.update(states[-1], case.batch(generator), step))
    return states, [case.report(state) for state in states[1:]]


def assert_equal(first, second) -> None:
    first, second = named(first), named(second)
    assert first.keys() == second.keys()
    for name, leaf in first.items():
        np.testing.assert_array_equal(leaf, second[name], err_msg=name)


def test_updates_are_finite_and_compiled_once(case):
    states, _ = after(case, 3)
    after(case, 3, seed=1)
    for name, leaf in named(states[-1]).items():
        assert np.isfinite(leaf).all(), name
    assert len(case.traces) == 1


def test_another_plain_number_needs_no_compilation(case_of):
    first, second = case_of("sac/mlp"), case_of("sac-auto/mlp", discount=0.5, target_entropy=-1.0, adam_beta_1=0.0)
    after(first, 1)
    after(second, 1)
    assert first.traces is second.traces
    assert len(first.traces) == 1


def test_shapes_and_types_of_the_state_never_change(case):
    states, _ = after(case, 2)
    first, last = named(states[0]), named(states[-1])
    assert {name: (leaf.shape, leaf.dtype) for name, leaf in first.items()} == {
        name: (leaf.shape, leaf.dtype) for name, leaf in last.items()
    }
    assert {leaf.dtype.name for leaf in last.values()} == {"float32", "int32", "uint32"}


def test_the_right_leaves_change_at_every_update(case):
    states, _ = after(case, 4)
    learned = case.settings.temperature == "learned"
    for step, (before, now) in enumerate(itertools.pairwise(states)):
        old, new = named(before), named(now)
        changed = {name for name in old if not np.array_equal(old[name], new[name])}
        expected = (
            {name for name in old if old[name].size} - {".key"} - (set() if learned else {".temperature.weights"})
        )
        if step % case.settings.actor_interval:
            expected -= {name for name in old if name.startswith((".actor", ".temperature"))}
        assert changed == expected


def test_an_update_that_leaves_the_actor_out_repeats_its_report(case_of):
    _, reports = after(case_of("sac-auto/mlp", actor_interval=2), 4)
    for name in ("actor_loss", "entropy", "temperature_loss"):
        values = [report[name] for report in reports]
        assert values[0] == values[1] != values[2] == values[3], name
    assert len({report["critic_loss"] for report in reports}) == 4


def test_every_critic_changes_in_its_own_way(case):
    states, _ = after(case, 1)
    change = np.asarray(states[1].critic.weights - states[0].critic.weights)
    for first in range(len(change)):
        assert np.abs(change[first]).max() > 0
        for second in range(first):
            assert not np.array_equal(change[first], change[second])


def test_one_snapshot_changes_at_each_update_and_the_others_stay(case):
    states, _ = after(case, 3)
    for step, (before, now) in enumerate(itertools.pairwise(states)):
        old, new = np.asarray(before.targets), np.asarray(now.targets)
        changed = [k for k in range(len(old)) if not np.array_equal(old[k], new[k])]
        count = case.settings.snapshots
        assert changed == ([(step + 1) // case.settings.snapshot_interval % count] if count else [])


def test_the_temperature_moves_only_where_it_is_learned(case):
    states, reports = after(case, 4)
    learned = case.settings.temperature == "learned"
    assert (states[1].temperature.weights != states[0].temperature.weights) == learned
    assert reports[0]["temperature"] == pytest.approx(case.settings.initial_temperature, rel=1e-6)
    assert (reports[3]["temperature"] != reports[0]["temperature"]) == learned


def test_the_same_input_gives_the_same_output_and_the_input_stays(variant):
    state, batch = variant.initial_state(), variant.batch(np.random.default_rng(0))
    before = jax.tree.map(np.array, (state, batch))
    first, second = variant.update(state, batch, 0), variant.update(state, batch, 0)
    assert_equal(first, second)
    assert_equal((state, batch), before)


def test_another_key_or_another_step_draws_other_noise(case_of):
    case = case_of("sac/mlp")
    state, batch = case.initial_state(), case.batch(np.random.default_rng(0))
    draws = ((state, 0), (state._replace(key=state.key + 1), 0), (state, 1))
    assert len({case.report(case.update(start, batch, step))["entropy"] for start, step in draws}) == 3


SCANNED = "averaged-auto/mlp", "droq/layer_norm_mlp"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in SCANNED else pytest.mark.slow) for name in VARIANT_CASES]
)
def test_scanned_and_side_by_side_it_equals_repeated_calls(case_of, name):
    """Three learners, vmapped over a scan of three updates, against three loops."""
    variant = case_of(name)
    runs = [after(variant, 3, seed) for seed in range(3)]
    generators = [np.random.default_rng(seed) for seed in range(3)]
    batches = [jax.tree.map(lambda *x: np.stack(x), *[variant.batch(g) for _ in range(3)]) for g in generators]
    starts, batches = (jax.tree.map(lambda *x: jnp.stack(x), *x) for x in ([run[0][0] for run in runs], batches))

    def three_updates(state, stack):
        def update(state, batch_and_step):
            batch, step = batch_and_step
            state = variant.learner.update(variant.numbers, state, batch, context(0)._replace(step=step))
            return state, state.report

        return jax.lax.scan(update, state, (stack, jnp.arange(3)))

    final, reports = jax.jit(jax.vmap(three_updates))(starts, batches)

    for index, (states, _) in enumerate(runs):
        alone = named((states[-1], jnp.stack([state.report for state in states[1:]])))
        side_by_side = named(jax.tree.map(lambda leaf, i=index: leaf[i], (final, reports)))
        assert alone.keys() == side_by_side.keys()
        if "batch" in name:  # what rounding does to one update, its moments carry into all that follows
            np.testing.assert_allclose(side_by_side["[1]"], alone["[1]"], rtol=1e-3, atol=2e-3)
            continue
        for leaf_name, leaf in alone.items():
            np.testing.assert_allclose(side_by_side[leaf_name], leaf, rtol=1e-4, atol=2e-6, err_msg=leaf_name)


def test_rewards_of_several_steps_come_before_a_value_discounted_as_often(case_of):
    """Rows of one to three steps, of which one ends: the target is the reward and γᵐ times the soft value."""
    case = case_of("sac/mlp", batch_size=3)
    state, batch = case.initial_state(), case.batch(np.random.default_rng(0))

    def target(**changes) -> float:
        return case.report(case.update(state, batch._replace(reward_terms=np.zeros((3, 1), np.float32), **changes), 0))[
            "target_mean"
        ]

    rows = np.eye(3, dtype=np.float32)
    values = [target(terminated=1 - row) * 3 / case.settings.discount for row in rows]
    steps, discount = np.array([1, 2, 3], np.float32), case.settings.discount
    expected = (values[0] * discount + values[2] * discount**3) / 3
    assert target(terminated=rows[1], steps=steps) == pytest.approx(expected, rel=1e-5)


def test_averaging_over_one_snapshot_or_minibatch_is_sac_by_its_settings(case_of):
    plain = case_of("sac/mlp").settings
    assert case_of("averaged/mlp", snapshots=1).settings == plain
    assert case_of("averaged-auto/mlp", snapshots=1).settings == case_of("sac-auto/mlp").settings
    assert case_of("averaged-entropy/mlp", entropy_window=1).settings == plain


def test_averaging_over_one_snapshot_is_sac_bit_for_bit(case_of):
    """The ring of one takes the same path through the code as ten do."""
    plain, _ = after(case_of("sac/mlp"), 6)
    averaged, _ = after(case_of("averaged/mlp", snapshots=1, snapshot_interval=4), 6)
    assert_equal(plain[-1], averaged[-1])


def test_averaging_differs_from_sac_as_soon_as_the_snapshots_differ(case_of):
    plain, plain_metrics = after(case_of("sac/mlp"), 3)
    averaged, averaged_metrics = after(case_of("averaged/mlp"), 3)
    assert (
        np.abs(plain[1].critic.weights - averaged[1].critic.weights).max() < 1e-6
    )  # all snapshots are still the same network
    assert np.abs(plain[3].critic.weights - averaged[3].critic.weights).max() > 1e-4
    assert [m["snapshot_spread"] > 1e-4 for m in averaged_metrics] == [False, True, True]
    assert [m["snapshot_spread"] for m in plain_metrics] == [0, 0, 0]


def test_a_fixed_temperature_of_zero_is_finite_and_leaves_the_entropy_out(case_of):
    states, reports = after(case_of("sac/mlp", initial_temperature=0.0), 3)
    assert np.isneginf(states[-1].temperature.weights)
    for report in reports:
        assert np.isfinite(list(report.values())).all()
        assert report["temperature"] == report["temperature_loss"] == 0
    assert np.isfinite(states[-1].actor.weights).all()
    assert np.isfinite(states[-1].critic.weights).all()
    assert not np.asarray(states[-1].entropy_terms).any()


def test_the_reward_is_the_weighted_sum_of_its_terms_over_the_scale(case_of):
    case = case_of("sac/mlp")
    state, batch = case.initial_state(), case.batch(np.random.default_rng(0))
    terms = np.concatenate([batch.reward_terms, 2 * batch.reward_terms, np.ones_like(batch.reward_terms)], axis=1)
    weighted = context(0)._replace(reward_weights=np.array([1.0, -0.25, 3.0], np.float32), reward_scale=np.float32(0.5))
    ours = case.compiled(case.numbers, state, batch._replace(reward_terms=terms), weighted)
    same = batch._replace(reward_terms=(batch.reward_terms * (1 - 0.5) + 3) / 0.5)
    np.testing.assert_allclose(ours.report, case.update(state, same, 0).report, rtol=1e-5)


def test_each_pair_of_three_critics_values_the_next_state_equally_often():
    settings = AlgorithmSettings(critics=3, target_critics=2)
    parts = Parts._make([settings] + [None] * (len(Parts._fields) - 1))
    pairs = np.asarray(jax.vmap(parts.chosen_critics)(jax.random.split(jax.random.PRNGKey(0), 3000)))
    smaller = np.array([5.0, 1.0, 3.0])[pairs].min(axis=1)
    assert smaller.mean() == pytest.approx(5 / 3, abs=0.07)  # 1 of two pairs, 3 of one; four standard deviations
    assert {tuple(sorted(pair)) for pair in pairs.tolist()} == {(0, 1), (0, 2), (1, 2)}


def test_a_policy_that_learns_jointly_normalises_by_both_states(case_of):
    """And its loss counts the first of them only."""
    changes = {"network": "batch_norm_mlp", "hidden_layers": (8,)}
    joint, apart = (case_of("sac/mlp", actor_joint_forward=both, **changes) for both in (True, False))
    state, batch = joint.initial_state(), joint.batch(np.random.default_rng(0))
    moved = batch._replace(next_observation=batch.next_observation + 5)
    of_both, of_one = (case.update(state, moved, 0).actor.weights for case in (joint, apart))
    network, size = joint.learner.policy.network, joint.settings.batch_size
    means = np.asarray(of_both[network.size - network.statistics :][:3]) / 0.01  # of the inputs; they started at 0
    both = np.concatenate([moved.observation, moved.next_observation])
    np.testing.assert_allclose(means, both.mean(axis=0), rtol=1e-3)
    assert len(both) == 2 * size
    assert np.abs(of_both - of_one).max() > 1e-3
    same = batch._replace(next_observation=batch.observation)  # the same moments, and so the same step
    ours, theirs = (case.update(state, same, 0).report for case in (joint, apart))
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_the_numpy_policy_of_a_trained_actor_acts_like_the_jax_one(variant):
    state = after(variant, 3)[0][-1]
    observation = np.random.default_rng(0).standard_normal((5, 3)).astype(np.float32)
    policy = variant.learner.policy
    on_host = policy.mode(np.asarray(state.actor.weights), observation)
    assert isinstance(on_host, np.ndarray)
    np.testing.assert_allclose(
        on_host, policy.mode(state.actor.weights, jnp.asarray(observation)), rtol=1e-5, atol=1e-6
    )
