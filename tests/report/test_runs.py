"""What may be averaged together, and what is refused by name."""

import pytest

from saclab.errors import UserError
from saclab.report.notices import all_notices, notices, scale_notice
from saclab.report.runs import read_comparison
from saclab.report.text import shown
from saclab.training.run_folder import read_run
from saclab.variants import VARIANTS, Variant

from .synthetic import write_run

SHORT = {"max_updates": 60_000}


def test_groups_by_environment_variant_and_seed(tmp_path):
    runs = [
        write_run(tmp_path, variant, seed, environment)
        for variant in ("averaged-auto", "sac") for seed in (2, 0) for environment in ("Humanoid-v4", "HalfCheetah-v4")
    ]  # fmt: skip
    comparison = read_comparison([*runs, runs[0]])
    assert comparison.environments == ("HalfCheetah-v4", "Humanoid-v4")
    assert [arm.name for arm in comparison.arms] == ["sac", "averaged-auto"]
    assert [arm.title for arm in comparison.arms] == ["SAC", "Averaged-SAC, learned α"]
    group = comparison.groups["Humanoid-v4", comparison.arms[0]]
    assert [run.config.seed for run in group] == [0, 2]
    assert comparison.mixed == ()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"overrides": {"max_updates": 5}}, "max_updates is 5 in .* and 1200000 in"),
        ({"overrides": {"update_interval": 1}}, "update-to-data ratio is 1.0 in .* and 0.2 in"),
        ({"overrides": {"polyak_rate": 0.01}}, "polyak_rate is 0.01 in .* and the variant's own 0.005 in"),
        ({"overrides": {"snapshots": 3}}, "snapshots is 3"),
        ({"versions": {"mujoco": "3.3.0"}}, "mujoco version is 3 in .* and 4 in"),
        ({"versions": {"gymnasium": "2.0.1"}}, "gymnasium version is 2 in .* and 1 in"),
        ({"rename": {"environment_arguments": {"a": 1}}}, "environment_arguments is {'a': 1}"),
        ({"protocol": "standard"}, "protocol is standard in .* and paper in"),
    ],
)
def test_refuses_what_differs_and_names_it(tmp_path, change, named):
    runs = [write_run(tmp_path, "sac", seed) for seed in (0, 1)]
    runs.append(write_run(tmp_path, "averaged", 0, **change))
    with pytest.raises(UserError, match=f"^not comparable: {named}") as refused:
        read_comparison(runs)
    assert str(runs[-1]) in str(refused.value)


def begun(root, place: str, digit: str, seed: int):
    """A run that began with a data set; `digit` is its content."""
    return write_run(
        root, seed=seed, overrides={"prefill": f"minari:/{place}"},
        prefill={"transitions": 500, "sha256": digit * 64},
    )  # fmt: skip


def test_runs_that_began_with_other_data_are_not_comparable(tmp_path):
    """It is the content that counts: a folder may have been copied to a machine where it lies elsewhere."""
    same = [begun(tmp_path, place, "a", seed) for seed, place in enumerate(("here", "there"))]
    assert len(read_comparison(same).runs) == 2
    other = begun(tmp_path, "here", "b", 2)
    with pytest.raises(UserError, match=r"prefill is 500 transitions, SHA-256 bbbbbbbbbbbbbbbb in .*SHA-256 aaaaaaa"):
        read_comparison([*same, other])
    with pytest.raises(UserError, match=r"prefill is .* and None in|prefill is None in"):
        read_comparison([write_run(tmp_path, seed=3), *same])
    labelled = read_comparison([write_run(tmp_path, seed=4), *same], allow_mixed=True)
    assert sorted(len(group) for group in labelled.groups.values()) == [1, 2]


def test_versions_that_do_not_change_the_task_are_no_reason(tmp_path):
    runs = [write_run(tmp_path, "sac", 0), write_run(tmp_path, "sac", 1, versions={"mujoco": "4.9.9", "jax": "9"})]
    assert len(read_comparison(runs).runs) == 2


def test_two_versions_of_one_environment_are_refused(tmp_path):
    runs = [write_run(tmp_path, environment=f"HalfCheetah-v{version}") for version in (4, 5)]
    with pytest.raises(UserError, match="HalfCheetah-v4 and HalfCheetah-v5 are different tasks"):
        read_comparison(runs)
    assert len(read_comparison(runs, allow_mixed=True).environments) == 2


def test_allowed_mixed_runs_stand_apart_and_are_labelled(tmp_path):
    runs = [write_run(tmp_path, "averaged", seed) for seed in (0, 1)]
    far = {"snapshot_interval": 200}
    runs += [write_run(tmp_path / "far", "averaged", seed, overrides=far) for seed in (0, 1)]
    comparison = read_comparison(runs, allow_mixed=True)
    assert [arm.name for arm in comparison.arms] == ["averaged", "averaged (snapshot_interval 200)"]
    assert [len(group) for group in comparison.groups.values()] == [2, 2]
    assert len(comparison.mixed) == 1
    assert "snapshot_interval is 200" in comparison.mixed[0]


