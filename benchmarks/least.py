"""The least that an update of plain SAC can take: each kind of its operations by itself, all it touches in the cache.

    NPROC=1 OPENBLAS_NUM_THREADS=1 taskset -c 0 python benchmarks/least.py HalfCheetah-v4     on one core
    python benchmarks/least.py HalfCheetah-v4                                                  on all of them

Everything is done many times in a row on arrays of the update's shapes. What the update takes beyond the sum is the way
of its operands between cache and memory, and whatever is not among the kinds below. The same products by NumPy's BLAS
stand beside it.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from breakdown import alternating, update_breakdown
from keep import keep
from operations import MatrixProduct, matrix_products

from saclab.machine import usable_cores
from saclab.protocols import make_config
from saclab.settings import AlgorithmSettings
from saclab.training.local_engine import LocalEngine
from saclab.training.process import prepare_process

REPEATS = 30
ROUNDS = 15


def warm(work: Callable[..., jax.Array], first: jax.Array, *others: jax.Array) -> float:
    """Milliseconds of `work(first, *others)`, in a program that does it again and again."""

    def again(_: int, first: jax.Array) -> jax.Array:
        result = jax.lax.optimization_barrier(work(first, *others))  # the whole of it, not the one number that is used
        return first.at[(0,) * first.ndim].set((1e-3 * result.ravel()[0]).astype(first.dtype))  # so it is not hoisted

    in_a_row = jax.jit(lambda first: jax.lax.fori_loop(0, REPEATS, again, first))
    timed: dict[str, Callable[[], object]] = {"work": lambda: jax.block_until_ready(in_a_row(first))}
    return alternating(timed, ROUNDS, ROUNDS)["work"] / REPEATS


def by_xla(product: MatrixProduct) -> float:
    return warm(product.multiply, *(jnp.ones(shape) for shape in product.shapes))


def by_blas(product: MatrixProduct) -> float:
    """Milliseconds of a product by NumPy's BLAS."""
    ((left_axis,), (right_axis,)), _ = product.multiply.keywords["dimension_numbers"]
    left, right = (np.ones(shape, np.float32) for shape in product.shapes)
    size = left.shape[left_axis]  # the others are one axis, or the snapshots of plain SAC, of which there is one
    left, right = (
        np.moveaxis(left, left_axis, -1).reshape(-1, size),
        np.moveaxis(right, right_axis, 0).reshape(size, -1),
    )
    result = np.empty((len(left), right.shape[1]), np.float32)
    assert result.size == math.prod(jax.eval_shape(product.multiply, *map(jnp.ones, product.shapes)).shape)
    seconds = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        for _ in range(REPEATS):
            np.matmul(left, right, out=result)
        seconds.append(time.perf_counter() - began)
    return 1000 * statistics.median(seconds) / REPEATS


def activations(algorithm: AlgorithmSettings) -> float:
    """Bias and ReLU of each hidden layer's passes, the masks and the sums over the batch of the way back."""
    batch, layers = algorithm.batch_size, len(algorithm.hidden_layers)
    hidden, bias = jnp.ones((batch, algorithm.hidden_layers[0])), jnp.ones(algorithm.hidden_layers[0])
    forward = layers * (2 + 3 * algorithm.critics)  # the policy at s and s′; targets, critics, those for the policy
    back = layers * (1 + 2 * algorithm.critics)
    learned = layers * (1 + algorithm.critics)
    return (
        forward * warm(lambda hidden: jax.nn.relu(hidden + bias), hidden)
        + back * warm(lambda hidden: jnp.where(hidden > 0, hidden, 0), hidden)
        + learned * warm(lambda hidden: hidden.sum(0), hidden)
    )


def adam(weights: jax.Array) -> float:
    def step(weights: jax.Array) -> jax.Array:
        direction, moments = optax.scale_by_adam().update(
            weights, optax.ScaleByAdamState(jnp.int32(3), weights, weights)
        )
        return jnp.concatenate([weights - 3e-4 * direction, moments.mu, moments.nu])

    return warm(step, weights)


def noise(*shape: int) -> float:
    """Of the actions at s and at s′."""

    def draw(key: jax.Array) -> jax.Array:
        one, two = jax.random.split(key)
        return jax.random.normal(one, shape) + jax.random.normal(two, shape)

    return warm(draw, jax.random.key_data(jax.random.key(0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment")
    options = parser.parse_args()
    prepare_process()
    config = make_config(options.environment, "sac", "paper", overrides={"replay_capacity": 10_000})
    engine = LocalEngine.new(config)
    algorithm, layout = config.algorithm, engine.replay.layout
    policy, critics = engine.learner_state.actor.weights, engine.learner_state.critic.weights
    products = matrix_products(algorithm, layout)
    parts = {
        "matrix products": sum(map(by_xla, products)),
        "activations, masks, gradients of biases": activations(algorithm),
        "Adam, policy and critics": adam(policy) + adam(critics.ravel()),
        "Polyak averaging": warm(lambda targets: targets + 0.005 * (critics - targets), critics + 1),
        "random numbers": noise(algorithm.batch_size, layout.action_size),
    }
    engine.close()
    blas = sum(map(by_blas, products))
    update = update_breakdown(options.environment, "sac", 400)
    parts["calling XLA"] = update["calling XLA"]
    parts["the way to memory, and all else"] = update["whole"] - sum(parts.values())
    for part, milliseconds in parts.items():
        print(f"  {part:<42}{milliseconds:8.2f} ms {milliseconds / update['whole']:6.0%}")
    print(f"  {'an update':<42}{update['whole']:8.2f} ms")
    print(f"  {'matrix products by NumPy BLAS':<42}{blas:8.2f} ms")
    name = f"least-{options.environment}-{len(usable_cores())}-core"
    keep(name, milliseconds=parts, update_milliseconds=update["whole"], blas_milliseconds=blas)


if __name__ == "__main__":
    main()
