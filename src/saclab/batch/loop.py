"""Train a run group: the training loop on the device engine; each run keeps its own folder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from saclab.batch.builder import DeviceBuilder
from saclab.config import Config, require_same_structure
from saclab.files import absolute
from saclab.machine import usable_cores
from saclab.training.failure import tracebacks_in
from saclab.training.loop import Told, train_runs, unfinished
from saclab.training.process import prepare_process
from saclab.training.requests import Requests


def train_batch(
    configs: Sequence[Config],
    folders: Sequence[Path],
    requests: Requests | None = None,
    checkpoint_minutes: float = 10,
    slots: int = 0,
    workers: int | None = None,
) -> Told:
    """Train runs of the same structure together, from the start or from their newest common checkpoint.

    A run that finishes, or that meets a number that is not finite, leaves the others as they are.

    Args:
        configs: what to train; `config.group_key` says what they must have in common.
        folders: the run folders; made if they do not exist.
        requests: asks the group to stop or save.
        checkpoint_minutes: wall-clock time between checkpoints; it does not change the result.
        slots: room of the compiled program, if more than runs: results depend on it in the last bits.
        workers: processes that step the environments; None for one per core.

    Yields:
        The place of a run in `configs`, and what it tells.

    Raises:
        UserError: if the runs do not have the same structure, or a folder holds another configuration or is in use.
        TrainingFailed: if no checkpoint can be written or read, or a process that steps environments has died.
    """
    require_same_structure(configs)
    folders = [absolute(folder) for folder in folders]
    places = unfinished(configs, folders)
    if not places:
        return
    prepare_process()
    own_folders = [folders[place] for place in places]
    with tracebacks_in(own_folders):
        builder = DeviceBuilder([configs[place] for place in places], slots, workers or len(usable_cores()))
    with closing(train_runs(builder, own_folders, requests, checkpoint_minutes)) as told:
        for run, event in told:
            yield places[run], event
