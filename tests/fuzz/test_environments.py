"""Environments drawn at random: what they give is stored as it was given, or ends the run with a line of words."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from saclab.errors import NonFiniteError, RunBroken, UserError
from saclab.protocols import make_config
from saclab.signals import requests_from_signals
from saclab.training import loop
from saclab.training.local_engine import LocalEngine

STEPS, LIMIT = 16, 5
SMALL = {"hidden_layers": (4,), "batch_size": 4, "random_steps": 8, "max_steps": STEPS, "replay_capacity": 32,
         "evaluation_interval_steps": 8, "evaluation_episodes": 1, "update_interval": 4}  # fmt: skip
SIZE = 3
fuzzed = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


class Gift(NamedTuple):
    """Something that an environment gives in place of what is due."""

    make: Callable[[Any], Any]
    """What is due -> what is given."""
    fair: bool
    """Whether it says the same, as anybody would read it."""


def masked(due: np.ndarray) -> Any:
    return np.ma.array(due, mask=[True] + [False] * (len(due) - 1))


def same(due: np.ndarray, value: float) -> np.ndarray:
    """All as it is due, but for the last."""
    return np.append(due[:-1], value)


OBSERVATIONS = {
    "32 bits": Gift(lambda due: due.astype(np.float32), True),
    "16 bits": Gift(lambda due: due.astype(np.float16), True),
    "extended": Gift(lambda due: due.astype(np.longdouble), True),
    "whole": Gift(lambda due: due.astype(np.int8), True),
    "other end first": Gift(lambda due: due.astype(">f8"), True),
    "list": Gift(lambda due: due.tolist(), True),
    "tuple": Gift(lambda due: tuple(due), True),
    "subclass": Gift(lambda due: due.view(np.matrix).A1, True),
    "strided": Gift(lambda due: np.repeat(due, 2)[::2], True),
    "all there, though maskable": Gift(np.ma.array, True),
    "masked": Gift(masked, False),
    "one short": Gift(lambda due: due[:-1], False),
    "one number": Gift(lambda due: due[:1], False),
    "plain number": Gift(lambda due: float(due[0]), False),
    "nothing": Gift(lambda due: due[:0], False),
    "row": Gift(lambda due: due[None], False),
    "column": Gift(lambda due: due[:, None], False),
    "objects": Gift(lambda due: due.astype(object), False),
    "words": Gift(lambda due: due.astype(str), False),
    "complex": Gift(lambda due: due.astype(complex), False),
    "times": Gift(lambda due: due.astype("M8[s]"), False),
    "ragged": Gift(lambda due: [1.0, [2.0], 3.0], False),
    "None": Gift(lambda due: None, False),
    "dict": Gift(lambda due: {"observation": due}, False),
    "NaN": Gift(lambda due: same(due, np.nan), False),
    "infinite": Gift(lambda due: same(due, -np.inf), False),
    "beyond 32 bits": Gift(lambda due: same(due, 1e39), False),
}
REWARDS = {
    "64 bits": Gift(np.float64, True),
    "32 bits": Gift(np.float32, True),
    "whole": Gift(int, True),
    "whole of NumPy": Gift(np.int64, True),
    "array of no dimension": Gift(np.array, True),
    "fraction": Gift(Fraction, True),
    "one in a row": Gift(lambda due: np.array([due]), False),
    "list": Gift(lambda due: [due], False),
    "words": Gift(str, False),
    "words in an array": Gift(lambda due: np.array(str(due)), False),
    "bytes": Gift(lambda due: b"1", False),
    "complex": Gift(complex, False),
    "complex of NumPy": Gift(np.complex128, False),
    "None": Gift(lambda due: None, False),
    "NaN": Gift(lambda due: float("nan"), False),
    "infinite": Gift(lambda due: np.float32("inf"), False),
    "too long": Gift(lambda due: 10**400, False),
    "two": Gift(lambda due: (due, due), False),
}
FLAGS = {
    "of NumPy": Gift(np.bool_, True),
    "0 or 1": Gift(int, True),
    "None": Gift(lambda due: None, False),
    "words": Gift(str, False),
    "2": Gift(lambda due: 2, False),
    "0.0": Gift(float, False),
    "array": Gift(lambda due: np.array([due]), False),
    "list": Gift(lambda due: [], False),
}
INFOS = {
    "full": Gift(lambda due: {"x": object()}, True),
    "None": Gift(lambda due: None, False),
    "list": Gift(lambda due: [], False),
}
PLACES = {"start": OBSERVATIONS, "observation": OBSERVATIONS, "reward": REWARDS, "terminated": FLAGS,
          "truncated": FLAGS, "info": INFOS}  # fmt: skip
RAISED = (
    RuntimeError("broken"), TypeError(), KeyError("x"), SystemExit(0), KeyboardInterrupt(), GeneratorExit(),
    StopIteration(), MemoryError(), AssertionError("\n" * 99), UserError("its own"), RecursionError(),
)  # fmt: skip


class Plan(NamedTuple):
    """What goes otherwise, when, and in which instance: 2 is trained in, 3 evaluated in."""

    place: str
    gift: Gift
    at: int
    instance: int
    error: BaseException | None
    """Raised there instead."""
    reuses: bool
    """One array for all observations."""


class Drawn(gymnasium.Env):
    """Observes (call, call², sign); the reward is the number of the call. Everything fits into 8 bits."""

    plan: Plan
    made = count(1)
    given: list
    """(observation that is due, reward that is due), from the start on, of the instance that is trained in."""

    def __init__(self, render_mode: Any = None) -> None:
        self.observation_space = Box(-np.inf, np.inf, (SIZE,), np.float64)
        self.action_space = Box(-1, 1, (1,))
        self.number, self.calls, self.buffer = next(Drawn.made), 0, np.zeros(SIZE)

    def give(self, place: str, due: Any) -> Any:
        plan = Drawn.plan
        if (place, self.number, self.calls) != (plan.place, plan.instance, plan.at):
            return due
        if plan.error is not None:
            raise plan.error
        return plan.gift.make(due)

    def observe(self, place: str, reward: float | None) -> Any:
        due = np.array([self.calls, (self.calls**2) % 100, (-1) ** self.calls], np.float64)
        if self.number == 2:
            Drawn.given.append((due, reward))
        self.buffer[:] = due
        return self.give(place, self.buffer if Drawn.plan.reuses else due)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        return self.observe("start", None), {}

    def step(self, action: np.ndarray) -> Any:
        self.calls += 1
        reward = float(self.calls)
        action *= 0  # it is the environment's own
        return (self.observe("observation", reward), self.give("reward", reward), self.give("terminated", False),
                self.give("truncated", self.calls % LIMIT == 0), self.give("info", {}))  # fmt: skip


gymnasium.register("Drawn-v0", Drawn)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    place = draw(st.sampled_from(list(PLACES)))
    gift = PLACES[place][draw(st.sampled_from(list(PLACES[place])))]
    at = draw(st.sampled_from([0, LIMIT, 2 * LIMIT] if place == "start" else range(1, STEPS + 1)))
    error = draw(st.none() | st.sampled_from(RAISED))
    return Plan(place, gift, at, draw(st.sampled_from([2, 2, 3])), error, draw(st.booleans()))


def outcome(folder: Path, environment: str, **changes: Any) -> tuple[BaseException | None, LocalEngine | None]:
    """How a training ends, and its engine; nothing but errors in words may come out."""
    engines: list[LocalEngine] = []
    real = LocalEngine.__init__

    def init(engine: LocalEngine, *arguments: Any) -> None:
        real(engine, *arguments)
        engines.append(engine)

    config = make_config(environment, "sac", overrides={**SMALL, **changes})
    try:
        with mock.patch.object(LocalEngine, "__init__", init), requests_from_signals():
            list(loop.train(config, folder))
    except (UserError, RunBroken) as raised:
        error = raised
    else:
        return None, engines[0]
    assert "\n" not in str(error)
    return error, next(iter(engines), None)


@fuzzed
@given(plans())
def test_what_is_given_is_stored_or_refused(plan: Plan) -> None:
    Drawn.plan, Drawn.made, Drawn.given = plan, count(1), []
    event(plan.place)
    with tempfile.TemporaryDirectory() as folder:
        error, engine = outcome(Path(folder), "Drawn-v0")
        if plan.error is not None and error is not None:
            assert "raised an error in" in str(error)
            assert "Traceback" in next(Path(folder).rglob("traceback.txt")).read_text()
        reached = plan.instance == 2 or plan.at <= (LIMIT if plan.place == "start" else 2 * LIMIT)  # two evaluations
        fair = plan.gift.fair and plan.error is None
        assert (error is None) == (fair or not reached), (error, plan)
        assert error is None or "Drawn-v0" in str(error)
    if engine is None:
        return
    expected = expected_rows()
    stored = engine.replay.layout.unpack(engine.replay.rows[: engine.replay.added])
    assert engine.replay.added == (STEPS if error is None else engine.run.counters.steps)
    for name, column in expected.items():
        np.testing.assert_array_equal(getattr(stored, name), column[: engine.replay.added], err_msg=name)


def expected_rows() -> dict[str, np.ndarray]:
    """What must lie in the replay buffer, from what was due: each start begins an episode."""
    rows = [(before, after, reward) for (before, _), (after, reward) in zip(Drawn.given, Drawn.given[1:], strict=False)
            if reward is not None]  # fmt: skip
    before, after, rewards = zip(*rows, strict=True) if rows else ([], [], [])
    return {
        "observation": np.array(before, np.float32).reshape(-1, SIZE),
        "next_observation": np.array(after, np.float32).reshape(-1, SIZE),
        "reward_terms": np.array(rewards, np.float32).reshape(-1, 1),
    }


# --- spaces


class Spaces(gymnasium.Env):
    """Of any spaces; every action that it is given must lie in its own."""

    observation_space: Any
    action_space: Any
    taken = 0

    def __init__(self, render_mode: Any = None) -> None:
        self.observation_space, self.action_space = Spaces.observation_space, Spaces.action_space

    def observe(self) -> Any:
        return np.ones(self.observation_space.shape, self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action: np.ndarray) -> Any:
        assert self.action_space.contains(action), (action, self.action_space)
        Spaces.taken += 1
        return self.observe(), 1.0, False, Spaces.taken % LIMIT == 0, {}


gymnasium.register("Spaces-v0", Spaces)
KINDS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u8")
ENDS = (-np.inf, -1e300, -(2.0**63), -(2.0**31), -128, -3, -1, -0.25, 0, 0.1, 1, 7, 127, 255, 2.0**31, 2.0**53, 2.0**63,
        3e38, 1e300, np.inf, np.nan)  # fmt: skip


def within(value: float, kind: str) -> Any:
    """The value as the type has it, at its limits where it is beyond them."""
    if np.dtype(kind).kind == "f":
        return np.array(value).astype(kind)
    if np.isnan(value):
        return np.array(0, kind)
    limits = np.iinfo(kind)
    return np.array(limits.min if value <= limits.min else limits.max if value >= limits.max else int(value), kind)


@st.composite
def boxes(draw: st.DrawFn) -> Box:
    kind = draw(st.sampled_from(KINDS))
    low, high = draw(st.tuples(st.sampled_from(ENDS), st.sampled_from(ENDS)))
    if draw(st.integers(0, 9)):
        low, high = min(low, high), max(low, high)
    box = seen(draw(st.sampled_from([(1,), (1,), (1,), (0,), (), (2, 2)])), kind)
    with np.errstate(all="ignore"):  # set afterwards, as Box would refuse some
        box.low, box.high = np.full(box.shape, within(low, kind)), np.full(box.shape, within(high, kind))
    return box


def seen(shape: tuple[int, ...], kind: str) -> Box:
    return Box(0, 1, shape, np.dtype(kind).type)


OTHERS = st.sampled_from([Discrete(3), Dict({"a": Discrete(2)}), None, 3])
OBSERVED = st.builds(seen, st.sampled_from([(SIZE,)] * 5 + [(), (0,), (2, 2)]), st.sampled_from(KINDS)) | OTHERS


@fuzzed
@given(OBSERVED, boxes() | OTHERS)
def test_any_spaces_are_served_exactly_or_refused(observation: Any, action: Any) -> None:
    Spaces.observation_space, Spaces.action_space, Spaces.taken = observation, action, 0
    with tempfile.TemporaryDirectory() as folder:
        error, engine = outcome(Path(folder) / "run", "Spaces-v0")
        assert error is None or isinstance(error, UserError), error
        assert (error is None) == (Spaces.taken > 0), "what is refused is refused before anything is done"
        assert error is None or not (Path(folder) / "run").exists()
    fair = isinstance(observation, Box) and isinstance(action, Box) and observation.shape == (SIZE,)
    if error is None:
        assert engine is not None
        reached = engine.spec.scale_action(np.array([[-1.0], [1.0]], np.float32))
        bounds = np.array([action.low, action.high], np.float64).ravel()
        np.testing.assert_allclose(reached.ravel(), bounds, rtol=0, atol=1e-3 * np.abs(bounds).max())
    ends = np.array([action.low, action.high], np.float64).ravel() if fair else np.zeros(0)
    if fair and action.shape == (1,) and ends[0] <= ends[1] and np.abs(ends).max() < 1000:
        assert error is None, error


@pytest.mark.slow
def test_a_million_numbers_are_stored_as_they_are_seen() -> None:
    Spaces.observation_space, Spaces.action_space, Spaces.taken = Box(0, 1, (10**6,)), Box(-1, 1, (1,)), 0
    with tempfile.TemporaryDirectory() as folder:
        error, engine = outcome(Path(folder), "Spaces-v0", max_steps=8)
    assert error is None
    assert engine is not None
    assert (engine.replay.rows[:8, : 10**6] == 1).all()


def test_a_number_that_is_not_finite_is_called_so() -> None:
    Drawn.plan, Drawn.made, Drawn.given = Plan("reward", REWARDS["NaN"], 3, 2, None, False), count(1), []
    with tempfile.TemporaryDirectory() as folder:
        error, _ = outcome(Path(folder), "Drawn-v0")
    assert isinstance(error, NonFiniteError)
