"""The policy of another run, which acts in the random steps of this one in place of uniform actions."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from saclab.config import from_plain
from saclab.errors import UserError
from saclab.replay import RowLayout
from saclab.settings import AlgorithmSettings
from saclab.training.captured import require_like
from saclab.training.checkpoint import Arrays
from saclab.training.learners import learner_of
from saclab.training.manifest import CheckpointError

ACTING = ("network", "hidden_layers", "activation", "weight_projection", "observation_normalisation", "log_std_minimum",
          "log_std_maximum", "log_std_bounding")  # fmt: skip
"""The settings that decide how a policy acts. Moments of observations are among its parameters."""


class Guide:
    """A policy, as it lies in the checkpoints of a run until the random steps are over."""

    def __init__(self, settings: AlgorithmSettings, layout: RowLayout, parameters: np.ndarray) -> None:
        """`settings` are those of its own run, `parameters` f32[P]."""
        self.settings, self.parameters = settings, parameters
        self.sizes = layout.columns["observation"], layout.columns["action"]
        self.policy = learner_of(settings, layout).policy

    def act(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Actions f32[N, A] in [-1, 1], sampled for f32[N, O] with standard normal noise f32[N, A]."""
        action: np.ndarray = self.policy.act(self.parameters, observation, noise)
        return action

    @property
    def sha256(self) -> str:
        """Of what decides how it acts, and of no other setting: one that a later version adds leaves it as it is."""
        told = {name: getattr(self.settings, name) for name in ACTING} | {"sizes": self.sizes}
        digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
        digest.update(self.parameters.astype("<f4", copy=False).tobytes())
        return digest.hexdigest()

    def capture(self) -> tuple[dict[str, Any], Arrays]:
        """Its settings and its parameters."""
        return json.loads(json.dumps(dataclasses.asdict(self.settings))), {"actor": self.parameters}


def guide_from(settings: Mapping[str, Any], arrays: Arrays, layout: RowLayout) -> Guide:
    """The guide that `capture` has taken apart; raises CheckpointError for what it cannot have given."""
    try:
        known = from_plain(AlgorithmSettings, dict(settings))
    except (msgspec.ValidationError, UserError) as error:
        raise CheckpointError(f"the checkpoint's settings of the policy of the first steps: {error}") from error
    size = learner_of(known, layout).policy.network.size
    return Guide(known, layout, require_like("the first steps", arrays.get("actor"), np.zeros(size, np.float32)))
