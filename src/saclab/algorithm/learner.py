"""One SAC update, put together from its parts. Read losses, targets, then this."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from saclab.algorithm.heads import HEADS, CriticHead
from saclab.algorithm.losses import actor_loss, temperature_loss
from saclab.algorithm.metrics import METRICS
from saclab.algorithm.networks import critic_network
from saclab.algorithm.networks.network import Array, Network
from saclab.algorithm.networks.normalised_inputs import with_moments
from saclab.algorithm.optimizer import Trainer, descend
from saclab.algorithm.policy import Policy, make_policy
from saclab.algorithm.scalars import Scalars
from saclab.algorithm.targets import TARGET_REDUCTIONS, averaged_entropy, averaged_prediction, polyak_update, reduced_q
from saclab.algorithm.types import Batch, Context, LearnerState
from saclab.settings import AlgorithmSettings


def metric_names(settings: AlgorithmSettings) -> tuple[str, ...]:
    """What the updates of a variant report."""
    return tuple(name for name in METRICS if name != "reward_scale" or settings.reward_scaling != "none")


class Learner(NamedTuple):
    """A variant of SAC for one shape of observations and actions, as pure functions."""

    init: Callable[[Scalars, jax.Array], LearnerState]
    """(plain numbers, key u32[2]) -> the state before the first update; the key is a `jax.random.PRNGKey`."""
    update: Callable[[Scalars, LearnerState, Batch, Context], LearnerState]
    """A body for jit and `lax.scan`; `jax.vmap` runs many learners at once."""
    policy: Policy
    """What `LearnerState.actor` parametrises."""
    q_values: Callable[..., Array]
    """(one critic f32[P], *inputs) -> Q f32[...] for s and a in one array or in two, NumPy or JAX."""
    metrics: tuple[str, ...]
    """Names of the entries of `LearnerState.report`."""


class Parts(NamedTuple):
    """The axis values that a variant is put together from."""

    settings: AlgorithmSettings
    action_size: int
    policy: Policy
    q_network: Network
    head: CriticHead
    actor_trainer: Trainer
    critic_trainer: Trainer
    temperature_trainer: Trainer

    def noise(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """Standard normal, f32[B, A]."""
        return jax.random.normal(key, (observation.shape[0], self.action_size))

    def q_outputs(self, critic: jax.Array, state: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        """Outputs f32[C, B, n] of critics f32[C, P], for the policy's loss."""

        def evaluated(row: jax.Array, key: jax.Array) -> Array:
            return self.q_network.apply(row, state, action)

        def trained(row: jax.Array, key: jax.Array) -> Array:
            return self.q_network.train(row, state, action, key=key)[0]

        one = {"evaluation": evaluated, "training": trained}[self.settings.critic_mode_for_actor]
        outputs: jax.Array = of_each(one, critic, jax.random.split(key, len(critic)))
        return outputs

    def chosen_critics(self, key: jax.Array) -> jax.Array | slice:
        """Which critics value the next state: all, or `target_critics` of them, drawn without replacement."""
        if self.settings.target_critics is None:
            return slice(None)
        return jax.random.permutation(key, self.settings.critics)[: self.settings.target_critics]

    def q(self, outputs: jax.Array) -> jax.Array:
        """f32[...] for outputs f32[..., n] of the Q-network."""
        q: jax.Array = self.head.mean(self.head.prediction(outputs))
        return q


