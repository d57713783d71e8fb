"""What a run leaves for a look at it when it has come to a bad end."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import safetensors.numpy

from saclab.environments.watch import log
from saclab.errors import RunBroken, TrainingFailed, UserError, for_terminal
from saclab.files import replace_file, write_json
from saclab.training.learners import named_leaves
from saclab.training.manifest import visible_checkpoints
from saclab.training.run_folder import FAILURE
from saclab.training.snapshot import Snapshot

RECENT_ROWS = 1000


def write_failure_report(folder: Path, snapshot: Snapshot, error: RunBroken) -> str:
    """Write `folder`/failure: the offending step, the counters, the learner and the last transitions; no checkpoint.

    Files:
        failure.json: the message, the counters, and the traceback of an environment that raised an error.
        traceback.txt: that traceback, for people.
        state.safetensors: the learner's arrays by name; recent_transitions f32[n, width], oldest first, packed as in
            the replay buffer; observation f32[N, O] before the step; metrics f32[updates, M] since the last line of
            metrics.jsonl; and what the error brought: action f32[A], next_observation f32[O] and reward f64[] of the
            environment's step.

    Returns:
        A sentence that says where to look.
    """
    failure = folder / FAILURE
    try:
        failure.mkdir(exist_ok=True)
        counters = dataclasses.asdict(snapshot.run.counters)
        story = {"message": str(error), "counters": counters, "traceback": error.traceback}
        write_json(failure / "failure.json", story)
        write_traceback(failure, error)
        replace_file(failure / "state.safetensors", safetensors.numpy.save(report_arrays(snapshot, error)))
        left = f"What led to it lies in {failure}"
    except OSError as problem:
        left = f"What led to it could not be written to {folder} ({problem.strerror})"
    kept = visible_checkpoints(folder / "checkpoints")
    return left + (f"; the last checkpoint, {kept[0].name}, is kept" if kept else "")


TRACEBACK = "traceback.txt"


def write_traceback(folder: Path, error: UserError | TrainingFailed) -> None:
    """Keep the traceback of an environment that raised an error; raises OSError if it cannot be written."""
    if error.traceback:
        folder.mkdir(exist_ok=True)
        replace_file(folder / TRACEBACK, error.traceback.encode())


@contextmanager
def tracebacks_in(folders: Sequence[Path]) -> Iterator[None]:
    """Leave the traceback of what an environment raises in every one of these folders that is there, and say so."""
    try:
        yield
    except (UserError, TrainingFailed) as error:
        there = [folder for folder in folders if error.traceback and folder.is_dir()]
        try:
            for folder in there:
                write_traceback(folder, error)
        except OSError as problem:
            error.args = (f"{error}. Its traceback could not be written to {folder} ({problem.strerror})",)
        else:
            error.args = (f"{error}. The whole traceback lies in {there[0] / TRACEBACK}",) if there else error.args
        raise


def tell_of_closing(problems: Sequence[tuple[int, RunBroken]], folders: Sequence[Path]) -> None:
    """Say what environments raised when they were closed: their runs have come to no harm."""
    for run, error in problems:
        try:
            with tracebacks_in([folders[run]]):
                raise error
        except RunBroken as told:
            log.warning(f"{for_terminal(told, str(told))}. The run itself has come to no harm")


def report_arrays(snapshot: Snapshot, error: RunBroken) -> dict[str, np.ndarray]:
    """The arrays of state.safetensors."""
    replay, window = snapshot.replay, snapshot.run.window
    recent = np.arange(replay.added - min(RECENT_ROWS, replay.size), replay.added) % replay.capacity
    arrays = {name: np.array(leaf) for name, leaf in named_leaves(snapshot.learner).items()}
    arrays |= {"recent_transitions": replay.rows[recent], "observation": snapshot.observation}
    if window:
        arrays["metrics"] = np.stack([np.asarray(values) for values in window])
    return arrays | error.arrays
