"""A run of a group is the run that it would be alone, and none of its business is another's."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from environments.tiny import Fragile
from resume.helpers import assert_same_run, environment_of, without_seconds

from saclab.batch.engine import DeviceEngine
from saclab.batch.loop import train_batch
from saclab.batch.pool import EnvironmentWorkerDied
from saclab.errors import SettingError, UserError
from saclab.training import loop, seeds
from saclab.training.common_checkpoint import checkpoint_steps
from saclab.training.local_engine import LocalEngine
from saclab.training.run_folder import is_finished, read_run

from .helpers import at_step, config, engine_of, failures, folders, mixed, tiny_environments, train

OF_EPISODES = {"n_step": 3, "observation_normalisation": "running"}


@pytest.mark.parametrize(
    ("environment", "environments", "changes"),
    [
        ("Pendulum-v1", 1, {}),
        pytest.param("Fragile-v0", 3, OF_EPISODES, marks=pytest.mark.slow),
        pytest.param("Fragile-v0", 3, {}, marks=pytest.mark.slow),
        pytest.param("Pendulum-v1", 3, OF_EPISODES, marks=pytest.mark.slow),
    ],
)
def test_a_run_of_a_group_is_the_run_alone(tmp_path, monkeypatch, environment, environments, changes):
    """Equal but for rounding, as long as Pendulum does not make a difference of it; episodes end in the other one."""
    with tiny_environments(monkeypatch) as prefix:
        name = prefix + environment if environment == "Fragile-v0" else environment
        configs = mixed(environment=name, parallel_environments=environments, max_steps=150, **changes)
        if environment == "Fragile-v0":
            configs = [make(each, "nan", broken_at=10**9) for each in configs]
        assert failures(train(tmp_path, configs)) == {}
        for own, folder in zip(configs, folders(tmp_path, configs), strict=True):
            list(loop.train(own, tmp_path / "alone" / folder.name))
            assert_close(read_run(folder), read_run(tmp_path / "alone" / folder.name))
    assert len(read_run(tmp_path / "run-0").episodes["episode"]) == (18 if environment == "Fragile-v0" else 0)


def assert_close(ours, theirs):
    assert ours.config == theirs.config
    for part in ("evaluations", "episodes", "metrics"):
        mine, other = getattr(ours, part), getattr(theirs, part)
        assert mine.keys() == other.keys()
        for name in mine.keys() - {"seconds"}:
            np.testing.assert_allclose(mine[name], other[name], rtol=0.02, atol=1e-3, err_msg=f"{part} {name}")
    assert {k: v for k, v in ours.result.items() if type(v) in (int, str)} == {
        k: v for k, v in theirs.result.items() if type(v) in (int, str)
    }


STEPS_OF_LEARNING = 24


def actions_alone(own):
    """f32[n, A]: the actions of the run alone in its first steps after the random ones."""
    with closing(LocalEngine.new(own)) as engine:
        replay = engine.replay
        while replay.added < own.training.random_steps + STEPS_OF_LEARNING:
            engine.step()
        return replay.layout.unpack(replay.rows[own.training.random_steps : replay.added]).action


@pytest.mark.slow
def test_the_behaviour_parameters_are_as_far_behind_as_they_are_alone():
    """With a learning rate at which each update shows in the actions."""
    fast = {"actor_learning_rate": 0.03, "critic_learning_rate": 0.03, "replay_capacity": 1000}
    expected = {delay: actions_alone(config(acting_delay=delay, **fast)) for delay in (0, 1)}
    assert np.abs(expected[0] - expected[1]).max() > 0.05
    for delay, actions in expected.items():
        with closing(engine_of([config(acting_delay=delay, **fast)])) as engine:
            while engine.steps < 60 + STEPS_OF_LEARNING:
                engine.step()
                if engine.steps == 71:
                    engine.flush()  # as a checkpoint does
            found = engine.program.layout.unpack(engine.snapshot(0).replay.rows[60 : engine.steps]).action
        np.testing.assert_allclose(found, actions, atol=0.01)


def test_the_random_steps_are_those_of_the_run_alone():
    """Transitions, observations, generators and the scale of rewards, to the last bit."""
    changes = {"reward_scaling": "deviation", "reward_terms": ("reward_run",), "reward_weights": (2.0,)}
    configs = [config(seed=seed, environment="HalfCheetah-v4", parallel_environments=2, **changes)
               for seed in (3, 4, 5)]  # fmt: skip
    with closing(engine_of(configs, workers=2)) as group:
        for _ in range(30):
            group.step()
        for place, own in enumerate(configs):
            with closing(LocalEngine.new(own)) as engine:
                while engine.run.counters.steps < group.steps:
                    engine.step()
                assert group.steps == own.training.random_steps
                ours, theirs = group.snapshot(place), engine.snapshot(0)
                assert ours.replay.size == theirs.replay.size
                np.testing.assert_array_equal(ours.replay.rows[: ours.replay.size], theirs.replay.rows[: group.steps])
                np.testing.assert_array_equal(ours.observation, theirs.observation)
                assert ours.run.exploration.capture()[0] == theirs.run.exploration.capture()[0]
                assert ours.run.reward_scale.moments[0] > group.steps
                assert ours.run.reward_scale.moments.tolist() == theirs.run.reward_scale.moments.tolist()
                assert ours.run.sampling.bit_generator.state == theirs.run.sampling.bit_generator.state


@pytest.mark.slow
def test_what_the_other_runs_are_changes_no_bit(tmp_path):
    """The number of slots does decide the last bits; neighbours, places, processes and early ends do not."""
    configs = mixed()
    others = [config("sac", 7, max_episodes=1), configs[1], config("sac-auto", 8, critic_learning_rate=0.01)]
    train(tmp_path / "first", configs, workers=1)
    train(tmp_path / "second", others, workers=3)
    assert read_run(tmp_path / "second/run-0").result["reason"].startswith("max_episodes")
    assert_same_run(tmp_path / "first/run-1", tmp_path / "second/run-1")
    train(tmp_path / "third", [others[2], configs[1]], slots=3)
    assert_same_run(tmp_path / "first/run-1", tmp_path / "third/run-1")


def doomed_of(configs):
    """Runs with an environment that will go wrong."""
    found = []
    for run, own in enumerate(configs):
        environment = Fragile()
        environment.reset(seed=seeds.integers(own.seed, "environments", 1)[0])
        found += [run] * environment.doomed
    return found


def make(own, how, broken_at=100):
    return dataclasses.replace(own, environment_arguments={"how": how, "broken_at": broken_at})


@pytest.mark.parametrize(
    ("how", "words"),
    [
        pytest.param("nan", "reward nan", marks=pytest.mark.slow),
        ("raise", "Fragile-v0 raised an error in step: RuntimeError: the wheels came off"),
    ],
)
def test_a_run_that_breaks_leaves_the_others_untouched(tmp_path, monkeypatch, how, words):
    with tiny_environments(monkeypatch) as prefix:
        configs = [config(seed=seed, environment=prefix + "Fragile-v0", evaluation_interval_steps=999)
                   for seed in range(4)]  # fmt: skip
        doomed = doomed_of(configs)
        assert 0 < len(doomed) < 4
        told = train(tmp_path / "broken", [make(each, how) for each in configs])
        train(tmp_path / "whole", [make(each, "nan", broken_at=10**9) for each in configs])
    assert failures(told).keys() == set(doomed)
    assert all(words in message and "What led to it lies in" in message for message in failures(told).values())
    for run in range(4):
        folder = tmp_path / f"broken/run-{run}"
        assert is_finished(folder) == (run not in doomed)
        if run not in doomed:
            ours, theirs = (without_seconds(tmp_path / f"{part}/run-{run}/metrics.jsonl")
                            for part in ("broken", "whole"))  # fmt: skip
            assert ours == theirs
            continue
        story = json.loads((folder / "failure/failure.json").read_text())
        arrays = safetensors.numpy.load((folder / "failure/state.safetensors").read_bytes())
        assert (story["counters"]["steps"], story["counters"]["updates"]) == (99, 19), "as before the step that broke"
        assert (int(arrays[".actor.moments.count"]), len(arrays["recent_transitions"])) == (19, 99)
        assert ("in step" in story["traceback"]) == (how == "raise")


def test_an_environment_that_breaks_in_an_evaluation_ends_its_own_run(tmp_path, monkeypatch):
    """It would do so again each time the group is continued."""
    with tiny_environments(monkeypatch) as prefix:
        configs = [config(seed=seed, environment=prefix + "Fragile-v0", evaluation_episodes=1) for seed in range(8)]
        sound = [own for run, own in enumerate(configs) if run not in doomed_of(configs)]  # while they are trained
        told = train(tmp_path, [make(own, "raise", broken_at=15) for own in sound])
    assert 0 < len(failures(told)) < len(sound)
    assert all("wheels came off" in message for message in failures(told).values())
    for run in range(len(sound)):
        evaluations = read_run(tmp_path / f"run-{run}").evaluations["evaluation"]
        assert (len(evaluations) == 3) == (run not in failures(told)), "a failed run lacks the one that broke it"
        assert is_finished(tmp_path / f"run-{run}") == (run not in failures(told))


def spoil_critic(engine, run):
    critic = engine.state.critic
    engine.state = engine.state._replace(critic=critic._replace(weights=critic.weights.at[run].set(np.nan)))


def test_a_learner_that_is_not_finite_at_the_last_save_ends_its_own_run(tmp_path):
    configs = mixed()

    def spoil(engine):
        engine.flush()
        spoil_critic(engine, 1)

    with at_step(240, spoil):
        told = train(tmp_path, configs)
    assert failures(told).keys() == {1}
    assert "critic.weights is not finite" in failures(told)[1]
    assert [is_finished(folder) for folder in folders(tmp_path, configs)] == [True, False, True]


def test_a_run_whose_update_breaks_is_told_of_the_update(tmp_path):
    real = DeviceEngine._advance

    def breaking(engine, updates, packed):
        real(engine, updates, packed)
        if engine.steps == 102:
            spoil_critic(engine, 2)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DeviceEngine, "_advance", breaking)
        told = train(tmp_path, mixed())
    assert failures(told).keys() == {2}
    assert "gave a value that is not finite in critic_loss" in failures(told)[2]
    assert json.loads((tmp_path / "run-2/failure/failure.json").read_text())["counters"]["steps"] < 130
    assert is_finished(tmp_path / "run-0")


def test_a_process_that_dies_has_its_last_words_told(tmp_path, monkeypatch):
    """Nothing is lost: all runs have a checkpoint of the same step."""
    with tiny_environments(monkeypatch) as prefix:
        configs = [make(config(seed=seed, environment=prefix + "Fragile-v0"), "exit") for seed in range(4)]
        with pytest.raises(EnvironmentWorkerDied, match=r"exit status 1: the process came off\. Nothing .* is lost"):
            train(tmp_path, configs, checkpoint_minutes=0.001)
    steps = [checkpoint_steps(folder)[0] for folder in folders(tmp_path, configs)]
    assert len(set(steps)) == 1
    assert 0 < steps[0] < 100


DEVICES = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import jax
from batch.helpers import mixed, train
assert len(jax.devices()) == int(sys.argv[3]), jax.devices()
train(Path(sys.argv[2]), mixed())
"""


