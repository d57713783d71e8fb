"""Observations are normalised by what the run has met: by hand, in an update, in a policy on disk."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ACTION_SIZE, OBSERVATION_SIZE, context

import saclab
from saclab.algorithm.networks import critic_network, policy_network
from saclab.algorithm.networks.normalised_inputs import with_moments
from saclab.protocols import make_config
from saclab.training.checkpoint import CheckpointError
from saclab.training.local_engine import LocalEngine
from saclab.training.observation_moments import ObservationMoments


def test_the_moments_are_those_of_all_observations():
    moments = ObservationMoments("running", 3)
    assert moments.value.tolist() == [[0, 0, 0], [1, 1, 1]]
    observations = np.random.default_rng(0).normal([1e4, -2, 0], [1, 3, 0], (50, 2, 3)).astype(np.float32)
    for observation in observations:
        moments.enter(observation)
    every = observations.reshape(100, 3).astype(np.float64)
    expected = [every.mean(axis=0), np.sqrt(every.var(axis=0) + 1e-8)]
    np.testing.assert_allclose(moments.value, expected, rtol=1e-6, atol=1e-9)
    assert moments.value[1, 2] == pytest.approx(1e-4), "one that never changes comes out as 0"


def test_nothing_is_normalised_unless_it_is_asked_for():
    moments = ObservationMoments("none", 3)
    moments.enter(np.ones((1, 3)))
    assert moments.value is None
    assert moments.capture() == {}


def test_it_goes_on_as_if_it_had_never_stopped():
    first, second = (ObservationMoments("running", 2) for _ in range(2))
    first.enter(np.array([[1.0, 2.0], [3.0, -2.0]]))
    second.restore(first.capture())
    for moments in (first, second):
        moments.enter(np.array([[0.5, 0.25]]))
    np.testing.assert_array_equal(first.value, second.value)
    with pytest.raises(CheckpointError, match="mean"):
        second.restore({"count": np.zeros(1), "variance": np.ones(2)})


MOMENTS = np.array([[1.0, -2.0, 0.5], [2.0, 4.0, 0.1]], np.float32)


def normalised(state):
    """The same learner with networks that normalise by MOMENTS."""

    def longer(vector, inputs):
        moments = jnp.broadcast_to(jnp.zeros(2 * inputs), (*vector.shape[:-1], 2 * inputs))
        return with_moments(jnp.concatenate([vector, moments], axis=-1), inputs, MOMENTS)

    sizes = {"actor": OBSERVATION_SIZE, "critic": OBSERVATION_SIZE + ACTION_SIZE}
    trained = {
        name: getattr(state, name)._replace(
            weights=longer(getattr(state, name).weights, size),
            moments=jax.tree.map(
                lambda leaf, n=size: (
                    leaf if leaf.ndim == 0 else jnp.concatenate([leaf, jnp.zeros((*leaf.shape[:-1], 2 * n))], axis=-1)
                ),
                getattr(state, name).moments,
            ),
        )
        for name, size in sizes.items()
    }
    return state._replace(**trained, targets=longer(state.targets, sizes["critic"]))


@pytest.mark.parametrize("name", ["sac-auto/mlp", pytest.param("xqc/batch_norm_mlp", marks=pytest.mark.slow)])
def test_an_update_is_that_of_normalised_transitions(case_of, name):
    """Stored as they came, they are learnt from as if they had been normalised before.

    Batch normalisation leaves gradients that are 0 but for rounding, and Adam makes whole steps of them: the gradients
    are compared, and the steps are so short that what comes after them does not notice.
    """
    short = {f"{trained}_learning_rate": 1e-7 for trained in ("actor", "critic", "temperature")}
    plain, with_axis = case_of(name, **short), case_of(name, observation_normalisation="running", **short)
    start, batch = plain.initial_state(), plain.batch(np.random.default_rng(0))
    seen = batch._replace(
        observation=(batch.observation - MOMENTS[0]) / MOMENTS[1],
        next_observation=(batch.next_observation - MOMENTS[0]) / MOMENTS[1],
    )
    expected = plain.update(start, seen, 0)
    begun = normalised(start)
    given = context(0)._replace(observation_moments=MOMENTS)
    got = with_axis.compiled(with_axis.numbers, begun, batch, given)
    np.testing.assert_allclose(got.report, expected.report, rtol=1e-4, atol=1e-5)
    for ours, theirs in ((got.actor, expected.actor), (got.critic, expected.critic)):
        size, gradient = theirs.weights.shape[-1], np.asarray(theirs.moments.mu)
        scale = np.abs(gradient).max()
        assert scale > 0
        np.testing.assert_allclose(ours.moments.mu[..., :size], gradient, rtol=1e-4, atol=1e-4 * scale)
        assert not np.asarray(ours.moments.mu)[..., size:].any(), "the moments are not trained"


def test_every_network_of_an_update_takes_the_moments_of_the_day(case_of):
    case = case_of("averaged-auto/mlp", observation_normalisation="running")
    state = case.initial_state()
    assert np.asarray(state.actor.weights)[-6:].tolist() == [0, 0, 0, 1, 1, 1]
    given = context(0)._replace(observation_moments=MOMENTS)
    state = case.compiled(case.numbers, state, case.batch(np.random.default_rng(0)), given)
    assert np.asarray(state.actor.weights)[-6:].tolist() == MOMENTS.ravel().tolist()
    of_critics = [*MOMENTS[0].tolist(), 0, 0, *MOMENTS[1].tolist(), 1, 1]
    for vectors in (state.critic.weights, state.targets):
        last = np.asarray(vectors)[..., -10:]
        np.testing.assert_allclose(last, np.broadcast_to(of_critics, last.shape))


def test_networks_normalise_in_numpy_and_in_jax_and_leave_actions_alone(case_of):
    settings = case_of("sac/mlp", observation_normalisation="running").settings
    policy, critic = policy_network(settings, 3, 4), critic_network(settings, 5, 1)
    x, action = np.float32([[3.0, 2.0, 0.7]]), np.float32([[0.25, -0.5]])
    z = (x - MOMENTS[0]) / MOMENTS[1]
    plain = dataclasses.replace(settings, observation_normalisation="none")
    vector = with_moments(policy.init(jax.random.PRNGKey(0)), 3, MOMENTS)
    expected = policy_network(plain, 3, 4).apply(vector[:-6], z)
    np.testing.assert_allclose(policy.apply(np.asarray(vector), x), expected, rtol=1e-5)
    vector = with_moments(critic.init(jax.random.PRNGKey(0)), 5, MOMENTS)
    expected = critic_network(plain, 5, 1).apply(vector[:-10], z, action)
    for inputs in ((x, action), (np.hstack([x, action]),)):
        np.testing.assert_allclose(critic.apply(np.asarray(vector), *inputs), expected, rtol=1e-5)


def test_a_run_meets_each_observation_once_and_its_policy_keeps_them(tmp_path):
    settings = {
        "observation_normalisation": "running", "hidden_layers": (8, 8), "batch_size": 8, "random_steps": 30,
        "max_steps": 60, "evaluation_interval_steps": 60, "evaluation_episodes": 1,
    }  # fmt: skip
    engine, observations = LocalEngine.new(make_config("Pendulum-v1", "sac", "quick", overrides=settings)), []
    for _ in range(60):
        observations.append(engine.environments.observation.copy())
        engine.step()
    moments = np.asarray(engine.actor(0))[-6:].reshape(2, 3)
    np.testing.assert_allclose(moments[0], np.concatenate(observations).mean(axis=0), rtol=1e-4)
    engine.close()

    run = saclab.train("Pendulum-v1", "sac", protocol="quick", runs=tmp_path, **settings)
    policy = saclab.load_policy(run.path)
    np.testing.assert_array_equal(policy.parameters[-6:], np.asarray(engine.actor(0))[-6:])
    observation = np.concatenate(observations)[:5]
    plain = dataclasses.replace(run.config.algorithm, observation_normalisation="none")
    seen = (observation - moments[0]) / moments[1]
    expected = np.tanh(policy_network(plain, 3, 2).apply(policy.parameters[:-6], seen))
    np.testing.assert_allclose(policy.predict(observation)[0] / 2, expected[:, :1], rtol=1e-4, atol=1e-6)
