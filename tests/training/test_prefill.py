"""What a run begins with: the same transitions as elsewhere, seen as played ones are, and no steps of the run."""

from __future__ import annotations

import dataclasses
import hashlib
from contextlib import closing

import gymnasium
import numpy as np
import pytest
from environments.recorded import record
from resume.helpers import finish, small_config, stop_at

import saclab
from saclab.errors import SettingError, UserError
from saclab.protocols import make_config
from saclab.records import Prefilled, read_json
from saclab.replay import ReplayBuffer, RowLayout, Windows
from saclab.training import loop
from saclab.training.checkpoint import newest_first, read_checkpoint, save_checkpoint
from saclab.training.events import Started
from saclab.training.guide import Guide
from saclab.training.local_engine import LocalBuilder, LocalEngine
from saclab.training.manifest import Moment
from saclab.training.prefill import begin_with, digest_of, read_prefill, side_by_side
from saclab.training.run_folder import read_run
from saclab.training.run_state import RunState

PENDULUM = "pendulum/random-v0"
ALL_SEEN = {"reward_scaling": "deviation_or_bound", "observation_normalisation": "running"}


@pytest.fixture(scope="module", autouse=True)
def shelf(tmp_path_factory):
    folder = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        record(PENDULUM, gymnasium.make("Pendulum-v1"), 90, episode=40)
        yield folder


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """A finished run of three environments, whose replay buffer of 150 has wrapped around."""
    folder = tmp_path_factory.mktemp("other")
    finish(small_config("Pendulum-v1", "sac", environments=3), folder)
    return folder


def prefilled(prefill: str, environment: str = "Pendulum-v1", **changes):
    return small_config(environment, "sac", prefill=prefill, **changes)


def begun(config) -> LocalEngine:
    """The engine of a run before its first step, as the loop builds it."""
    builder = LocalBuilder(config)
    prefill = read_prefill(config, builder.spec, builder.layout)
    engine = LocalEngine.new(config)
    engine.replay.add_rows(begin_with(prefill, engine.run))
    return engine


def replay_of(folder, config) -> ReplayBuffer:
    buffer = ReplayBuffer(config.training.replay_capacity, RowLayout(3, 1))
    read_checkpoint(newest_first(folder / "checkpoints")[0], buffer)
    return buffer


