"""A run group that was stopped, killed or broken off at any moment goes on as if nothing had been."""

from __future__ import annotations

from contextlib import closing

import pytest
from axes import TOGETHER
from resume.helpers import assert_same_run

from saclab.batch.engine import DeviceEngine
from saclab.batch.loop import train_batch
from saclab.batch.pool import EnvironmentWorkerDied
from saclab.training import checkpoint, loop
from saclab.training.checkpoint import CheckpointError
from saclab.training.common_checkpoint import checkpoint_steps, group_slots
from saclab.training.events import Evaluated, Interrupted, Saved, UpdatesLogged
from saclab.training.requests import Requests
from saclab.training.run_folder import is_finished, read_run

from .helpers import at_step, config, folders, mixed, stop_at, train


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["Pendulum-v1", "Hopper-v4"])
@pytest.mark.parametrize("stop", [50, 149])
def test_a_stopped_group_goes_on_bit_for_bit(tmp_path, environment, stop):
    """The stop comes in the random steps or after, a window of metrics, a round of updates and an episode under way."""
    configs = mixed(environment=environment, snapshots=2)
    train(tmp_path / "straight", configs)
    told = stop_at(stop, tmp_path / "stopped", configs)
    assert [event for _, event in told[-3:]] == [Interrupted(stop)] * 3
    assert not any(is_finished(folder) for folder in folders(tmp_path / "stopped", configs))
    train(tmp_path / "stopped", configs)
    for straight, stopped in zip(
        folders(tmp_path / "straight", configs), folders(tmp_path / "stopped", configs), strict=True
    ):
        assert_same_run(straight, stopped)


@pytest.mark.slow
def test_a_group_with_every_axis_at_once_goes_on_bit_for_bit(tmp_path):
    configs = [config("averaged-auto", seed, "HalfCheetah-v4", **TOGETHER) for seed in (0, 1)]
    train(tmp_path / "straight", configs)
    stop_at(149, tmp_path / "stopped", configs)
    train(tmp_path / "stopped", configs)
    for run in ("run-0", "run-1"):
        assert_same_run(tmp_path / "straight" / run, tmp_path / "stopped" / run)


@pytest.mark.slow
def test_a_group_that_goes_on_reads_each_file_of_its_checkpoints_once(tmp_path, monkeypatch):
    """A replay buffer may have gigabytes."""
    configs, reads, real = mixed(), [], checkpoint.read_arrays
    monkeypatch.setattr(checkpoint, "SEGMENT_ROWS", 40)
    stop_at(150, tmp_path, configs)

    def read_arrays(folder, name, entry):
        reads.append((folder.parent.parent.name, name))
        return real(folder, name, entry)

    monkeypatch.setattr(checkpoint, "read_arrays", read_arrays)
    with closing(train_batch(configs, folders(tmp_path, configs), workers=1)) as events:
        assert next(events)[1].resumed_at_step == 150
    assert len(reads) == len(set(reads))
    assert {("run-0", "replay-0003.safetensors"), ("run-2", "learner.safetensors")} < set(reads)


@pytest.mark.slow
def test_saving_changes_nothing(tmp_path):
    """A checkpoint brings the devices up to date before the next step would."""
    configs = mixed()
    train(tmp_path / "straight", configs)
    told = train(tmp_path / "saved", configs, checkpoint_minutes=0)
    assert sum(isinstance(event, Saved) for _, event in told) > 500
    assert_same_run(tmp_path / "straight/run-2", tmp_path / "saved/run-2")


@pytest.mark.slow
def test_a_stop_in_the_middle_of_an_evaluation_leaves_it_to_be_made(tmp_path):
    configs = mixed()
    train(tmp_path / "straight", configs)
    requests = Requests()
    events = train_batch(configs, folders(tmp_path / "stopped", configs), requests, workers=2)
    real = DeviceEngine.evaluate

    def ask_and_evaluate(engine, runs, should_stop):
        requests.stop = 1
        return real(engine, runs, should_stop)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DeviceEngine, "evaluate", ask_and_evaluate)
        told = list(events)
    assert isinstance(told[-1][1], Interrupted)
    assert not any(isinstance(event, Evaluated) for _, event in told)
    train(tmp_path / "stopped", configs)
    assert_same_run(tmp_path / "straight/run-1", tmp_path / "stopped/run-1")


@pytest.mark.slow
def test_a_crash_while_saving_goes_back_to_the_step_that_all_have(tmp_path):
    """Some runs have the newest checkpoint then, the others only the one before."""
    configs = mixed()
    train(tmp_path / "straight", configs)
    requests, saves = Requests(), 0
    with closing(train_batch(configs, folders(tmp_path / "killed", configs), requests, workers=2)) as events:
        for _, event in events:
            saves += isinstance(event, Saved)
            if saves == 4:
                break  # two runs have a second one
            requests.save = isinstance(event, UpdatesLogged)
    steps = [checkpoint_steps(folder) for folder in folders(tmp_path / "killed", configs)]
    assert [len(found) for found in steps] == [2, 1, 1]
    train(tmp_path / "killed", configs)
    for index in range(3):
        assert_same_run(tmp_path / f"straight/run-{index}", tmp_path / f"killed/run-{index}")


def test_runs_that_are_not_equally_far_are_no_group(tmp_path):
    configs = mixed()
    stop_at(50, tmp_path, configs[:1])
    with pytest.raises(CheckpointError, match=r"no whole checkpoint of the same step: .*run-0 has step-000000000050"):
        train(tmp_path, configs)


def test_a_run_of_a_group_goes_on_alone_and_says_that_bits_may_differ(tmp_path):
    configs = mixed()
    stop_at(150, tmp_path, configs)
    assert group_slots(tmp_path / "run-0") == 3
    told = list(loop.train(configs[0], tmp_path / "run-0"))
    assert any("batch was 3 when the checkpoint was made and is 0 now" in note for note in told[0].notes)
    assert read_run(tmp_path / "run-0").result["steps"] == 240


def test_a_group_whose_process_is_killed_goes_on_bit_for_bit(tmp_path):
    configs = mixed()
    train(tmp_path / "straight", configs)
    with (
        at_step(121, lambda engine: engine.pool.workers[0].process.kill()),
        pytest.raises(EnvironmentWorkerDied, match="killed by SIGKILL"),
    ):
        train(tmp_path / "killed", configs, checkpoint_minutes=0.001)
    train(tmp_path / "killed", configs)
    for index in range(3):
        assert_same_run(tmp_path / f"straight/run-{index}", tmp_path / f"killed/run-{index}")
