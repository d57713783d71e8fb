"""What a run leaves for a look at it when it has met a number that is not finite."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import safetensors.numpy

from saclab.errors import NonFiniteError
from saclab.files import replace_file, write_json
from saclab.training.run import Run, named_leaves

RECENT_ROWS = 1000


def write_failure(folder: Path, run: Run, error: NonFiniteError) -> Path:
    """Write `folder`/failure: the offending step, the counters, the learner and the last transitions; no checkpoint.

    Files:
        failure.json: the message and the counters.
        state.safetensors: the learner's arrays by name; recent_transitions f32[n, width], oldest first, packed as in
            the replay buffer; observation f32[N, O] before the step; metrics f32[updates, M] since the last line of
            metrics.jsonl; and what the error brought: action f32[A], next_observation f32[O] and reward f64[] of the
            environment's step.
    """
    failure = folder / "failure"
    failure.mkdir(exist_ok=True)
    write_json(failure / "failure.json", {"message": str(error), "counters": dataclasses.asdict(run.counters)})
    recent = np.arange(run.replay.added - min(RECENT_ROWS, run.replay.size), run.replay.added) % run.replay.capacity
    arrays = {name: np.array(leaf) for name, leaf in named_leaves(run.learner_state).items()}
    arrays |= {"recent_transitions": run.replay.rows[recent], "observation": run.environments.observation}
    if run.window:
        arrays["metrics"] = np.stack([np.asarray(values) for values in run.window])
    arrays |= error.arrays
    replace_file(failure / "state.safetensors", safetensors.numpy.save(arrays))
    return failure
