"""The engine of a run group: learners and replay buffers on devices, environments in processes, all in lock-step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from saclab.algorithm.types import Context, LearnerState
from saclab.batch.evaluations import evaluation_jobs, joined
from saclab.batch.pool import EnvironmentPool, error_of
from saclab.batch.program import Program
from saclab.batch.replay import DeviceReplay
from saclab.environments.make import EnvironmentSpec
from saclab.errors import RunBroken
from saclab.replay import draw
from saclab.training.engine import NOTHING_HAPPENED, Broken, StepResult, never
from saclab.training.evaluation import EvaluationEpisodes
from saclab.training.learners import numbers_of
from saclab.training.q_bias import QBias
from saclab.training.run_state import RunState
from saclab.training.snapshot import EnvironmentStates, Snapshot, Start

LONGEST_CALL, SHORTEST_PART = 512, 8
"""Updates of all slots together in one call, which a stop has to wait for; no call has fewer of each slot than this."""


class Experience(NamedTuple):
    """What the last step has brought, as long as the devices do not have it."""

    rows: np.ndarray
    """f32[runs, E, width]."""
    position: np.ndarray
    """i32[runs]: where the rows go in the replay buffers."""
    drawn: np.ndarray
    """i32[runs, U, B]: rows of the buffers, for each update that is due."""


class DeviceEngine:
    """An `Engine` of R runs: the n-th step of each is taken together with that of all the others.

    A step is that of `LocalEngine.step`: act, step the environments, store, update. The devices get the new
    transitions and make the updates while the environments take the next step, if the settings have an acting_delay
    of 1. A run has the slot of its place.
    """

    def __init__(
        self, starts: Sequence[Start], spec: EnvironmentSpec, program: Program, replay: DeviceReplay, workers: int
    ) -> None:
        """Go on from `starts`, whose transitions are in `replay`.

        Raises:
            EnvironmentStateError: if the environments' states cannot be restored.
            UserError: if a process cannot make the environment.
        """
        self.runs = [start.run for start in starts]
        self.spec, self.program, self.replay, self.slots = spec, program, replay, program.slots
        configs = [run.config for run in self.runs]
        self.training, self.batch_size = configs[0].training, configs[0].algorithm.batch_size
        self.steps, self.updates = self.runs[0].counters.steps, self.runs[0].counters.updates
        self.prefilled = self.runs[0].prefilled
        self.active = list(range(len(starts)))
        self.numbers = self._put_stacked([numbers_of(config, replay.layout) for config in configs])
        self.reward_weights = self._put_stacked([run.reward_weights() for run in self.runs])
        self.reward_scale = self._put_stacked([run.reward_scale.value for run in self.runs])
        self.observation_moments = self._put_stacked([run.observation_moments.value for run in self.runs])
        self.state: LearnerState = self._put_stacked([start.learner for start in starts])
        self.actor_before: jax.Array | None = None
        if all(start.behaviour is not None for start in starts):
            self.actor_before = self._put_stacked([start.behaviour for start in starts])
        self.experience: Experience | None = None
        self.undelivered: list[jax.Array] = []
        """Metrics f32[S, U, M] that are not yet in the runs' windows."""
        self._host: LearnerState | None = None
        self._host_actors: np.ndarray | None = None
        self.pool = restored_pool(starts, spec, workers)

    def step(self, should_pause: Callable[[], bool] = never) -> StepResult:
        """Take a step of every run.

        Raises:
            EnvironmentWorkerDied: if a process that steps environments is gone.
        """
        failures = self.pool.step(self._next_actions())
        broken = {run: Broken(error, self.snapshot(run)) for run, error in failures.items()}  # as before this step
        active = [run for run in self.active if run not in broken]
        self.steps += self.training.parallel_environments
        self._take_experience([state if run in active else None for run, state in enumerate(self.runs)])
        ended: Mapping[int, Any] = {}
        if self.pool.buffers.ended.any():
            ended = {run: self.pool.ended(run) for run in active}
        if not broken:
            self.make_updates(should_pause)
        return StepResult(ended, broken) if ended or broken else NOTHING_HAPPENED

    def make_updates(self, should_pause: Callable[[], bool] = never) -> None:
        """Have the devices make the updates that are left, in parts; the last one with the next step."""
        active = [state if run in self.active else None for run, state in enumerate(self.runs)]
        moved = self.experience is not None  # each call goes on by a part at least, however often it is to pause
        while self.updates < self.training.updates_due(self.steps):
            self.flush()
            jax.block_until_ready(self.undelivered[-1:])  # type: ignore[no-untyped-call]
            if moved and should_pause():
                return
            moved = True
            rows, position = self.replay.newest(self.added, self.training.parallel_environments)
            self.experience = Experience(rows[: len(active)], position[: len(active)], self._draw(active))

    def drop(self, run: int) -> None:
        """Go on without a run. Its slot stays: what the others compute is the same."""
        self.active.remove(run)
        self.pool.drop(run)

    def evaluate(
        self, runs: Sequence[int], should_stop: Callable[[], bool]
    ) -> Mapping[int, EvaluationEpisodes | RunBroken]:
        """Evaluate the policies of these runs, shared out among the processes.

        Raises:
            Stopped: when `should_stop`; the runs are as before.
            EnvironmentWorkerDied: if a process that plays the episodes is gone.
        """
        jobs = [job for run in runs for job in evaluation_jobs(run, self.runs[run].evaluation_seeds(), self.actor(run))]
        replies = self.pool.work_off(jobs, should_stop)
        owners = [header["run"] for header, _ in jobs]
        return {
            run: joined([reply for reply, owner in zip(replies, owners, strict=True) if owner == run]) for run in runs
        }

    def measure_q_bias(
        self, runs: Sequence[int], should_stop: Callable[[], bool] = never
    ) -> Mapping[int, QBias | RunBroken]:
        wanted = [run for run in runs if self.runs[run].config.training.q_bias_episodes]
        jobs = []
        for run in wanted:
            learner = self._learner(run)
            state = self.runs[run]
            header = {"do": "q_bias", "run": run, "evaluation": state.counters.evaluations + 1,
                      "reward_scale": float(state.reward_scale.value),
                      "reward_weights": state.reward_weights().tolist()}  # fmt: skip
            judged = {"actor": learner.actor, "critic": learner.critic, "log_alpha": learner.temperature}
            jobs.append((header, {name: np.asarray(trained.weights) for name, trained in judged.items()}))
        replies = self.pool.work_off(jobs, should_stop)
        return {
            run: QBias(*reply["bias"]) if "bias" in reply else error_of(reply["failure"], {})
            for run, (reply, _) in zip(wanted, replies, strict=True)
        }

    def actor(self, run: int) -> np.ndarray:
        """One policy's parameters f32[P] on the host; those of all runs are copied once after each update."""
        self.flush()
        if self._host_actors is None:
            self._host_actors = np.array(self.state.actor.weights)
        return np.array(self._host_actors[run])

    def snapshot(self, run: int) -> Snapshot:
        self.deliver_metrics()
        state = self.runs[run]
        late = self.training.acting_delay > 0
        behaviour = np.asarray(self.behaviour[run]) if late else self.actor(run)
        replay = self.replay.slot(run, state.added)
        return Snapshot(state, self._learner(run), behaviour, self.pool.observation(run), replay)

    def capture_environments(self, run: int) -> EnvironmentStates:
        return self.pool.capture(run)

    def deliver_metrics(self) -> None:
        self.flush()
        if self.undelivered:
            values = np.concatenate([np.asarray(metrics) for metrics in self.undelivered], axis=1)
            for run in self.active:
                self.runs[run].window += list(values[run])
            self.undelivered = []

    def flush(self) -> None:
        """Give the devices what the last step has brought, before the next step would."""
        if self.experience is not None:
            self._launch(noise=None)

    def close(self) -> Sequence[tuple[int, RunBroken]]:
        self.pool.close()
        return []

    def _learner(self, run: int) -> LearnerState:
        """One run's learner; all are copied to the host once after each update."""
        self.flush()
        if self._host is None:
            self._host = jax.tree.map(np.array, self.state)
        own: LearnerState = jax.tree.map(lambda leaf: leaf[run], self._host)
        return own

    def _next_actions(self) -> np.ndarray:
        """f32[R·E, A] in [-1, 1]: uniform or a guide's during the random steps, then samples of the policies."""
        if self.steps < self.training.random_steps:
            self.flush()
            seen = self.pool.observation
            actions = self._of_active(lambda run: self.runs[run].exploring_action(seen(run)))
        else:
            launched = self._launch(self._of_active(lambda run: self.runs[run].exploration.noise()))
            actions = np.asarray(launched)[: len(self.runs)]
        return actions.reshape(-1, self.spec.action_size)

    def _of_active(self, draw_one: Callable[[int], np.ndarray]) -> np.ndarray:
        """f32[R, E, A], zero for runs that are not active."""
        shape = (len(self.runs), self.training.parallel_environments, self.spec.action_size)
        drawn = np.zeros(shape, np.float32)
        for run in self.active:
            drawn[run] = draw_one(run)
        return drawn

    def _launch(self, noise: np.ndarray | None) -> jax.Array | None:
        """Start what the devices have to do: choose actions f32[S, E, A], given noise, and take in the experience.

        Actions come first where the behaviour parameters are a round of updates behind: they wait for nothing then.
        """
        parts: dict[str, np.ndarray] = {}
        updates = 0
        if self.experience is not None:
            parts |= self.experience._asdict()
            updates = self.experience.drawn.shape[1]
        if noise is not None:
            observations = self.pool.buffers.observation.reshape(len(self.runs), -1)
            parts |= {"observation": observations, "noise": noise}
        packed = self.program.put(self.program.inputs(updates).pack(self.slots, **parts))
        if updates and self.updates - updates == self._round_start:
            self.actor_before = self.state.actor.weights
        delayed = self.training.acting_delay > 0
        actions = self._act(packed) if delayed and noise is not None else None
        if self.experience is not None:
            self._advance(updates, packed)
        return self._act(packed) if noise is not None and not delayed else actions

    def _act(self, packed: jax.Array) -> jax.Array:
        actions: jax.Array = self.program.act(self.behaviour, packed)
        return actions

    @property
    def behaviour(self) -> jax.Array:
        """The behaviour parameters f32[S, P] of all slots, as `Snapshot.behaviour` after `flush`."""
        if self.training.acting_delay == 0 or self.actor_before is None:
            return self.state.actor.weights
        return self.actor_before

    def _advance(self, updates: int, packed: jax.Array) -> None:
        context = Context(
            np.int32(self.updates - updates), self.reward_weights, self.reward_scale, self.observation_moments
        )
        self.state, self.replay.rows, metrics = self.program.advance(
            updates, self.numbers, self.state, self.replay.rows, packed, context
        )
        self.experience = self._host = self._host_actors = None
        if updates:
            self.undelivered.append(metrics)

    def _take_experience(self, runs: Sequence[RunState | None]) -> None:
        """Keep the step's transitions, and draw the minibatches of the first updates due; None draws nothing."""
        training = self.training
        rows = self.pool.buffers.row.reshape(len(runs), training.parallel_environments, -1).copy()
        before = self.added - training.parallel_environments
        position = np.full(len(runs), before % training.replay_capacity, np.int32)
        self._weigh_rewards()
        self._scale_rewards(rows, runs)
        self._enter_observations(rows, runs)
        self.experience = Experience(rows, position, self._draw(runs))

    def _draw(self, runs: Sequence[RunState | None]) -> np.ndarray:
        """i32[R, U, B]: rows for the next part of this round of updates; None draws nothing."""
        first, last = self._round_start, self.training.updates_due(self.steps)
        end = first + end_of_part(self.updates - first, last - first, max(SHORTEST_PART, LONGEST_CALL // self.slots))
        drawn = np.zeros((len(runs), end - self.updates, self.batch_size), np.int32)
        self.updates = end
        stored = min(self.added, self.training.replay_capacity)
        for place, run in enumerate(runs):
            if run is not None:
                run.counters.steps, run.counters.updates = self.steps, self.updates
                for rows in drawn[place]:
                    rows[:] = draw(run.sampling, stored, self.batch_size)
        return drawn

    @property
    def added(self) -> int:
        """Transitions that have been put into each replay buffer."""
        return self.prefilled + self.steps

    @property
    def _round_start(self) -> int:
        """Updates that were made before the last step."""
        return self.training.updates_due(self.steps - self.training.parallel_environments)

    def _weigh_rewards(self) -> None:
        """Bring the weights of a round that begins to the devices, where a schedule changes them."""
        due = self.training.updates_due(self.steps) > self.updates
        if due and any(run.config.algorithm.reward_schedule for run in self.runs):
            self.reward_weights = self._put_stacked([run.reward_weights() for run in self.runs])

    def _scale_rewards(self, rows: np.ndarray, runs: Sequence[RunState | None]) -> None:
        """Let the running scales take in the rewards of rows f32[runs, E, width], where rewards are scaled."""
        if not self.runs[0].reward_scale.active:
            return
        ended = self.pool.buffers.ended.reshape(len(runs), -1)
        for place, run in enumerate(runs):
            if run is not None:
                terms = self.replay.layout.unpack(rows[place]).reward_terms
                run.reward_scale.enter(np.asarray(terms) @ run.reward_weights(), ended[place])
        self.reward_scale = self._put_stacked([run.reward_scale.value for run in self.runs])

    def _enter_observations(self, rows: np.ndarray, runs: Sequence[RunState | None]) -> None:
        """Let the running moments take in the observations of rows f32[runs, E, width], where any are normalised."""
        if not self.runs[0].observation_moments.active:
            return
        for place, run in enumerate(runs):
            if run is not None:
                run.observation_moments.enter(np.asarray(self.replay.layout.unpack(rows[place]).observation))
        self.observation_moments = self._put_stacked([run.observation_moments.value for run in self.runs])

    def _put_stacked(self, trees: Sequence[Any]) -> Any:
        """One tree per run as one tree on the devices; the slots without a run are like the first one's."""
        filled = [*trees, *[trees[0]] * (self.slots - len(trees))]
        return self.program.put(jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *filled))


def end_of_part(made: int, due: int, longest: int) -> int:
    """Updates of a round that are made when the next part of it is; the parts are of equal size, to one.

    Their ends decide the last bits, so they must not depend on where a round was interrupted.
    """
    parts = -(-due // longest)
    following = -(-(made + 1) * parts // due) if due else 0
    return following * due // parts if due else 0


def restored_pool(starts: Sequence[Start], spec: EnvironmentSpec, workers: int) -> EnvironmentPool:
    """The environments of all runs, in their first episodes or in those of the checkpoints."""
    pool = EnvironmentPool([start.run.config for start in starts], spec, workers)
    try:
        for run, start in enumerate(starts):
            if start.environments is not None:
                pool.restore(run, start.environments, start.run.restart_seeds())
    except BaseException:
        pool.close()
        raise
    return pool
