"""One SAC update, put together from its parts. Read losses, targets, then this."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from saclab.algorithm import losses, targets
from saclab.algorithm.networks import NETWORKS, Network
from saclab.algorithm.numbers import Numbers, numbers_of
from saclab.algorithm.policy import Policy, make_policy
from saclab.algorithm.temperature import TEMPERATURES, Temperature
from saclab.algorithm.types import Batch, LearnerState, Metrics, Optimizers, TargetState
from saclab.config import AlgorithmSettings


class Learner(NamedTuple):
    """A variant of SAC for one shape of observations and actions, as pure functions."""

    init: Callable[[jax.Array], LearnerState]
    """From a key u32[2] (`jax.random.PRNGKey`)."""
    update: Callable[[LearnerState, Batch], tuple[LearnerState, Metrics]]
    """A body for jit and `lax.scan`; `jax.vmap` runs many learners at once."""
    policy: Policy
    """What `LearnerState.actor` parametrises."""
    q_network: Network
    """What each row of `LearnerState.critic` parametrises, on an observation and an action."""


class Parts(NamedTuple):
    """The axis values that a variant is put together from."""

    settings: AlgorithmSettings
    numbers: Numbers
    action_size: int
    policy: Policy
    q_network: Network
    temperature: Temperature
    actor_optimizer: optax.GradientTransformation
    critic_optimizer: optax.GradientTransformation

    def q_values(self, critic: jax.Array, *state_and_action: jax.Array) -> jax.Array:
        """Each critic's Q(s, a): f32[C, B] for critics f32[C, P], and s and a in one array or in two."""
        q: jax.Array = jax.vmap(lambda parameters: self.q_network.apply(parameters, *state_and_action))(critic)
        return jnp.squeeze(q, axis=-1)

    def sample(self, actor: jax.Array, observation: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Actions f32[B, A] of the policy and their log-densities f32[B]."""
        noise = jax.random.normal(key, (observation.shape[0], self.action_size))
        return self.policy.sample(actor, observation, noise)


def make_learner(
    settings: AlgorithmSettings, observation_size: int, action_size: int, traced: Numbers | None = None
) -> Learner:
    """The learner of `settings` for observations f32[observation_size] and actions f32[action_size] in [-1, 1].

    Numbers that are `traced` take the place of those in `settings`: mapped over, they make a learner for each run.
    """
    numbers = traced or numbers_of(settings, action_size)
    policy = make_policy(settings, observation_size, action_size)
    parts = Parts(
        settings=settings,
        numbers=numbers,
        action_size=action_size,
        policy=policy._replace(log_std_minimum=numbers.log_std_minimum, log_std_maximum=numbers.log_std_maximum),
        q_network=NETWORKS[settings.network](
            observation_size + action_size, settings.hidden_layers, 1, settings.activation
        ),
        temperature=TEMPERATURES["either" if traced else settings.temperature](settings, numbers),
        actor_optimizer=optax.adam(numbers.actor_learning_rate),
        critic_optimizer=optax.adam(numbers.critic_learning_rate),
    )
    return Learner(partial(init, parts), partial(update, parts), parts.policy, parts.q_network)


def side_by_side(state: jax.Array, action: jax.Array) -> jax.Array:
    """One f32[B, O + A]: faster than two arrays where no gradient with respect to the action is wanted."""
    return jnp.concatenate([state, action], axis=-1)


def init(parts: Parts, key: jax.Array) -> LearnerState:
    """The state before the first update."""
    actor_key, critic_key, update_key = jax.random.split(key, 3)
    actor = parts.policy.network.init(actor_key)
    critic = jax.vmap(parts.q_network.init)(jax.random.split(critic_key, parts.settings.critics))
    log_alpha = jnp.log(jnp.asarray(parts.settings.initial_temperature, jnp.float32))
    return LearnerState(
        actor=actor,
        critic=critic,
        target=targets.init_target(parts.settings, critic),
        log_alpha=log_alpha,
        optimizers=Optimizers(
            actor=parts.actor_optimizer.init(actor),
            critic=parts.critic_optimizer.init(critic),
            temperature=parts.temperature.init(log_alpha),
        ),
        key=update_key,
        step=jnp.zeros((), jnp.int32),
    )


def update(parts: Parts, state: LearnerState, batch: Batch) -> tuple[LearnerState, Metrics]:
    """One update of everything, in this order: critic, actor, temperature, targets."""
    next_key, actor_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    alpha = jnp.exp(state.log_alpha)

    critic, critic_moments, entropy_terms, critic_metrics = update_critic(parts, state, batch, alpha, next_key)
    actor, actor_moments, log_prob, actor_loss = update_actor(parts, state, critic, batch, alpha, actor_key)
    log_alpha, temperature_moments, temperature_loss = parts.temperature.update(
        state.log_alpha, state.optimizers.temperature, log_prob
    )
    snapshots = targets.follow(parts.numbers, state.target.snapshots, critic, state.step)

    next_state = LearnerState(
        actor=actor,
        critic=critic,
        target=TargetState(snapshots, entropy_terms),
        log_alpha=log_alpha,
        optimizers=Optimizers(actor_moments, critic_moments, temperature_moments),
        key=state.key,
        step=state.step + 1,
    )
    metrics = Metrics(
        actor_loss=actor_loss,
        temperature_loss=temperature_loss,
        temperature=alpha,
        entropy=-jnp.mean(log_prob),
        **critic_metrics,
    )
    return next_state, metrics


def update_critic(
    parts: Parts, state: LearnerState, batch: Batch, alpha: jax.Array, key: jax.Array
) -> tuple[jax.Array, optax.OptState, jax.Array, dict[str, jax.Array]]:
    """Eq. 3 with the value of Eq. 4 or 9: the new critics, their moments, the entropy terms, and metrics."""
    next_action, next_log_prob = parts.sample(state.actor, batch.next_observation, key)
    next_q = jax.vmap(parts.q_values, in_axes=(0, None))(
        state.target.snapshots, side_by_side(batch.next_observation, next_action)
    )
    next_value = targets.next_value(parts.settings, state.target, next_q, alpha * next_log_prob, state.step)
    target = losses.critic_target(batch.reward, batch.terminated, next_value.value, parts.numbers.discount)

    def objective(critic: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = parts.q_values(critic, side_by_side(batch.observation, batch.action))
        return losses.critic_loss(q, target), q

    (loss, q), gradient = jax.value_and_grad(objective, has_aux=True)(state.critic)
    change, moments = parts.critic_optimizer.update(gradient, state.optimizers.critic)
    metrics = {
        "critic_loss": loss,
        "q_mean": jnp.mean(q),
        "q_spread": jnp.mean(jnp.std(q, axis=0)),
        "target_mean": jnp.mean(target),
        "snapshot_spread": next_value.snapshot_spread,
    }
    return state.critic + change, moments, next_value.entropy_terms, metrics


def update_actor(
    parts: Parts, state: LearnerState, critic: jax.Array, batch: Batch, alpha: jax.Array, key: jax.Array
) -> tuple[jax.Array, optax.OptState, jax.Array, jax.Array]:
    """Eq. 5 on the new critics: the new actor, its moments, log π f32[B] of the old actor, and the loss."""
    reduce = targets.REDUCTIONS[parts.settings.actor_reduction]

    def objective(actor: jax.Array) -> tuple[jax.Array, jax.Array]:
        action, log_prob = parts.sample(actor, batch.observation, key)
        q = reduce(parts.q_values(critic, batch.observation, action))
        return losses.actor_loss(log_prob, q, alpha), log_prob

    (loss, log_prob), gradient = jax.value_and_grad(objective, has_aux=True)(state.actor)
    change, moments = parts.actor_optimizer.update(gradient, state.optimizers.actor)
    return state.actor + change, moments, log_prob, loss
