"""What the comparisons with other programs share."""

from __future__ import annotations

import jax
import numpy as np
import pytest


@pytest.fixture
def sixty_four_bits():
    """JAX computes in 64 bits."""
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def cast(tree, number: type):
    """A tree whose real numbers of 32 bits have this type."""
    return jax.tree.map(lambda x: number(x) if np.asarray(x).dtype == np.float32 else x, tree)
