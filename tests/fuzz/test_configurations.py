"""Every option of `saclab train` at its edges is accepted, or refused in words, within seconds."""

from __future__ import annotations

import dataclasses
import signal
import sys
import time
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest
from hypothesis import HealthCheck, assume, event, example, given, settings
from hypothesis import strategies as st

from saclab.cli.main import parse
from saclab.cli.settings import with_absolute_paths
from saclab.cli.training import Train, parse_arguments
from saclab.config import Config
from saclab.errors import NonFiniteError, UserError
from saclab.limits import require_minutes, require_threads
from saclab.protocols import make_config
from saclab.settings import AlgorithmSettings, TrainingSettings
from saclab.training import loop
from saclab.training.events import Finished
from saclab.training.local_engine import LocalBuilder

SECONDS = 120  # for one line; a few hundredths, unless the machine is busy
SMALL = ("--random-steps", "300", "--batch-size", "8", "--hidden-layers", "4", "--replay-capacity", "1000",
         "--evaluation-episodes", "1", "--evaluation-interval-steps", "400", "--max-steps", "320")  # fmt: skip

# --- values

WHOLE = ("0", "-1", "1", "2", "3", "7", "100000000", str(2**31), str(2**53 + 1), str(2**63), str(10**308))
REAL = (
    "0",
    "-0.0",
    "-1",
    "0.5",
    "1",
    "1e-308",
    "1e-38",
    "1e-7",
    "1e8",
    "1e38",
    "1e308",
    "-1e308",
    "nan",
    "inf",
    "-inf",
)
TEXT = (
    "",
    " ",
    "None",
    "none",
    "nonsense",
    "x" * 5000,
    "é",
    "\U0001f600",
    "../..",
    "a b",
    "0x10",
    "1_000",
    "1,5",
    "{}",
)
JSON = (
    "{}",
    "[]",
    "null",
    "{",
    '{"g": 9.8}',
    '{"g": NaN}',
    '{"g": 1e999}',
    '{"no_such": 1}',
    "[" * 100_000,
    "1" * 5000,
)
ANY = st.sampled_from(WHOLE + REAL + TEXT)


def flat(parts: list[list[str]]) -> list[str]:
    return [word for part in parts for word in part]


def values(hint: Any) -> st.SearchStrategy[list[str]]:
    """Words for an option of a type; now and then ones that belong to no type."""
    return st.one_of(right(hint), right(hint), right(hint), ANY.map(lambda word: [word]), st.just([]))


def right(hint: Any) -> st.SearchStrategy[list[str]]:
    """Words of the right type, sensible or not."""
    kind, arguments = get_origin(hint), get_args(hint)
    if kind is Literal:
        return st.sampled_from(arguments).map(lambda choice: [str(choice)])
    if kind is tuple:
        return st.lists(right(arguments[0]), max_size=4).map(flat)
    if kind in (Union, types.UnionType):
        return st.one_of(*map(right, arguments))
    words = {int: WHOLE, float: REAL, bool: ("True", "False"), type(None): ("None",)}.get(hint, TEXT)
    return st.sampled_from(words).map(lambda word: [word])


def options() -> dict[str, st.SearchStrategy[list[str]]]:
    """Each option of the command, with words for it."""
    hints = get_type_hints(AlgorithmSettings) | get_type_hints(TrainingSettings)
    found = {"--" + name.replace("_", "-"): values(hint) for name, hint in hints.items()}
    found |= {
        "--" + name: values(get_type_hints(Train)[name]) for name in ("variant", "protocol", "seed", "name", "threads")
    }
    found |= {"--runs": values(str), "--checkpoint-minutes": values(float), "--no-such": values(str)}
    flags = {
        f"--{word}{name}": st.just([]) for word in ("", "no-") for name in ("joint-forward", "actor-joint-forward")
    }
    return found | flags | {"--environment-arguments": st.sampled_from(JSON).map(lambda text: [text])}


OPTIONS = options()
LINE = st.lists(
    st.sampled_from(sorted(OPTIONS)).flatmap(lambda name: OPTIONS[name].map(lambda words: [name, *words])), max_size=4
)

# --- what must hold


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fail in place of hanging."""

    def give_up(number: int, frame: object) -> None:
        raise TimeoutError(f"not done within {seconds} seconds")

    previous = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


def accepted(words: list[str]) -> Config | None:
    """The configuration that the command would train, once all that it refuses beforehand is through; else None."""
    try:
        command = with_absolute_paths(parse(["train", "Pendulum-v1", *words]))
        require_threads(command.threads)
        require_minutes(command.where.checkpoint_minutes)
        config = make_config(
            command.environment, command.variant, command.protocol, command.seed,
            parse_arguments(command.where.environment_arguments), {**command.algorithm, **command.training},
        )  # fmt: skip
        LocalBuilder(config)
    except SystemExit as end:
        if end.code != 2:
            raise
    except UserError as error:
        require_one_line(error)
    else:
        return config
    return None


def require_one_line(error: Exception) -> None:
    assert 0 < len(str(error)) < 2_000
    assert "\n" not in str(error)


@given(LINE)
@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@example([["--environment-arguments", "[" * 100_000]])
@example([["--hidden-layers", "100000000", "100000000"]])
@example([["--longest-noise", "100000000"]])
@example([["--snapshot-interval", str(2**31)]])
@example([["--max-updates", str(10**308)], ["--learning-rate-schedule", "linear"]])
@example([["--target-entropy", "nan"]])
@example([["--initial-temperature", "1e308"]])
@example([["--checkpoint-minutes", "nan"]])
@example([["--threads", "100000000"]])
@example([["--parallel-environments", str(10**308)]])
def test_a_line_is_accepted_or_refused_in_words(line):
    with within(SECONDS):
        config = accepted(flat(line))
    event("refused" if config is None else "accepted")
    if config is not None:
        assert Config.from_dict(config.to_dict()) == config


LARGEST_TRAINED = {
    "parallel_environments": 3, "evaluation_episodes": 3, "q_bias_episodes": 3, "updates_per_interval": 7,
    "critics": 7, "snapshots": 100, "critic_atoms": 101, "entropy_window": 100_000, "replay_capacity": 10**6,
    "max_steps": 320, "random_steps": 310, "batch_size": 310,
}  # fmt: skip
"""Setting -> the largest value that is trained with here."""
FEW = min(200, max(5, settings().max_examples // 10))  # of the profile's, each of which takes seconds


@pytest.mark.slow
@given(LINE)
@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much], max_examples=FEW)
def test_what_is_accepted_and_small_trains(tmp_path_factory, line):
    """To its end, or to a number that is not finite, which is told in words."""
    config = accepted([*SMALL, *flat(line)])
    assume(config is not None)
    chosen = dataclasses.asdict(config.algorithm) | dataclasses.asdict(config.training)
    assume(all(chosen[name] is not None and chosen[name] <= most for name, most in LARGEST_TRAINED.items()))
    assume(all(max(chosen[name] or (1,)) <= 100 for name in ("hidden_layers", "critic_hidden_layers")))
    folder: Path = tmp_path_factory.mktemp("run")
    try:
        with within(10 * SECONDS):
            *_, last = loop.train(config, folder)
    except (NonFiniteError, UserError) as error:
        require_one_line(error)
    else:
        assert isinstance(last, Finished)


def test_the_time_limit_is_one():
    """The tests above can fail."""
    with pytest.raises(TimeoutError), within(0.05):
        time.sleep(5)
    assert sys.exc_info() == (None, None, None)
