"""Every random draw of a run comes from its seed through one of these named streams."""

from __future__ import annotations

import numpy as np

STREAMS = ("learner", "environments", "exploration", "replay", "evaluation", "q_bias")


def stream(seed: int, name: str, index: int = 0) -> np.random.SeedSequence:
    """The seed sequence of a named stream; `index` numbers the environments or the evaluations within it."""
    return np.random.SeedSequence(seed, spawn_key=(STREAMS.index(name), index))


def integers(seed: int, name: str, count: int, index: int = 0) -> list[int]:
    """`count` environment seeds."""
    return [int(value) for value in stream(seed, name, index).generate_state(count)]


def generator(seed: int, name: str, index: int = 0) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(stream(seed, name, index)))


def learner_key(seed: int) -> np.ndarray:
    """u32[2]: a raw key for `jax.random`."""
    return stream(seed, "learner").generate_state(2, np.uint32)
