"""The value of the next state: Eq. 4 averaged over the last K target networks (Eq. 9), and Eq. 2.

K = 1 is plain SAC and takes the same path.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from saclab.algorithm.networks.network import Array
from saclab.settings import AlgorithmSettings

Step = jax.Array | np.int32
Reduction = Callable[[Array, Array], Array]


def minimum(predictions: Array, q: Array) -> Array:
    """The whole prediction of the critic with the smallest Q."""
    xp = q.__array_namespace__()
    smallest = xp.argmin(q, axis=0)[None] == xp.arange(len(q))[:, None]
    return xp.sum(xp.where(smallest[..., None], predictions, 0), axis=0)


def mean(predictions: Array, q: Array) -> Array:
    return predictions.__array_namespace__().mean(predictions, axis=0)


def reduced_q(reduction: str, q: Array) -> Array:
    """One Q f32[B] of all critics' f32[C, B]."""
    one: Array = REDUCTIONS[reduction](q[..., None], q)[:, 0]
    return one


REDUCTIONS: dict[str, Reduction] = {"minimum": minimum, "mean": mean}
"""Name -> (predictions f32[C, B, n], their Q f32[C, B]) -> f32[B, n], NumPy or JAX."""


def truncated(quantiles: Array, q: Array, dropped: int) -> Array:
    """The quantiles f32[C, B, n] of all critics in order, without the `dropped` · C largest: f32[B, C·(n − dropped)].

    Of "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile Critics" (Kuznetsov
    et al. 2020).
    """
    critics, rows, count = quantiles.shape
    pooled = jnp.sort(jnp.moveaxis(quantiles, 0, 1).reshape(rows, critics * count), axis=1)
    return pooled[:, : critics * (count - dropped)]


TARGET_REDUCTIONS: dict[str, Callable[[AlgorithmSettings], Reduction]] = {
    "minimum": lambda settings: minimum,
    "mean": lambda settings: mean,
    "truncated": lambda settings: partial(truncated, dropped=settings.dropped_quantiles),
}
"""Name -> settings -> how the target reduces the critics; what a reduction gives may have another n."""


def averaged_prediction(
    predictions: jax.Array, to_q: Callable[[jax.Array], jax.Array], reduce: Reduction
) -> tuple[jax.Array, jax.Array]:
    """The mean over k of [reduction over i of Z_ki(s′, a′)] (Eq. 4 and 9, without the entropy).

    Args:
        predictions: f32[K, C, B, n], each snapshot's critics on the same next states and actions.
        to_q: prediction f32[..., n] -> Q f32[...].
        reduce: of REDUCTIONS, or what one of TARGET_REDUCTIONS gives.

    Returns:
        The prediction f32[B, n], and the mean over the batch of the standard deviation between the snapshots' Q f32[].
    """
    reduced = jax.vmap(reduce)(predictions, to_q(predictions))
    return jnp.mean(reduced, axis=0), jnp.mean(jnp.std(to_q(reduced), axis=0))


def averaged_entropy(entropy_terms: jax.Array, entropy_term: jax.Array, step: Step) -> tuple[jax.Array, jax.Array]:
    """The mean over the last W minibatches of α log π, row by row, and the ring f32[W, B] after this one.

    W = 1 is plain SAC: the term f32[B] of this minibatch itself.
    """
    entropy_terms = entropy_terms.at[step % len(entropy_terms)].set(entropy_term)
    return jnp.mean(entropy_terms, axis=0), entropy_terms


def live_slot(snapshots: int, interval: jax.Array, step: Step) -> jax.Array:
    """The slot, in a ring of `snapshots`, of the target that follows the critic after `step` updates."""
    slot: jax.Array = (step // interval) % snapshots
    return slot


def polyak_update(targets: jax.Array, critic: jax.Array, rate: jax.Array, interval: jax.Array, step: Step) -> jax.Array:
    """Eq. 2 on the live target: θ̄ ← (1 − τ) θ̄ + τ θ, in the ring f32[K, C, P].

    The result becomes the live target after step + 1 updates. Every `interval` updates that is a new slot, and the
    value before stays behind as a snapshot; otherwise it takes the place of the value before.
    """
    count = len(targets)
    if count == 0:
        return targets
    if count == 1:  # the slots are 0 then, which XLA cannot know
        return ((1 - rate) * targets[0] + rate * critic)[None]
    # XLA would otherwise divide once for each number of the ring.
    slots = live_slot(count, interval, step), live_slot(count, interval, step + 1)
    before, after = jax.lax.optimization_barrier(slots)  # type: ignore[no-untyped-call]
    moved = (1 - rate) * jnp.take(targets, before, axis=0) + rate * critic
    return targets.at[after].set(moved)
