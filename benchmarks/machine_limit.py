"""What this machine could do at most: float32 matrix products as XLA does them, and MuJoCo's steps without anything.

    NPROC=1 python benchmarks/machine_limit.py HalfCheetah-v4 [REPEATS]

prints one line of JSON: operations per second, seconds of one raw environment step, operations of one update.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import mujoco
from operations import update_operations

from saclab.environments.make import environment_spec, make_environment
from saclab.replay import RowLayout
from saclab.variants import variant_settings

SIZE = 1024


def seconds_of(work: Callable[[], object], calls: int, repeats: int) -> float:
    """Median over the repeats of the seconds of one call."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        for _ in range(calls):
            work()
        times.append((time.perf_counter() - began) / calls)
    return statistics.median(times)


def matrix_rate(repeats: int) -> float:
    """float32 operations per second of a product that is large enough to reach the machine's limit."""
    product, matrix = jax.jit(lambda a: a @ a), jnp.ones((SIZE, SIZE))
    product(matrix).block_until_ready()
    return 2 * SIZE**3 / seconds_of(lambda: product(matrix).block_until_ready(), 5, repeats)


def raw_step_seconds(name: str, repeats: int) -> float:
    """`mj_step` alone, as many times as one step of the environment calls it, along episodes of random actions.

    An episode that ends begins anew: a body that lies on the ground has many contacts, and training hardly sees it.
    """
    environment, step, seconds = make_environment(name), mujoco.mj_step, 0.0
    environment.reset(seed=0)
    environment.action_space.seed(0)

    def timed(*arguments: Any, **options: Any) -> None:
        nonlocal seconds
        began = time.perf_counter()
        step(*arguments, **options)
        seconds += time.perf_counter() - began

    times = []
    with mock.patch.object(mujoco, "mj_step", timed):
        for _ in range(repeats):
            seconds = 0.0
            for _ in range(100):
                _, _, terminated, truncated, _ = environment.step(environment.action_space.sample())
                if terminated or truncated:
                    environment.reset()
            times.append(seconds / 100)
    environment.close()
    return statistics.median(times)


def main() -> None:
    name, repeats = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 15
    spec = environment_spec(name, make_environment(name))
    layout = RowLayout(spec.observation_size, spec.action_size)
    facts = {
        "operations_per_second": matrix_rate(repeats),
        "raw_step_seconds": raw_step_seconds(name, repeats),
        "update_operations": {
            variant: update_operations(variant_settings(variant, name), layout) for variant in ("sac", "averaged")
        },
    }
    print(json.dumps(facts))


if __name__ == "__main__":
    main()
