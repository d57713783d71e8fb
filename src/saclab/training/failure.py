"""What a run leaves for a look at it when it has come to a bad end."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import safetensors.numpy

from saclab.errors import RunBroken
from saclab.files import replace_file, write_json
from saclab.training.course import Course, named_leaves
from saclab.training.run_folder import FAILURE

RECENT_ROWS = 1000


def write_failure(folder: Path, run: Course, error: RunBroken) -> Path:
    """Write `folder`/failure: the offending step, the counters, the learner and the last transitions; no checkpoint.

    Files:
        failure.json: the message, the counters, and the traceback of an environment that raised an error.
        state.safetensors: the learner's arrays by name; recent_transitions f32[n, width], oldest first, packed as in
            the replay buffer; observation f32[N, O] before the step; metrics f32[updates, M] since the last line of
            metrics.jsonl; and what the error brought: action f32[A], next_observation f32[O] and reward f64[] of the
            environment's step.
    """
    failure = folder / FAILURE
    failure.mkdir(exist_ok=True)
    story = {"message": str(error), "counters": dataclasses.asdict(run.counters), "traceback": error.traceback}
    write_json(failure / "failure.json", story)
    recent = np.arange(run.replay.added - min(RECENT_ROWS, run.replay.size), run.replay.added) % run.replay.capacity
    arrays = {name: np.array(leaf) for name, leaf in named_leaves(run.learner()).items()}
    arrays |= {"recent_transitions": run.replay.rows[recent], "observation": run.observation}
    if run.window:
        arrays["metrics"] = np.stack([np.asarray(values) for values in run.window])
    arrays |= error.arrays
    replace_file(failure / "state.safetensors", safetensors.numpy.save(arrays))
    return failure