def test_prefilled_transitions_are_no_steps_of_the_run(tmp_path):
    """The random steps are played all the same, unless they are said to be fewer."""
    config = prefilled(f"minari:{PENDULUM}", replay_capacity=1000)
    started, *_, finished = finish(config, tmp_path)
    assert isinstance(started, Started)
    assert started.notes[1].startswith(f"begins with 90 transition(s) of minari:{PENDULUM}, SHA-256 ")
    assert (finished.steps, finished.updates) == (240, (240 - 60) // 2)
    run = read_run(tmp_path)
    assert run.evaluations["steps"].tolist() == [90, 180, 240]
    buffer = replay_of(tmp_path, config)
    assert buffer.added == 90 + 240
    assert (run.prefill.transitions, len(run.prefill.sha256)) == (90, 64)


def test_a_replay_of_data_is_learned_from_at_once_without_random_steps(tmp_path):
    config = prefilled(f"minari:{PENDULUM}", random_steps=0, max_steps=20)
    assert finish(config, tmp_path)[-1].updates == 10


def test_too_few_transitions_for_a_batch_are_refused(tmp_path):
    config = prefilled(f"minari:{PENDULUM}", random_steps=10, prefill_transitions=21)
    with pytest.raises(SettingError, match=r"batch_size = 32: .* 21 transitions of minari:.* and 10 of the run: use "
                       "--batch-size 31 or less, or --random-steps 11 or more"):  # fmt: skip
        list(loop.train(config, tmp_path))
    assert not (tmp_path / "config.json").exists()


def test_another_runs_replay_is_taken_bit_for_bit(other, tmp_path):
    config = prefilled(f"replay:{other}", environments=3, replay_capacity=200)
    with closing(begun(config)) as engine:
        theirs = replay_of(other, read_run(other).config)
        newest = theirs.rows[np.arange(theirs.added - 150, theirs.added) % 150]
        assert theirs.added == 240
        assert engine.replay.added == 150
        assert engine.replay.rows[:150].tobytes() == newest.tobytes()
        assert engine.run.counters.steps == 0


@pytest.mark.parametrize("environments", [1, 2, 4])
def test_windows_follow_the_episodes_however_many_environments(other, environments):
    """As many transitions are followed by the next of their episode as in the buffer of three environments."""

    def followed(rows: np.ndarray, stride: int) -> int:
        windows = Windows(RowLayout(3, 1), 2, stride)
        return int((windows.gather(rows, np.arange(len(rows)), np.int64(len(rows)))[1] == 2).sum())

    theirs = replay_of(other, read_run(other).config)
    expected = followed(theirs.rows[np.arange(theirs.added - 150, theirs.added) % 150], 3)
    assert expected > 140
    config = prefilled(f"replay:{other}", environments=environments)
    with closing(begun(config)) as engine:
        cut = environments - 1  # each of these environments begins within an episode
        assert expected - cut <= followed(engine.replay.rows, environments) <= expected + 3


def test_rows_side_by_side_by_hand():
    assert side_by_side(7, 1).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert side_by_side(7, 3).tolist() == [0, 3, 5, 1, 4, 6, 2]
    assert side_by_side(2, 3).tolist() == [0, 1]


def test_only_the_newest_that_fit_are_taken(other, tmp_path):
    config = prefilled(f"replay:{other}", replay_capacity=50, max_steps=70)
    notes = next(iter(loop.train(config, tmp_path))).notes
    assert notes[1].startswith(f"begins with the newest 50 of 150 transition(s) of replay:{other}")
    fewer = dataclasses.replace(config, training=dataclasses.replace(config.training, prefill_transitions=40))
    layout = RowLayout(3, 1)
    fifty, forty = (read_prefill(each, LocalBuilder(each).spec, layout) for each in (config, fewer))
    assert (len(fifty.rows), len(forty.rows)) == (50, 40)


def test_statistics_take_in_prefilled_transitions_like_played_ones(tmp_path):
    """A run's own replay, played by one environment, gives another run the same statistics."""
    played = small_config("Pendulum-v1", "sac", **ALL_SEEN, replay_capacity=1000, random_steps=240)
    with closing(LocalEngine.new(played)) as first:
        for _ in range(230):
            first.step()
        rows, expected = first.replay.rows[:230].copy(), first.run
        with closing(LocalEngine.new(played)) as second:
            builder = LocalBuilder(played)
            assert read_prefill(played, builder.spec, builder.layout) is None
            stop_at(230, played, tmp_path)
            taken = begun(dataclasses.replace(
                played, training=dataclasses.replace(played.training, prefill=f"replay:{tmp_path}")
            ))  # fmt: skip
            assert taken.replay.rows[:230].tobytes() == rows.tobytes()
            state: RunState = taken.run
            assert state.observation_moments.count == expected.observation_moments.count == 230
            np.testing.assert_allclose(state.observation_moments.value, expected.observation_moments.value, rtol=1e-6)
            assert state.reward_scale.value == pytest.approx(float(expected.reward_scale.value), rel=1e-6)
            assert state.reward_scale.value != second.run.reward_scale.value
            assert state.reward_scale.returns.tolist() == [0]
            taken.close()


def test_the_random_steps_are_acted_by_the_other_runs_policy(other):
    config = prefilled(f"policy:{other}", random_steps=40)
    theirs = saclab.load_policy(other)
    with closing(begun(config)) as engine, closing(LocalEngine.new(small_config("Pendulum-v1", "sac"))) as plain:
        for _ in range(40):
            observation = engine.environments.observation.copy()
            noise = plain.run.exploration.noise()
            engine.step()
            expected = theirs.policy.act(theirs.parameters, observation, noise)
            stored = engine.replay.layout.unpack(engine.replay.rows[engine.replay.added - 1][None])
            np.testing.assert_array_equal(stored.action, expected)
        assert (engine.replay.added, engine.run.counters.steps) == (40, 40)
        assert engine.replay.rows[:40, 3].std() > 0
        engine.step()
        assert not engine.run.exploring()


def test_a_policy_is_known_by_what_decides_how_it_acts(other):
    """A learning rate, or a setting that a later version adds, leaves its digest as it is."""
    policy, layout = saclab.load_policy(other), RowLayout(3, 1)

    def digest(parameters=policy.parameters, **changes) -> str:
        return Guide(dataclasses.replace(policy.settings, **changes), layout, parameters).sha256

    assert digest() == digest(discount=0.5, critic_learning_rate=0.1)
    others = digest(policy.parameters + 1), digest(log_std_minimum=-3.0), digest(log_std_bounding="tanh")
    assert len({digest(), *others}) == 4


def test_a_policy_of_another_task_is_told_of(other):
    config = dataclasses.replace(prefilled(f"policy:{other}"), environment_arguments={"g": 9.0})
    builder = LocalBuilder(config)
    told = read_prefill(config, builder.spec, builder.layout).notes
    assert told[1] == f"policy:{other} has environment_arguments {{}}, and here {{'g': 9.0}}"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"prefill": "minari"}, "prefill = 'minari': write minari:DATASET-ID, replay:RUN-FOLDER or policy:RUN-FOLDER"),
        ({"prefill": "minari:"}, "prefill = 'minari:': write"),
        ({"prefill": ""}, "prefill = '': write"),
        ({"prefill": 3}, "prefill = 3: Expected"),
        ({"prefill": "pickle:x"}, "prefill = 'pickle:x': write"),
        ({"prefill": "policy:x", "random_steps": 0, "batch_size": 1}, "use --random-steps 1 or more"),
        ({"prefill": "policy:x", "random_steps": 3}, "batch_size = 32: the first update would draw"),
        ({"prefill_transitions": 5}, "prefill_transitions = 5: use it with a prefill that holds transitions"),
        ({"prefill": "policy:x", "prefill_transitions": 5}, "prefill_transitions = 5: use it with"),
        ({"prefill": "minari:x", "prefill_transitions": 0}, "prefill_transitions = 0: use a whole number of at least"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, said):
    with pytest.raises(SettingError, match=said):
        small_config("Pendulum-v1", "sac", **changes)