@pytest.mark.parametrize("ends", [("a", "b"), (1.5, 1.25)])
def test_long_values_that_begin_alike_make_two_arms(tmp_path, ends):
    """Only their beginning is shown."""
    runs = [write_run(tmp_path, seed=0)]
    for seed, end in enumerate(ends, start=1):
        long = {"environment_arguments": {"a_rather_long_argument": 0.125, "the_other_one": end}}
        runs.append(write_run(tmp_path / str(seed), seed=seed, rename=long))
    arms = read_comparison(runs, allow_mixed=True).arms
    assert len(arms) == 3
    assert len({arm.name for arm in arms}) == 3
    assert all(len(arm.differs[0][1]) <= 30 for arm in arms[1:])


def test_same_seed_twice_names_both(tmp_path):
    runs = [write_run(tmp_path / root, "sac", 7) for root in ("one", "two")]
    for allow_mixed in (False, True):
        with pytest.raises(UserError, match="same seed 7") as refused:
            read_comparison(runs, allow_mixed, strict=True)
        assert all(str(run) in str(refused.value) for run in runs)
        (left_out,) = read_comparison(runs, allow_mixed).left_out
        assert all(str(run) in left_out for run in runs)


def test_unknown_variant_is_grouped_by_its_settings(tmp_path):
    runs = [write_run(tmp_path / str(seed), "sac", seed, rename={"variant": "mine"}) for seed in (0, 1)]
    runs.append(write_run(tmp_path, "sac", 0))
    assert [len(group) for group in read_comparison(runs).groups.values()] == [2, 1]
    runs.append(write_run(tmp_path, "averaged", 2, rename={"variant": "mine"}, name="sac"))
    with pytest.raises(UserError, match=r"snapshots is 10 in .* and 1 in"):
        read_comparison(runs)


def test_no_run_folder_and_no_run(tmp_path):
    with pytest.raises(UserError, match="not a run folder"):
        read_comparison([tmp_path])
    with pytest.raises(UserError, match="no run"):
        read_comparison([])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, None),
        ({"overrides": SHORT}, "scaled down: 60,000 of 1,200,000 updates of the paper protocol"),
        ({"overrides": {"max_steps": 60_000}}, "10,000 of 1,200,000 updates"),
        ({"overrides": {"max_episodes": 500}}, "at most 500 episodes"),
        ({"protocol": "quick"}, "quick protocol"),
        ({"protocol": "standard", "overrides": {"max_steps": 20_000}}, "10,000 of 990,000 updates"),
        ({"protocol": "standard"}, None),
        ({"rename": {"protocol": "unheard-of"}}, None),
    ],
)
def test_scaled_down_runs_are_noticed(tmp_path, options, said):
    notice = scale_notice(read_run(write_run(tmp_path, **options)))
    assert notice is None if said is None else said in notice


@pytest.mark.parametrize(
    ("row", "options", "said"),
    [
        ({"max_updates": 300_000}, {}, None),
        ({"max_updates": 300_000}, {"overrides": SHORT}, "60,000 of 300,000 updates of the paper protocol"),
        ({"updates_per_interval": 20}, {"protocol": "standard"}, None),
        ({"updates_per_interval": 20}, {"protocol": "standard", "overrides": {"max_steps": 110_000}},
         "2,000,000 of 19,800,000 updates"),
        ({"max_episodes": 500}, {}, None),
    ],
)  # fmt: skip
def test_what_is_full_for_a_variant_its_row_says(tmp_path, monkeypatch, row, options, said):
    monkeypatch.setitem(VARIANTS, "redq", Variant("REDQ", "", row))
    notice = scale_notice(read_run(write_run(tmp_path, "redq", **options)))
    assert notice is None if said is None else said in notice


def test_unfinished_and_untested_runs_are_noticed(tmp_path):
    runs = [write_run(tmp_path, "sac", 0), write_run(tmp_path, "sac", 1, finished=False, evaluations=0)]
    comparison = read_comparison(runs)
    assert notices(comparison.runs) == ("1 of 2 runs unfinished", "1 of 2 runs without an evaluation so far")
    more = read_comparison([*runs, write_run(tmp_path, environment="Humanoid-v4", overrides=SHORT)])
    assert "Humanoid-v4: Scaled down: 60,000 of 1,500,000 updates of the paper protocol" in all_notices(more)


def test_shown_text_is_one_printable_line():
    assert shown("a\nb\x00\u202e\ud800c") == "a b   c"
    assert len(shown("x" * 500)) == 80


def test_a_changed_environment_is_told_apart_from_the_papers(tmp_path):
    def told(environment: str, overrides: dict) -> bool:
        run = write_run(tmp_path / str(len(list(tmp_path.iterdir()))), environment=environment, overrides=overrides)
        return any("another task" in notice for notice in all_notices(read_comparison([run])))

    wrapped = {"wrappers": ["ClipReward"]}
    assert told("HalfCheetah-v4", wrapped)
    assert not told("HalfCheetah-v4", {})
    assert not told("Hopper-v4", wrapped), "the paper has no numbers of it"
