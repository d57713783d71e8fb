"""Many runs in memory that take their steps together. Each of them is a `Course`, as a run alone is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np

from saclab.algorithm.numbers import Numbers, numbers_of
from saclab.algorithm.types import LearnerState
from saclab.batch.frames import Message
from saclab.batch.member import Member, MemberReplay, init_settings
from saclab.batch.pool import EnvironmentPool, error_of
from saclab.batch.program import Program
from saclab.config import Config
from saclab.environments.make import EnvironmentSpec, environment_spec, make_environment
from saclab.environments.vector import EndedEpisode
from saclab.errors import RunBroken
from saclab.replay import ReplayBuffer, RowLayout, draw, require_memory
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.q_bias import QBias

TEST_EPISODES_PER_JOB = 5  # stepped side by side; a fixed number, as results depend on it in the last bits


class Experience(NamedTuple):
    """What the last step has brought, as long as the devices do not have it."""

    rows: np.ndarray
    """f32[runs, E, width]."""
    position: np.ndarray
    """i32[runs]: where the rows go in the replay buffers."""
    drawn: np.ndarray
    """i32[runs, U, B]: rows of the buffers, for each update that is due."""


def give_up(member: Member, error: RunBroken) -> None:
    raise error


class Batch:
    """R runs of one structure, in lock-step: the n-th step of each is taken together with that of all the others.

    A step is that of `Run.step`: act, step the environments, store, update. The devices get the new transitions
    and make the updates while the environments take the next step, if the settings have an acting_delay of 1.
    """

    def __init__(self, configs: Sequence[Config], slots: int, workers: int) -> None:
        """The state before the first step, for runs that `comparison.batches.structure` gives the same name.

        Args:
            configs: of the runs.
            slots: how many runs the compiled program has room for.
            workers: processes that step the environments.

        Raises:
            UserError: if the environment cannot be trained on, or the replay buffers do not fit in memory.
        """
        self.config = configs[0]
        training = self.config.training
        self.spec = spec_of(self.config)
        self.layout = RowLayout(self.spec.observation_size, self.spec.action_size)
        self.program = program_of(
            init_settings(self.config.algorithm), self.layout, training.parallel_environments, max(slots, len(configs))
        )
        require_memory(
            training.replay_capacity, self.layout, self.program.slots, "--batch", memory_of_devices(self.program)
        )
        self.steps = self.updates = 0
        self.members = [Member(self, slot, config) for slot, config in enumerate(configs)]
        self.pool = EnvironmentPool(configs, self.spec, workers)
        numbers = [numbers_of(config.algorithm, self.spec.action_size) for config in configs]
        self.numbers = self._put_stacked([number_arrays(each) for each in numbers])
        self.replay: jax.Array = self._empty_replay()
        self.experience: Experience | None = None
        self.undelivered: list[jax.Array] = []
        """Metrics f32[S, U, M] that are not yet in the members' windows."""
        self.undelivered_updates = 0
        """Of them, and of the experience."""
        self._host: LearnerState | None = None
        self._host_actors: np.ndarray | None = None

    @property
    def active(self) -> list[Member]:
        """The members that go on."""
        return [member for member in self.members if member.active]

    def take_transitions(self, member: Member, buffer: ReplayBuffer) -> None:
        """Bring a restored run's replay buffer to its device; `buffer` can be used again then."""
        self.replay = set_slot(self.replay, member.slot, buffer.rows).block_until_ready()
        member.replay = MemberReplay(self, member.slot)

    def begin(self) -> None:
        """Bring the members' learners to the devices, once all that have a checkpoint are restored from it."""
        states = [member.before_begin for member in self.members]
        self.state: LearnerState = self._put_stacked([state.learner for state in states])
        self.actor_before: jax.Array | None = None
        if all(state.acting is not None for state in states):
            self.actor_before = self._put_stacked([state.acting for state in states])
        for member in self.members:
            del member.before_begin
        self.steps, self.updates = self.members[0].counters.steps, self.members[0].counters.updates

    def step(self, broken: Callable[[Member, RunBroken], None] = give_up) -> dict[int, list[EndedEpisode]]:
        """Step every environment once, store the transitions, make the updates due.

        Args:
            broken: called for each run whose environment broke, which is as it was before this step; it should call
                `leave`.

        Returns:
            Slot -> the episodes that ended, of the active runs.

        Raises:
            EnvironmentWorkerDied: if a process that steps environments is gone.
        """
        for slot, error in self.pool.step(self._next_actions()).items():
            broken(self.members[slot], error)
        active = self.active
        self.steps += self.config.training.parallel_environments
        for member in active:
            member.counters.steps = self.steps
        self._take_experience(active)
        if not self.pool.board.ended.any():
            return {}
        return {member.slot: self.pool.ended(member.slot) for member in active}

    def leave(self, member: Member) -> None:
        """Go on without a run that has finished or failed. Its slot stays: what the others compute is the same."""
        member.active = False
        self.pool.leave(member.slot)

    def test(
        self, members: Sequence[Member], asked_to_stop: Callable[[], bool]
    ) -> dict[int, EvaluationEpisodes | RunBroken]:
        """Test these runs' policies as they are now: slot -> the episodes, or what broke in them.

        Raises:
            Stopped: when `asked_to_stop`; the runs are as before.
            EnvironmentWorkerDied: if a process that plays the episodes is gone.
        """
        jobs, owners = [], []
        for member in members:
            test_seeds, actor = member.test_seeds(), member.actor
            for first in range(0, len(test_seeds), TEST_EPISODES_PER_JOB):
                part = test_seeds[first : first + TEST_EPISODES_PER_JOB]
                jobs.append(({"do": "test", "run": member.slot, "seeds": part}, {"actor": actor}))
                owners.append(member.slot)
        replies = self.pool.work_off(jobs, asked_to_stop)
        return {
            member.slot: joined([reply for reply, slot in zip(replies, owners, strict=True) if slot == member.slot])
            for member in members
        }

    def q_bias(self, members: Sequence[Member]) -> dict[int, QBias | RunBroken]:
        """As `Run.q_bias`: slot -> the critics' bias, for the runs that want it, or what broke."""
        wanted = [member for member in members if member.config.training.q_bias_episodes]
        jobs = []
        for member in wanted:
            learner = member.learner()
            header = {"do": "q_bias", "run": member.slot, "evaluations": member.counters.evaluations}
            judged = {"actor": learner.actor, "critic": learner.critic, "log_alpha": learner.log_alpha}
            jobs.append((header, {name: np.asarray(array) for name, array in judged.items()}))
        replies = self.pool.work_off(jobs, lambda: False)
        return {
            member.slot: QBias(*reply["bias"]) if "bias" in reply else error_of(reply["failure"], {})
            for member, (reply, _) in zip(wanted, replies, strict=True)
        }

    def on_host(self) -> LearnerState:
        """All learners, copied to the host once after each update."""
        self.flush()
        if self._host is None:
            self._host = jax.tree.map(np.array, self.state)
        return self._host

    def actors_on_host(self) -> np.ndarray:
        """f32[S, P], copied once after each update."""
        self.flush()
        if self._host_actors is None:
            self._host_actors = np.array(self.state.actor)
        return self._host_actors

    def flush(self) -> None:
        """Give the devices what the last step has brought, before the next step would."""
        if self.experience is not None:
            self._launch(noise=None)

    def deliver_metrics(self) -> None:
        """Append the metrics of the updates since the last delivery to the active members' windows."""
        self.flush()
        if self.undelivered:
            values = np.concatenate([np.asarray(metrics) for metrics in self.undelivered], axis=1)
            for member in self.active:
                member.window += list(values[member.slot])
            self.undelivered, self.undelivered_updates = [], 0

    def close(self) -> None:
        self.pool.close()

    def _next_actions(self) -> np.ndarray:
        """f32[R·E, A] in [-1, 1]: uniform during the random steps, then samples of the policies."""
        if self.steps < self.config.training.random_steps:
            self.flush()
            actions = self._of_active(Member.random_action)
        else:
            launched = self._launch(self._of_active(Member.action_noise))
            actions = np.asarray(launched)[: len(self.members)]
        return actions.reshape(-1, self.spec.action_size)

    def _of_active(self, draw_one: Callable[[Member], np.ndarray]) -> np.ndarray:
        """f32[R, E, A], zero for runs that are not active."""
        drawn = np.zeros(
            (len(self.members), self.config.training.parallel_environments, self.spec.action_size), np.float32
        )
        for member in self.active:
            drawn[member.slot] = draw_one(member)
        return drawn

    def _launch(self, noise: np.ndarray | None) -> jax.Array | None:
        """Start what the devices have to do: choose actions f32[S, E, A], given noise, and take in the experience.

        Actions come first where the policy that acts is a round of updates behind: they wait for nothing then.
        """
        parts: dict[str, np.ndarray] = {}
        updates = 0
        if self.experience is not None:
            parts |= self.experience._asdict()
            updates = self.experience.drawn.shape[1]
        if noise is not None:
            observations = self.pool.board.observation.reshape(len(self.members), -1)
            parts |= {"observation": observations, "noise": noise}
        packed = self.program.put(self.program.arrival(updates).pack(self.program.slots, **parts))
        if updates:
            self.actor_before = self.state.actor
        delayed = self.config.training.acting_delay > 0
        actions = self._act(packed) if delayed and noise is not None else None
        if self.experience is not None:
            self._advance(updates, packed)
        return self._act(packed) if noise is not None and not delayed else actions

    def _act(self, packed: jax.Array) -> jax.Array:
        actions: jax.Array = self.program.act(self.numbers, self.acting, packed)
        return actions

    @property
    def acting(self) -> jax.Array:
        """f32[S, P]: as `Course.acting`, of all slots."""
        if self.config.training.acting_delay == 0 or self.actor_before is None:
            return self.state.actor
        return self.actor_before

    def _advance(self, updates: int, packed: jax.Array) -> None:
        self.state, self.replay, metrics = self.program.advance(updates, self.numbers, self.state, self.replay, packed)
        self.experience = self._host = self._host_actors = None
        if updates:
            self.undelivered.append(metrics)

    def _take_experience(self, active: Sequence[Member]) -> None:
        """Keep the step's transitions, and draw the minibatches of the updates that are due."""
        training, batch_size = self.config.training, self.config.algorithm.batch_size
        due = training.updates_due(self.steps) - self.updates
        self.updates += due
        self.undelivered_updates += due
        rows = self.pool.board.row.reshape(len(self.members), training.parallel_environments, -1).copy()
        before = self.steps - training.parallel_environments
        position = np.full(len(self.members), before % training.replay_capacity, np.int32)
        drawn = np.zeros((len(self.members), due, batch_size), np.int32)
        for member in active:
            member.counters.updates = self.updates
            for update in range(due):
                drawn[member.slot, update] = draw(
                    member.sampling, min(self.steps, training.replay_capacity), batch_size
                )
        self.experience = Experience(rows, position, drawn)

    def _put_stacked(self, trees: Sequence[Any]) -> Any:
        """One tree per run as one tree on the devices; the slots without a run are like the first one's."""
        filled = [*trees, *[trees[0]] * (self.program.slots - len(trees))]
        return self.program.put(jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *filled))

    def _empty_replay(self) -> jax.Array:
        shape = (self.program.slots, self.config.training.replay_capacity, self.layout.width)
        make = jax.jit(lambda: jax.numpy.zeros(shape, np.float32), out_shardings=self.program.sharding)
        empty: jax.Array = make()
        return empty


