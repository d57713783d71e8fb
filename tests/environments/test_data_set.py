"""A data set of Minari's, recorded by its own collector, as transitions: numbers by hand, and what is refused."""

from __future__ import annotations

import json
from contextlib import closing

import gymnasium
import h5py
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from saclab.environments.checked import CheckedEnvironment
from saclab.environments.data_set import read_data_set
from saclab.errors import SettingError

from .recorded import by_hand, record

PENDULUM = "pendulum/random-v0"


@pytest.fixture(scope="module", autouse=True)
def shelf(tmp_path_factory):
    """Where this module's data sets lie."""
    folder = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        record(PENDULUM, gymnasium.make("Pendulum-v1"), 300)
        yield folder


def read(name: str, environment: str = "Pendulum-v1", most: int = 10_000, arguments=None, wrappers=()):
    with closing(CheckedEnvironment(environment, arguments, wrappers=wrappers)) as made:
        return read_data_set(name, made, most)


def spoil(folder, episode: int, field: str, change) -> None:
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        values = file[f"episode_{episode}"][field]
        values[...] = change(values[()])


def test_transitions_are_those_of_the_episodes():
    """Of the 300 steps, 200 end at a time limit and 100 are an episode that was left."""
    import minari

    found = read(PENDULUM)
    expected = by_hand(minari.load_dataset(PENDULUM))
    ours = found.transitions
    assert found.total == len(expected) == len(ours.terminated) == 300
    for step, (observation, action, reward, following, terminated) in enumerate(expected):
        np.testing.assert_array_equal(ours.observation[step], observation)
        np.testing.assert_allclose(ours.action[step], action / 2, rtol=1e-6)  # Pendulum's torque lies in [-2, 2]
        np.testing.assert_array_equal(ours.reward_terms[step], [np.float32(reward)])
        np.testing.assert_array_equal(ours.next_observation[step], following)
        assert ours.terminated[step] == terminated == False  # noqa: E712
    goes_on = (ours.observation[1:] == ours.next_observation[:-1]).all(axis=1)
    assert np.flatnonzero(~goes_on).tolist() == [199]
    assert np.abs(ours.action).max() > 0.9
    assert all(part.dtype == np.float32 for part in ours[:4])
    assert found.notes == []


def test_the_newest_are_taken_of_more_than_are_wanted():
    whole, found = read(PENDULUM), read(PENDULUM, most=150)
    assert found.total == 300
    for part, newest in zip(whole.transitions, found.transitions, strict=True):
        np.testing.assert_array_equal(part[-150:], newest)


def test_a_terminal_state_is_one_and_a_time_limit_is_none():
    arguments = {"terminate_at": 3}
    environment = gymnasium.make("environments.tiny:Counting-v0", **arguments)
    record("tiny/ends-v0", environment, 7)
    record("tiny/limits-v0", gymnasium.make("environments.tiny:Counting-v0"), 7)
    ends = read("tiny/ends-v0", "environments.tiny:Counting-v0", arguments=arguments).transitions
    limits = read("tiny/limits-v0", "environments.tiny:Counting-v0").transitions
    assert ends.terminated.tolist() == [False, False, True, False, False, True, False]
    assert ends.next_observation[:, 1].tolist() == [1, 2, 3, 1, 2, 3, 1]
    assert limits.terminated.tolist() == [False] * 7
    assert limits.next_observation[:, 1].tolist() == [1, 2, 3, 4, 5, 1, 2]


def test_a_data_set_may_be_given_by_its_path(shelf):
    assert read(str(shelf / PENDULUM)).total == 300


class Parts(gymnasium.Env):
    """Observes two named parts, in an order that is not the alphabet's."""

    def __init__(self, render_mode: str | None = None) -> None:
        self.observation_space = Dict([("speed", Box(-9, 9, (1,))), ("image", Box(-9, 9, (2, 2)))])
        self.action_space = Box(-1, 1, (1, 2))

    def observe(self) -> dict[str, np.ndarray]:
        image = np.full((2, 2), self.count, np.float32)
        return {"speed": np.full(1, -self.count, np.float32), "image": image}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.observe(), {}

    def step(self, action):
        self.count += 1
        return self.observe(), 0.0, False, False, {}


gymnasium.register("Parts-v0", Parts, max_episode_steps=3)


@pytest.mark.parametrize("inside", [(), ("FlattenObservation", "FlattenAction")])
def test_named_parts_are_flattened_as_the_wrapper_does_it(inside):
    """Whether they were recorded as they are, or flattened."""
    wrappers = ("FlattenObservation", "FlattenAction")
    with closing(CheckedEnvironment("Parts-v0", wrappers=wrappers)) as flat:
        made = flat.environment if inside else gymnasium.make("Parts-v0", disable_env_checker=True)
        name = f"parts/recorded-{len(inside)}-v0"
        record(name, made, 4)
        found = read(name, "Parts-v0", wrappers=wrappers).transitions
        np.testing.assert_array_equal(found.observation[0], flat.reset(seed=0))
        np.testing.assert_array_equal(found.next_observation[0], flat.step(np.zeros(2, np.float32))[0])
        assert found.next_observation[:, 0].tolist() == [-1, -2, -3, -1]
        assert found.action.shape == (4, 2)


