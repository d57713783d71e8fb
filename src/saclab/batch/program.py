"""What a run group computes on its devices: S slots side by side, each with a learner and a replay buffer of its own.

Two compiled functions. `act` chooses the next actions of all runs; `advance` stores their new transitions, draws the
minibatches and makes the updates. They are two because what one call gives is ready only when all of it is: the
actions would otherwise wait for the updates, and the physics for the actions.

What the host puts into a step comes as one array, and the actions leave as one array. Slots are spread over all
devices; as runs have nothing to do with each other, no device ever waits for another.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from saclab.algorithm.learner import make_learner
from saclab.algorithm.scalars import unpack
from saclab.algorithm.types import Context, LearnerState, Trained
from saclab.replay import RowLayout
from saclab.settings import AlgorithmSettings
from saclab.training.process import compiled

RUNS: Any = PartitionSpec("runs")  # type: ignore[no-untyped-call]
SHARED: Any = PartitionSpec()  # type: ignore[no-untyped-call]
UNROLLED_UPDATES = 4  # of one call; more are a loop, which compiles sooner


class StepInputs(NamedTuple):
    """How the inputs of a step lie in one array i32[S, width]; floating-point numbers are there as their bits."""

    layout: RowLayout
    environments: int
    """E: environments of each run."""
    updates: int
    """U: updates made after this step."""
    batch_size: int

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each part, for one slot."""
        return {
            "observation": (self.environments, self.layout.observation_size),
            "noise": (self.environments, self.layout.action_size),
            "rows": (self.environments, self.layout.width),
            "position": (),
            "drawn": (self.updates, self.batch_size),
        }

    def places(self) -> dict[str, slice]:
        sizes = [int(np.prod(shape)) for shape in self.shapes.values()]
        ends = pairwise([0, *accumulate(sizes)])
        return {name: slice(*end) for name, end in zip(self.shapes, ends, strict=True)}

    def pack(self, slots: int, **parts: np.ndarray) -> np.ndarray:
        """A new array, zero where nothing is given; each part has a leading axis of at most S."""
        places = self.places()
        packed = np.zeros((slots, places["drawn"].stop), np.int32)
        for name, part in parts.items():
            target = packed.view(part.dtype)[: len(part), places[name]]
            target[:] = part.reshape(len(part), -1)
        return packed

    def unpack(self, packed: jax.Array, name: str) -> jax.Array:
        """One part, of one slot's i32[width]."""
        part = packed[self.places()[name]].reshape(self.shapes[name])
        return part if name in ("position", "drawn") else jax.lax.bitcast_convert_type(part, jnp.float32)


class Program:
    """The two functions for one structure of runs."""

    def __init__(self, settings: AlgorithmSettings, layout: RowLayout, environments: int, slots: int) -> None:
        """Make room for at least `slots` slots: as many as can be spread evenly over the devices.

        Args:
            settings: the `structure` of the runs' settings.
            layout: of the transitions.
            environments: of each run.
            slots: how many runs there may be.
        """
        self.settings, self.layout, self.environments = settings, layout, environments
        devices = jax.devices()
        self.slots = -(-slots // len(devices)) * len(devices)
        self.mesh = Mesh(np.array(devices), ("runs",))
        self.learner = make_learner(settings, layout.observation_size, layout.action_size)
        self.act = self._mapped(self._act, (RUNS, RUNS), donated=())
        self._advance: dict[int, Callable[..., Any]] = {}

    @cached_property
    def sharding(self) -> NamedSharding:
        return NamedSharding(self.mesh, RUNS)

    def put(self, tree: Any) -> Any:
        """Host arrays [S, …] on the devices."""
        return jax.device_put(tree, self.sharding)

    def inputs(self, updates: int) -> StepInputs:
        return StepInputs(self.layout, self.environments, updates, self.settings.batch_size)

    def advance(
        self,
        updates: int,
        numbers: jax.Array,
        state: LearnerState,
        replay: jax.Array,
        packed: jax.Array,
        context: Context,
    ) -> tuple[LearnerState, jax.Array, jax.Array]:
        """Store transitions and make `updates` updates: the learners, replay, and metrics f32[S, U, M].

        `context` is that of the first update: step i32[], which all share, weights f32[S, T] and scale f32[S].
        `replay` f32[S, capacity, width] is used up, and so is the state, but for the actor: it may act for longer.
        """
        if updates not in self._advance:

            def advance(
                numbers: jax.Array, actor: jax.Array, others: dict[str, Any], replay: jax.Array, packed: jax.Array,
                context: Context,
            ) -> Any:  # fmt: skip
                state = LearnerState(**others | {"actor": Trained(actor, others["actor"])})
                return self._advance_slot(updates, numbers, state, replay, packed, context)

            moments = None if context.observation_moments is None else RUNS
            of_context = Context(SHARED, reward_weights=RUNS, reward_scale=RUNS, observation_moments=moments)
            specs = (RUNS, RUNS, RUNS, RUNS, RUNS, of_context)
            self._advance[updates] = self._mapped(advance, specs, donated=(2, 3))
        actor, others = state.actor.weights, state._asdict() | {"actor": state.actor.moments}
        result: tuple[LearnerState, jax.Array, jax.Array] = self._advance[updates](
            numbers, actor, others, replay, packed, context
        )
        return result

    def _act(self, actor: jax.Array, packed: jax.Array) -> jax.Array:
        """Actions f32[E, A] of one slot."""
        inputs = self.inputs(0)
        observation, noise = inputs.unpack(packed, "observation"), inputs.unpack(packed, "noise")
        action: jax.Array = self.learner.policy.act(actor, observation, noise)
        return action

    def _advance_slot(
        self,
        updates: int,
        numbers: jax.Array,
        state: LearnerState,
        replay: jax.Array,
        packed: jax.Array,
        context: Context,
    ) -> tuple[LearnerState, jax.Array, jax.Array]:
        inputs = self.inputs(updates)
        positions = (inputs.unpack(packed, "position") + jnp.arange(self.environments)) % len(replay)
        replay = replay.at[positions].set(inputs.unpack(packed, "rows"))

        def update(state: LearnerState, of_update: tuple[jax.Array, jax.Array]) -> tuple[LearnerState, jax.Array]:
            drawn, step = of_update
            batch = self.layout.unpack(replay[drawn])
            state = self.learner.update(unpack(numbers), state, batch, context._replace(step=step))
            return state, state.report

        drawn, steps = inputs.unpack(packed, "drawn"), context.step + jnp.arange(updates, dtype=jnp.int32)
        unrolled = updates if 0 < updates <= UNROLLED_UPDATES else 1
        state, metrics = jax.lax.scan(update, state, (drawn, steps), unroll=unrolled)
        return state, replay, metrics

    def _mapped(self, function: Callable[..., Any], specs: Any, donated: tuple[int, ...]) -> Callable[..., Any]:
        """Map over the slots, each device over its own; what is SHARED is the same for all."""
        axes = jax.tree.map(lambda spec: None if spec is SHARED else 0, specs)
        over_slots = jax.vmap(function, in_axes=axes)
        over_devices = jax.shard_map(over_slots, mesh=self.mesh, in_specs=specs, out_specs=RUNS, check_vma=False)
        return compiled(over_devices, donated)
