"""A run of a batch, as the rest of saclab sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from saclab.algorithm.scalars import scalars
from saclab.algorithm.types import LearnerState
from saclab.config import Config, structure
from saclab.training import seeds
from saclab.training.course import Course
from saclab.training.run import compiled_init

if TYPE_CHECKING:
    from saclab.batch.batch import Batch


class BeforeBegin(NamedTuple):
    """Of a run whose batch has not begun: the learner, and the acting policy f32[P] if a checkpoint tells it."""

    learner: LearnerState
    acting: np.ndarray | None


class Member(Course):
    """A run of a batch."""

    def __init__(self, batch: Batch, slot: int, config: Config) -> None:
        super().__init__(config)
        self.batch, self.slot, self.spec = batch, slot, batch.spec
        self.active = True
        self.replay: Any = MemberReplay(batch, slot)
        numbers = scalars(config.algorithm, batch.spec.action_size, config.planned_updates)
        init = compiled_init(structure(config.algorithm), batch.layout)
        self.before_begin = BeforeBegin(init(numbers, seeds.learner_key(config.seed)), None)

    @property
    def actor(self) -> np.ndarray:
        if self._begun:
            return np.array(self.batch.actors_on_host()[self.slot])
        return np.asarray(self.before_begin.learner.actor.weights)

    @property
    def acting(self) -> np.ndarray:
        self.batch.flush()
        everyone = np.array(self.batch.acting)
        return np.asarray(everyone[self.slot])

    @property
    def observation(self) -> np.ndarray:
        return self.batch.pool.observation(self.slot)

    @property
    def window_size(self) -> int:
        return len(self.window) + self.batch.undelivered_updates

    def window_array(self) -> np.ndarray:
        self.batch.deliver_metrics()
        return super().window_array()

    def learner(self) -> LearnerState:
        if not self._begun:
            return self.before_begin.learner
        mine: LearnerState = jax.tree.map(lambda leaf: leaf[self.slot], self.batch.on_host())
        return mine

    def take_learner(self, state: LearnerState, acting: np.ndarray | None) -> None:
        self.before_begin = BeforeBegin(state, acting)

    def capture_environments(self) -> list[dict[str, Any] | None]:
        return self.batch.pool.capture(self.slot)

    def restore_environments(self, states: list[dict[str, Any] | None], new_seeds: list[int]) -> list[int]:
        return self.batch.pool.restore(self.slot, states, new_seeds)

    @property
    def _begun(self) -> bool:
        return hasattr(self.batch, "state")


class MemberReplay:
    """A run's replay buffer on a device, as far as a checkpoint has to read it."""

    def __init__(self, batch: Batch, slot: int) -> None:
        self.batch, self.slot = batch, slot
        self.layout, self.capacity = batch.layout, batch.config.training.replay_capacity

    @property
    def added(self) -> int:
        return self.batch.steps

    @property
    def size(self) -> int:
        return min(self.added, self.capacity)

    @property
    def rows(self) -> MemberReplay:
        return self

    def __getitem__(self, key: Any) -> np.ndarray:
        """As of an array f32[capacity, width]."""
        self.batch.flush()
        return np.asarray(self.batch.replay[self.slot, key])