@pytest.mark.slow
@pytest.mark.parametrize("devices", [4, 2])
def test_runs_are_spread_over_devices(tmp_path, devices):
    """Three runs: on two devices one slot stays empty, on four as well."""
    flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    tests = str(Path(__file__).parents[1])
    subprocess.run(
        [sys.executable, "-c", DEVICES, tests, str(tmp_path / "many"), str(devices)],
        check=True, env=environment_of() | flags, timeout=600,
    )  # fmt: skip
    train(tmp_path / "one", mixed())
    for run in range(3):
        ours, theirs = read_run(tmp_path / f"many/run-{run}"), read_run(tmp_path / f"one/run-{run}")
        assert (ours.machine["batch"], ours.machine["device"]) == (4, f"{devices} × cpu")
        for name in ours.metrics.keys() - {"seconds"}:
            np.testing.assert_allclose(ours.metrics[name][:5], theirs.metrics[name][:5], rtol=0.02, atol=1e-3)
        assert ours.result["updates"] == theirs.result["updates"]


def test_replay_buffers_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(SettingError, match=r"in each of 3 runs at once.*or a smaller --batch"):
        train(tmp_path, mixed(replay_capacity=10**11))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"activation": "tanh"}, "activation, and it is 'relu' in the first and 'tanh' in number 3"),
        ({"hidden_layers": (16, 8)}, "hidden_layers"),
        ({"snapshots": 2}, "snapshots"),
        ({"parallel_environments": 2}, "parallel_environments"),
        ({"max_updates": 17}, "max_updates"),
        ({"environment": "MountainCarContinuous-v0"}, "environment"),
    ],
)
def test_runs_of_different_structure_are_refused_and_nothing_is_written(tmp_path, changes, named):
    """Otherwise the first one's setting would be used for all of them, in silence."""
    with pytest.raises(UserError, match=rf"must agree in {named}"):
        train(tmp_path, [config(seed=0), config(seed=1, discount=0.5), config(seed=2, **changes)])
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_use_is_refused(tmp_path):
    configs = mixed()
    with closing(train_batch(configs, folders(tmp_path, configs), workers=1)) as first:
        next(first)
        with pytest.raises(UserError, match="in use by this process"):
            train(tmp_path, configs)


def test_the_environments_of_a_group_are_closed(tmp_path, monkeypatch):
    signed = tmp_path / "signed"
    signed.mkdir()
    with tiny_environments(monkeypatch) as prefix:
        own = config(environment=f"{prefix}Signing-v0")
        own = dataclasses.replace(own, environment_arguments={"folder": str(signed)})
        with closing(engine_of([own, own], workers=2)):
            before = {path.name.split("-")[1] for path in signed.iterdir()}
        workers = {path.name.split("-")[1] for path in signed.iterdir()} - before - {str(os.getpid())}
    assert len(workers) == 2