def make_learner(settings: AlgorithmSettings, observation_size: int, action_size: int) -> Learner:
    """The learner of `settings` for observations f32[observation_size] and actions f32[action_size] in [-1, 1].

    Their plain numbers play no part: they are arguments of `init` and `update` (`scalars`).
    """
    head, policy = HEADS[settings.critic_head](settings), make_policy(settings, observation_size, action_size)
    q_network = critic_network(settings, observation_size + action_size, head.outputs)
    schedule = settings.learning_rate_schedule
    parts = Parts(
        settings=settings,
        action_size=action_size,
        policy=policy,
        q_network=q_network,
        head=head,
        actor_trainer=Trainer("actor", schedule, policy.network.project),
        critic_trainer=Trainer("critic", schedule, jax.vmap(q_network.project)),
        temperature_trainer=Trainer("temperature", schedule),
    )

    def q_values(critic: Array, *state_and_action: Array) -> Array:
        return parts.q(q_network.apply(critic, *state_and_action))

    return Learner(partial(init, parts), partial(update, parts), policy, q_values, metric_names(settings))


def init(parts: Parts, numbers: Scalars, key: jax.Array) -> LearnerState:
    """The state before the first update: every target snapshot is the critic, all entropy terms are zero."""
    actor_key, critic_key, update_key = jax.random.split(key, 3)
    settings = parts.settings
    critic = jax.vmap(parts.q_network.init)(jax.random.split(critic_key, settings.critics))
    return LearnerState(
        actor=parts.actor_trainer.start(parts.policy.network.init(actor_key)),
        critic=parts.critic_trainer.start(critic),
        temperature=parts.temperature_trainer.start(jnp.log(numbers["initial_temperature"])),
        targets=jnp.repeat(critic[None], settings.snapshots, axis=0),
        entropy_terms=jnp.zeros((settings.entropy_window, settings.batch_size), critic.dtype),
        report=jnp.zeros(len(metric_names(settings)), critic.dtype),
        key=update_key,
    )


def update(parts: Parts, numbers: Scalars, state: LearnerState, batch: Batch, context: Context) -> LearnerState:
    """One update of everything, in the variant's order: critic, actor, temperature, targets, unless it says another."""
    key = jax.random.fold_in(state.key, context.step)
    state = take_moments(state, batch, context)
    found = {"temperature": jnp.exp(state.temperature.weights), "reward_scale": context.reward_scale}
    names = metric_names(parts.settings)
    state = state._replace(report={name: found.get(name, state.report[place]) for place, name in enumerate(names)})
    for name in parts.settings.update_order:
        state = UPDATES[name](parts, numbers, state, batch, context, key)
    return state._replace(report=jnp.stack([state.report[name] for name in names]))


def take_moments(state: LearnerState, batch: Batch, context: Context) -> LearnerState:
    """`state` with networks that normalise observations by the run's present moments, where any does."""
    if context.observation_moments is None:
        return state
    of_policy = batch.observation.shape[1]
    of_critic = of_policy + batch.action.shape[1]
    actor = with_moments(state.actor.weights, of_policy, context.observation_moments)
    critic = with_moments(state.critic.weights, of_critic, context.observation_moments)
    return state._replace(
        actor=state.actor._replace(weights=actor),
        critic=state.critic._replace(weights=critic),
        targets=with_moments(state.targets, of_critic, context.observation_moments),
    )


FOR_NETWORKS = 1  # folded into the key of a noise, it is that of the networks that draw something while they learn
FOR_CRITICS = 2  # likewise: of the critics in the policy's loss
FOR_CHOICE = 3  # likewise: of the critics that value the next state
WRITTEN_OUT = 2
"""Most critics whose passes the compiled program holds one by one; with more it was not tried."""
Result = TypeVar("Result")
Passes = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
Update = Callable[[Parts, Scalars, LearnerState, Batch, Context, jax.Array], LearnerState]


