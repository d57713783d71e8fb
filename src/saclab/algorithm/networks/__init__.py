"""The networks: each a few pure functions on one packed vector. `NETWORKS` has them by name."""

from __future__ import annotations

from collections.abc import Callable

from saclab.algorithm.networks.batch_norm_mlp import batch_norm_mlp
from saclab.algorithm.networks.mlp import mlp
from saclab.algorithm.networks.network import Network

NETWORKS: dict[str, Callable[[int, tuple[int, ...], int, str, str], Network]] = {
    "mlp": mlp,
    "batch_norm_mlp": batch_norm_mlp,
}
"""Name -> (inputs, hidden layers, outputs, activation, weight projection) -> Network."""
