"""Mean and variance of all numbers seen so far, number by number."""

from __future__ import annotations

from typing import Any

import numpy as np


def merged(count: Any, mean: Any, variance: Any, numbers: np.ndarray) -> tuple[Any, Any, Any]:
    """Count, mean and variance of what was seen before and of `numbers` f64[N, ...] together (Chan et al. 1979)."""
    seen, shift = len(numbers), numbers.mean(axis=0) - mean
    total = count + seen
    squares = count * variance + seen * numbers.var(axis=0) + shift**2 * count * seen / total
    return total, mean + shift * seen / total, squares / total