def update_critic(
    parts: Parts, numbers: Scalars, state: LearnerState, batch: Batch, context: Context, key: jax.Array
) -> LearnerState:
    """Eq. 3 with the value of Eq. 4 or 9."""
    key, _ = jax.random.split(key)
    network_key = jax.random.fold_in(key, FOR_NETWORKS)
    chosen = parts.chosen_critics(jax.random.fold_in(key, FOR_CHOICE))
    next_noise = parts.noise(batch.next_observation, key)
    next_action, next_log_prob = parts.policy.sample(state.actor.weights, batch.next_observation, next_noise)
    entropy_term, entropy_terms = averaged_entropy(
        state.entropy_terms, jnp.exp(state.temperature.weights) * next_log_prob, context.step
    )
    reward = jnp.sum(batch.reward_terms * context.reward_weights, axis=1) / context.reward_scale
    over_steps = numbers["discount"] if batch.steps is None else numbers["discount"] ** batch.steps
    discount = over_steps * (1 - batch.terminated)

    def objective(critic: jax.Array) -> tuple[jax.Array, tuple[jax.Array, dict[str, jax.Array]]]:
        outputs, next_outputs, statistics = forward(
            parts, critic, state.targets[:, chosen], batch, next_action, chosen, network_key
        )
        predictions = parts.head.prediction(next_outputs)
        reduce = TARGET_REDUCTIONS[parts.settings.target_reduction](parts.settings)
        prediction, snapshot_spread = averaged_prediction(predictions, parts.head.mean, reduce)
        target = jax.lax.stop_gradient(parts.head.backup(prediction, reward, discount, entropy_term))
        loss, q = parts.head.loss(outputs, target), parts.q(outputs)
        report = {
            "critic_loss": loss,
            "q_mean": jnp.mean(q),
            "q_spread": jnp.mean(jnp.std(q, axis=0)),
            "target_mean": jnp.mean(parts.head.mean(target)),
            "snapshot_spread": snapshot_spread,
        }
        return loss, (statistics, report)

    critic, (statistics, report) = descend(parts.critic_trainer, numbers, objective, state.critic)
    critic = critic._replace(weights=parts.q_network.remember(critic.weights, statistics))
    return state._replace(critic=critic, entropy_terms=entropy_terms, report=state.report | report)