program_of = lru_cache(maxsize=4)(Program)  # batches of one grid mostly have the same one


@partial(jax.jit, donate_argnums=0)
def set_slot(replay: jax.Array, slot: int, rows: np.ndarray) -> jax.Array:
    """f32[S, capacity, width] with the rows f32[capacity, width] of one slot put in their place."""
    return replay.at[slot].set(rows)


def number_arrays(numbers: Numbers) -> Numbers:
    """Each of the same type for all runs, also where a user has written 1 for 1.0."""
    kinds = {"temperature_learned": np.bool_, "snapshot_interval": np.int32}
    return Numbers(**{name: kinds.get(name, np.float32)(number) for name, number in numbers._asdict().items()})


def joined(replies: Sequence[Message]) -> EvaluationEpisodes | RunBroken:
    """The episodes of one run's test, which came in parts, or what broke in the first of them that did."""
    for header, _ in replies:
        if "failure" in header:
            return error_of(header["failure"], {})
    parts = [arrays for _, arrays in replies]
    return EvaluationEpisodes(*(np.concatenate([part[name] for part in parts]) for name in EvaluationEpisodes._fields))


def spec_of(config: Config) -> EnvironmentSpec:
    environment = make_environment(config.environment, config.environment_arguments)
    spec = environment_spec(config.environment, environment)
    environment.close()
    return spec


def memory_of_devices(program: Program) -> int | None:
    """Bytes that JAX may use on all devices together; None where they share the machine's memory."""
    limits = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in program.mesh.devices.flat]
    return None if jax.default_backend() == "cpu" or 0 in limits else sum(limits)