def test_a_model_on_the_hub_has_to_be_downloaded_first():
    with pytest.raises(
        SettingError, match=r"prefill = 'policy:hf:ada/x@v1': .* with hf download ada/x --revision v1 --local-"
    ):
        make_config("Pendulum-v1", overrides={"prefill": "policy:hf:ada/x@v1"})
    assert make_config("Pendulum-v1", overrides={"prefill": "policy:./hf:x"}).training.prefill.endswith("/hf:x")


def test_a_policy_is_told_as_one():
    assert str(Prefilled(0, "a" * 64)) == "a policy, SHA-256 aaaaaaaaaaaaaaaa"
    assert str(Prefilled(3, "a" * 64)) == "3 transitions, SHA-256 aaaaaaaaaaaaaaaa"


def test_paths_do_not_depend_on_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/ada")
    for said, meant in {
        "replay:runs/x": f"replay:{tmp_path}/runs/x",
        "policy:~/x": "policy:/home/ada/x",
        "minari:./x": f"minari:{tmp_path}/x",
        "minari:a/x-v0": "minari:a/x-v0",
    }.items():
        assert make_config("Pendulum-v1", overrides={"prefill": said}).training.prefill == meant


def refusal(config, folder) -> str:
    with pytest.raises(UserError) as refused:
        list(loop.train(config, folder))
    assert not (folder / "config.json").exists()
    return str(refused.value)


def test_other_runs_that_do_not_fit_are_refused(other, tmp_path):
    own = tmp_path / "own"
    assert "is not a run folder" in refusal(prefilled("replay:/nosuch"), own)
    assert "there is no folder /nosuch" in refusal(prefilled("policy:/nosuch"), own)
    car = "MountainCarContinuous-v0"
    said = refusal(prefilled(f"replay:{other}", car), own)
    assert "the columns of its transitions are {'observation': 3, " in said
    assert "and this run's are {'observation': 2, " in said
    said = refusal(prefilled(f"policy:{other}", car), own)
    assert "its observations have 3 numbers, and this run's have 2" in said
    bounded = prefilled(f"policy:{other}", "environments.tiny:Counting-v0")
    assert "its actions lie between [-2.] and [2.], and this run's between [-1.] and [1.]" in refusal(bounded, own)
    bounded = prefilled(f"replay:{other}", "environments.tiny:Counting-v0")
    assert "its actions lie between [-2.] and [2.], and this run's between [-1.] and [1.]" in refusal(bounded, own)
    terms = prefilled(f"replay:{other}", "HalfCheetah-v4", reward_terms=("reward_run",))
    assert "its reward_terms are (), and this run's are ('reward_run',)" in refusal(terms, own)
    terms = prefilled(f"minari:{PENDULUM}", "HalfCheetah-v4", reward_terms=("reward_run",))
    assert "a Minari data set tells rewards and not their terms" in refusal(terms, own)


@pytest.mark.parametrize("source", ["minari", "replay", "policy"])
def test_a_source_that_cannot_be_read_is_named_and_not_the_run(tmp_path, source):
    """A loop of links raises an OSError whoever asks."""
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    said = refusal(prefilled(f"{source}:{tmp_path / 'loop' / 'x'}"), tmp_path / "own")
    assert f"{tmp_path / 'loop'}" in said
    assert "cannot write to" not in said


