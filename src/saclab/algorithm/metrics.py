"""What an update may report. This file imports nothing, so that a report can say it without JAX."""

from __future__ import annotations

METRICS = {
    "critic_loss": "The loss of the critics' head (Eq. 3), summed over the critics.",
    "actor_loss": "Eq. 5: the paper's policy loss.",
    "temperature_loss": "Eq. 8; 0 if the temperature is fixed.",
    "temperature": "α as this update found it.",
    "entropy": "Mean of −log π over the batch, in nats, for actions in [-1, 1].",
    "q_mean": "Mean of the critics on the batch's actions.",
    "q_spread": "Mean over the batch of the standard deviation between critics.",
    "target_mean": "Mean of the critics' regression target.",
    "snapshot_spread": "Mean over the batch of the standard deviation between the K snapshots' values; 0 for K = 1.",
    "reward_scale": "What rewards were divided by.",
}
"""Name -> meaning."""