def test_actions_outside_the_bounds_are_clipped_and_told_of(shelf):
    record("pendulum/loose-v0", gymnasium.make("Pendulum-v1"), 5)
    spoil(shelf / "pendulum/loose-v0", 0, "actions", lambda _: np.arange(5.0)[:, None] - 2.5)
    found = read("pendulum/loose-v0")
    np.testing.assert_allclose(found.transitions.action[:, 0], [-1, -0.75, -0.25, 0.25, 0.75])
    assert found.notes == [
        "1 action(s) of the data set pendulum/loose-v0 lay outside the bounds of Pendulum-v1, and were clipped to them"
    ]


def test_actions_on_another_scale_are_refused_with_both_bounds():
    """Read for Pendulum-v1, whose torque lies in [-2, 2], each of these would do half of what it did."""
    scaled = gymnasium.wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), np.float32(-1), np.float32(1))
    record("pendulum/scaled-v0", scaled, 5)
    with pytest.raises(SettingError, match=r"lie between \[-1.\] and \[1.\], and those of Pendulum-v1 between \[-2.\] "
                       r"and \[2.\]: record it anew"):  # fmt: skip
        read("pendulum/scaled-v0")


@pytest.mark.parametrize("where", ["minari.MinariDataset.iterate_episodes", "numpy.concatenate"])
def test_too_little_memory_is_told_with_the_way_out(monkeypatch, where):
    """Whether it ends while episodes are read, or when they are joined."""

    def exhausted(*_):
        raise MemoryError

    monkeypatch.setattr(where, exhausted)
    with pytest.raises(SettingError, match="take fewer, with --prefill-transitions"):
        read(PENDULUM)


gymnasium.register("PendulumTwin-v0", "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=200)


def test_another_environment_of_the_same_spaces_is_told_of():
    found = read(PENDULUM, "PendulumTwin-v0")
    assert "is one of Pendulum-v1, and this run's is PendulumTwin-v0" in found.notes[0]


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ("MountainCarContinuous-v0", r"its observation space is Box\(.*\(3,\).*that of Mount.* is Box\(.*\(2,\)"),
        ("Hopper-v5", r"its observation space is Box\(.*\(3,\).*that of Hopper-v5 is Box\(.*\(11,\)"),
    ],
)
def test_other_spaces_are_refused_with_both(environment, said):
    with pytest.raises(SettingError, match=said):
        read(PENDULUM, environment)


def test_discrete_actions_are_refused():
    record("pole/random-v0", gymnasium.make("CartPole-v1"), 5)
    with pytest.raises(SettingError, match=r"its action space is Discrete\(2\), and that of Pendulum-v1 is Box"):
        read("pole/random-v0")


@pytest.mark.parametrize(
    ("field", "place", "said"),
    [
        ("rewards", 17, "the reward number 17 of episode 1 is not finite"),
        ("observations", (9, 1), "the observation number 9 of episode 1 is not finite"),
        ("actions", 4, "the action number 4 of episode 1 is not finite"),
    ],
)
def test_what_is_not_finite_is_refused_with_its_place(shelf, field, place, said):
    name = f"pendulum/broken-{field}-v0"
    record(name, gymnasium.make("Pendulum-v1"), 230)

    def broken(values):
        values[place] = np.nan
        return values

    spoil(shelf / name, 1, field, broken)
    with pytest.raises(SettingError, match=said):
        read(name)


def test_a_data_set_that_is_not_there_is_refused_with_the_place():
    with pytest.raises(SettingError, match=r"no data set in .*nosuch/one-v0: fetch it with minari download nosuch/one"):
        read("nosuch/one-v0")


@pytest.mark.parametrize("damage", ["metadata", "data"])
def test_a_damaged_data_set_is_refused(shelf, damage):
    name = f"pendulum/damaged-{damage}-v0"
    record(name, gymnasium.make("Pendulum-v1"), 10)
    path = shelf / name / "data" / ("metadata.json" if damage == "metadata" else "main_data.hdf5")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SettingError, match=f"prefill = 'minari:{name}': Minari cannot read it"):
        read(name)


def test_no_environment_is_made_to_learn_the_spaces(shelf, tmp_path, monkeypatch):
    """Minari would import what the metadata name."""
    record("pendulum/spaceless-v0", gymnasium.make("Pendulum-v1"), 5)
    path = shelf / "pendulum" / "spaceless-v0" / "data" / "metadata.json"
    told = json.loads(path.read_text())
    del told["observation_space"]
    told["env_spec"] = told["env_spec"].replace("gymnasium.envs.classic_control.pendulum", "hostile")
    path.write_text(json.dumps(told))
    (tmp_path / "hostile.py").write_text("raise SystemExit('it was imported')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SettingError, match="its metadata do not tell its observation_space"):
        read("pendulum/spaceless-v0")