def forward(
    parts: Parts,
    critic: jax.Array,
    targets: jax.Array,
    batch: Batch,
    next_action: jax.Array,
    chosen: jax.Array | slice,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """All passes of the Q-networks that a critic's update needs.

    Returns:
        The critics' outputs f32[C, B, n] on (s, a); those on (s′, a′) of the chosen critics in each target snapshot, or
        of the critics themselves where there is none, f32[K or 1, M, B, n]; the critics' running statistics f32[C, S]
        that follow.
    """
    now = jnp.concatenate([batch.observation, batch.action], axis=1)  # in one array: no gradient of the action is due
    then = jnp.concatenate([batch.next_observation, next_action], axis=1)

    def passes(critics: jax.Array, inputs: jax.Array, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        return of_each(lambda critic, key: parts.q_network.train(critic, inputs, key=key), critics, keys)

    of_targets: Passes = jax.vmap(passes, in_axes=(0, None, 0))
    own_keys, target_keys = jax.random.split(key, len(critic)), split_for(key, max(1, len(targets)), targets.shape[1])
    if not parts.settings.joint_forward:
        outputs, statistics = passes(critic, now, own_keys)
        next_outputs, _ = of_targets(targets if len(targets) else critic[None, chosen], then, target_keys)
        return outputs, next_outputs, statistics
    both, size = jnp.concatenate([now, then]), len(now)
    outputs, statistics = passes(critic, both, own_keys)
    if len(targets):
        next_outputs = of_targets(targets, both, target_keys)[0][..., size:, :]
    else:
        next_outputs = outputs[None, chosen, size:]
    return outputs[:, :size], next_outputs, statistics


def of_each(function: Callable[[jax.Array, jax.Array], Result], critics: jax.Array, keys: jax.Array) -> Result:
    """What `function(critic f32[P], key u32[2])` gives for critics f32[C, P] and keys u32[C, 2], each result stacked.

    A few critics are written out one after the other: that is faster than products of one batch (docs/speed.md).
    """
    if len(critics) > WRITTEN_OUT:
        return jax.vmap(function)(critics, keys)
    results = [function(critic, key) for critic, key in zip(critics, keys, strict=True)]
    stacked: Result = jax.tree.map(lambda *parts: jnp.stack(parts), *results)
    return stacked


def split_for(key: jax.Array, snapshots: int, critics: int) -> jax.Array:
    """Keys u32[K, C, 2] for the target networks, other than those of the critics."""
    keys: jax.Array = jax.random.split(jax.random.fold_in(key, FOR_NETWORKS), (snapshots, critics))
    return keys


def update_actor(
    parts: Parts, numbers: Scalars, state: LearnerState, batch: Batch, context: Context, key: jax.Array
) -> LearnerState:
    """Eq. 5 on the critics as they are now."""
    _, key = jax.random.split(key)
    alpha = jnp.exp(state.temperature.weights)
    noise = parts.noise(batch.observation, key)
    critics_key = jax.random.fold_in(key, FOR_CRITICS)
    joint = parts.settings.actor_joint_forward
    seen = jnp.concatenate([batch.observation, batch.next_observation]) if joint else batch.observation

    def objective(actor: jax.Array) -> tuple[jax.Array, tuple[jax.Array, dict[str, jax.Array]]]:
        action, log_prob, statistics = parts.policy.train_sample(
            actor, seen, noise, jax.random.fold_in(key, FOR_NETWORKS)
        )
        q = parts.q(parts.q_outputs(state.critic.weights, batch.observation, action, critics_key))
        loss = actor_loss(log_prob, reduced_q(parts.settings.actor_reduction, q), alpha)
        return loss, (statistics, {"actor_loss": loss, "entropy": -jnp.mean(log_prob)})

    actor, (statistics, report) = descend(parts.actor_trainer, numbers, objective, state.actor)
    actor = actor._replace(weights=parts.policy.network.remember(actor.weights, statistics))
    return state._replace(actor=actor, report=state.report | report)


def update_temperature(
    parts: Parts, numbers: Scalars, state: LearnerState, batch: Batch, context: Context, key: jax.Array
) -> LearnerState:
    """Eq. 8, by the entropy of the policy as the actor's update found it."""

    def objective(log_alpha: jax.Array) -> tuple[jax.Array, jax.Array]:
        factor = parts.settings.temperature_gradient
        loss = temperature_loss(log_alpha, state.report["entropy"], numbers["target_entropy"], factor)
        return loss, loss

    temperature, loss = descend(parts.temperature_trainer, numbers, objective, state.temperature)
    learned = numbers["temperature_learning_rate"] > 0
    report = state.report | {"temperature_loss": jnp.where(learned, loss, 0)}
    return state._replace(temperature=temperature, report=report)


def update_targets(
    parts: Parts, numbers: Scalars, state: LearnerState, batch: Batch, context: Context, key: jax.Array
) -> LearnerState:
    """Eq. 2 on the newest snapshot."""
    rate, interval = numbers["polyak_rate"], numbers["snapshot_interval"]
    return state._replace(targets=polyak_update(state.targets, state.critic.weights, rate, interval, context.step))


def at_intervals(part: Update) -> Update:
    """`part`, in every `actor_interval`-th update."""

    def update_or_not(
        parts: Parts, numbers: Scalars, state: LearnerState, batch: Batch, context: Context, key: jax.Array
    ) -> LearnerState:
        interval = parts.settings.actor_interval
        if interval == 1:
            return part(parts, numbers, state, batch, context, key)
        changed: LearnerState = jax.lax.cond(
            context.step % interval == 0,
            lambda same: part(parts, numbers, same, batch, context, key),
            lambda same: same,
            state,
        )
        return changed

    return update_or_not


UPDATES: dict[str, Update] = {
    "critic": update_critic,
    "actor": at_intervals(update_actor),
    "temperature": at_intervals(update_temperature),
    "targets": update_targets,
}