def test_an_error_of_the_disk_is_one_of_the_prefill(tmp_path, monkeypatch):
    def broken(*_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("saclab.training.prefill.read_config", broken)
    said = refusal(prefilled("replay:/broken"), tmp_path / "own")
    assert said == "prefill = 'replay:/broken': it cannot be read (Input/output error)"


def test_the_digest_in_parts_is_that_of_the_whole():
    rows = np.random.default_rng(0).standard_normal((20_000, 3)).astype(np.float32)
    assert digest_of(rows) == hashlib.sha256(rows.tobytes()).hexdigest()


def test_a_run_without_a_whole_checkpoint_is_refused_and_left_alone(tmp_path):
    own, source = tmp_path / "own", tmp_path / "source"
    stop_at(30, small_config("Pendulum-v1", "sac"), source)
    checkpoint = newest_first(source / "checkpoints")[0]
    rows = checkpoint / "replay-0000.safetensors"
    rows.write_bytes(rows.read_bytes()[:-1] + b"x")
    config = prefilled(f"replay:{source}")
    assert "no checkpoint can be used (step-000000000030: replay-0000.safetensors does not match" in refusal(
        config, own
    )
    assert newest_first(source / "checkpoints") == [checkpoint]
    for path in checkpoint.iterdir():
        path.unlink()
    checkpoint.rmdir()
    assert "it has none: let that run go on until it saves" in refusal(config, own)


def test_a_run_that_does_not_tell_its_action_bounds_is_told_of(tmp_path):
    """One that was stopped before its first evaluation has no policy yet."""
    stop_at(40, small_config("Pendulum-v1", "sac"), tmp_path)
    config = prefilled(f"replay:{tmp_path}")
    builder = LocalBuilder(config)
    told = read_prefill(config, builder.spec, builder.layout).notes
    assert (
        told[-1]
        == f"whether the actions of replay:{tmp_path} have this run's bounds is not known: it has no readable policy"
    )


def test_a_replay_with_what_is_not_finite_is_refused_with_its_place(tmp_path):
    own, source = tmp_path / "own", tmp_path / "source"
    config = small_config("Pendulum-v1", "sac")
    stop_at(30, config, source)
    buffer = ReplayBuffer(config.training.replay_capacity, RowLayout(3, 1))
    checkpoint = read_checkpoint(newest_first(source / "checkpoints")[0], buffer)
    buffer.rows[17, 2] = np.nan
    save_checkpoint(source / "checkpoints", Moment(31), checkpoint, buffer)
    assert "a number of transition 17 is not finite" in refusal(prefilled(f"replay:{source}"), own)


def test_wrappers_that_the_data_have_not_gone_through_are_told_of():
    config = prefilled(f"minari:{PENDULUM}", wrappers=("FlattenObservation", "RecordEpisodeStatistics"))
    builder = LocalBuilder(config)
    told = read_prefill(config, builder.spec, builder.layout).notes
    assert (
        told[1] == f"the data set {PENDULUM} is taken as it is: nothing in it has gone through RecordEpisodeStatistics"
    )


def test_a_run_that_has_to_begin_anew_begins_with_the_same_or_not_at_all(shelf, tmp_path):
    """Before its first checkpoint, a run has only the data set itself."""
    name = "pendulum/changing-v0"
    record(name, gymnasium.make("Pendulum-v1"), 50)
    config = prefilled(f"minari:{name}")
    with closing(loop.train(config, tmp_path)) as events:
        next(events)
    assert isinstance(next(iter(loop.train(config, tmp_path))), Started)
    import minari

    minari.delete_dataset(name)
    record(name, gymnasium.make("Pendulum-v1"), 51)
    with pytest.raises(UserError, match=r"has begun with another prefill 'minari:.*it had 50 transitions, SHA-256 .* "
                       r"then, and has 51 transitions, SHA"):  # fmt: skip
        list(loop.train(config, tmp_path))


def test_runs_without_a_prefill_write_what_they_wrote(tmp_path):
    with closing(loop.train(small_config("Pendulum-v1", "sac"), tmp_path)) as events:
        next(events)
    assert read_json(tmp_path / "config.json", dict).keys() == {"format", "config", "versions", "machine"}


@pytest.mark.slow
def test_a_good_replay_teaches_sooner(tmp_path):
    """Pendulum-v1 with the replay of a trained run, over two seeds each."""
    settings = {"update_interval": 1, "random_steps": 1000, "hidden_layers": (64, 64), "max_updates": 5000,
                "evaluation_interval_steps": 500, "evaluation_episodes": 10}  # fmt: skip
    source = saclab.train("Pendulum-v1", "sac-auto", 9, "quick", runs=tmp_path / "source", **settings)
    assert source.evaluations["mean_return"].max() > -300

    def early_return(name: str, seed: int, **changes) -> float:
        """The mean over the evaluations of the first half."""
        run = saclab.train("Pendulum-v1", "sac-auto", seed, "quick", runs=tmp_path, name=name, **settings | changes)
        return float(run.evaluations["mean_return"][run.evaluations["steps"] <= 3000].mean())

    for seed in (0, 1):
        plain = early_return("plain", seed)
        filled = early_return("filled", seed, prefill=f"replay:{source.path}", random_steps=0)
        print(f"seed {seed}: {plain:.0f}, {filled:.0f} with the replay of a trained run")
        assert filled > plain
