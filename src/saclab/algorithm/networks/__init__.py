"""The networks: each a few pure functions on one packed vector. `NETWORKS` has them by name."""

from __future__ import annotations

from collections.abc import Callable

from saclab.algorithm.networks.batch_norm_mlp import batch_norm_mlp, batch_renorm_mlp
from saclab.algorithm.networks.batch_norm_residual import batch_norm_residual
from saclab.algorithm.networks.hyperspherical import hyperspherical
from saclab.algorithm.networks.layer_norm_mlp import layer_norm_mlp
from saclab.algorithm.networks.mlp import mlp
from saclab.algorithm.networks.network import Design, Network
from saclab.algorithm.networks.normalised_inputs import INPUT_NORMALISATIONS
from saclab.settings import AlgorithmSettings

NETWORKS: dict[str, Callable[[int, tuple[int, ...], int, Design], Network]] = {
    "mlp": mlp,
    "layer_norm_mlp": layer_norm_mlp,
    "batch_norm_mlp": batch_norm_mlp,
    "batch_renorm_mlp": batch_renorm_mlp,
    "batch_norm_residual": batch_norm_residual,
    "hyperspherical": hyperspherical,
}
"""Name -> (inputs, hidden layers, outputs, design) -> Network."""


def policy_network(settings: AlgorithmSettings, inputs: int, outputs: int) -> Network:
    design = Design(settings.activation, settings.weight_projection, settings.initialisation, heads=2)
    network = NETWORKS[settings.network](inputs, settings.hidden_layers, outputs, design)
    return INPUT_NORMALISATIONS[settings.observation_normalisation](network, inputs)


def critic_network(settings: AlgorithmSettings, inputs: int, outputs: int) -> Network:
    """One Q-network."""
    design = Design(settings.activation, settings.weight_projection, settings.initialisation, settings.critic_dropout)
    network = NETWORKS[settings.network_of_critic](inputs, settings.layers_of_critic, outputs, design)
    return INPUT_NORMALISATIONS[settings.observation_normalisation](network, inputs)
