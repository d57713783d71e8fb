"""The value of the next state: Eq. 4 averaged over the last K target networks (Eq. 9), and Eq. 2.

K = 1 is plain SAC and takes the same path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from saclab.algorithm.numbers import Numbers
from saclab.algorithm.types import TargetState
from saclab.config import AlgorithmSettings

REDUCTIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    # f32[C, B] -> f32[B]
    "minimum": lambda q: jnp.min(q, axis=0),
    "mean": lambda q: jnp.mean(q, axis=0),
}


class NextValue(NamedTuple):
    value: jax.Array
    """f32[B]: V(s′)."""
    entropy_terms: jax.Array
    """f32[W, B]: the ring after this minibatch."""
    snapshot_spread: jax.Array
    """f32[]: mean over the batch of the standard deviation between snapshots."""


def init_target(settings: AlgorithmSettings, critic: jax.Array) -> TargetState:
    """All K snapshots start as the critic f32[C, P]; the entropy terms start at zero."""
    return TargetState(
        snapshots=jnp.repeat(critic[None], settings.snapshots, axis=0),
        entropy_terms=jnp.zeros((settings.entropy_window, settings.batch_size), critic.dtype),
    )


def next_value(
    settings: AlgorithmSettings, target: TargetState, q: jax.Array, entropy_term: jax.Array, step: jax.Array
) -> NextValue:
    """V(s′) = mean over k of [reduction over i of Q_ki(s′, a′)] − α log π(a′|s′)   (Eq. 4, Eq. 9).

    Args:
        settings: the axes of the variant.
        target: the state before this update.
        q: f32[K, C, B], each snapshot's critics on the same next states and actions.
        entropy_term: f32[B], α log π(a′|s′) of this minibatch.
        step: i32[], updates made before this one.
    """
    reduced = jax.vmap(REDUCTIONS[settings.target_reduction])(q)
    entropy_terms = target.entropy_terms.at[step % settings.entropy_window].set(entropy_term)
    return NextValue(
        value=jnp.mean(reduced, axis=0) - jnp.mean(entropy_terms, axis=0),
        entropy_terms=entropy_terms,
        snapshot_spread=jnp.mean(jnp.std(reduced, axis=0)),
    )


def live_slot(numbers: Numbers, snapshots: int, step: jax.Array) -> jax.Array:
    """The slot, in a ring of `snapshots`, of the target that follows the critic after `step` updates."""
    slot: jax.Array = (step // numbers.snapshot_interval) % snapshots
    return slot


def follow(numbers: Numbers, snapshots: jax.Array, critic: jax.Array, step: jax.Array) -> jax.Array:
    """Eq. 2 on the live target: θ̄ ← (1 − τ) θ̄ + τ θ.

    The result becomes the live target after step + 1 updates. Every `snapshot_interval` updates that is a new
    slot, and the value before stays behind as a snapshot; otherwise it takes the place of the value before.
    """
    live = jnp.take(snapshots, live_slot(numbers, len(snapshots), step), axis=0)
    moved = (1 - numbers.polyak_rate) * live + numbers.polyak_rate * critic
    return snapshots.at[live_slot(numbers, len(snapshots), step + 1)].set(moved)
