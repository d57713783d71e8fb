"""Runs of one variant with other settings of the algorithm, under a name of their own, are an arm of the comparison."""

import csv

import pytest

from saclab.errors import UserError
from saclab.report import figures
from saclab.report.arms import own_name
from saclab.report.report import write_report
from saclab.report.runs import read_comparison
from saclab.report.scores import score_environment
from saclab.report.sentences import environment_sentences
from saclab.training.run_folder import read_run
from saclab.variants import VARIANTS, Variant

from .synthetic import write_run

SPACED = {"snapshot_interval": 200}
SEVEN = {
    "averaged": ("averaged", {}), "averaged-spacing-200": ("averaged", SPACED), "averaged-auto": ("averaged-auto", {}),
    "sac": ("sac", {}), "sac-lag": ("sac", {"polyak_rate": 0.0009}), "averaged-entropy": ("averaged-entropy", {}),
    "sac-auto": ("sac-auto", {}),
}  # fmt: skip


def spaced(root, seed=0, **more):
    return write_run(root, "averaged", seed, name="averaged-spacing-200", overrides=SPACED, **more)


def test_a_name_makes_other_settings_of_the_algorithm_an_arm(tmp_path):
    runs = [write_run(tmp_path, variant, seed) for variant in ("sac", "averaged") for seed in (0, 1)]
    runs += [spaced(tmp_path, seed) for seed in (0, 1)]
    comparison = read_comparison(runs)
    assert comparison.mixed == ()
    assert [arm.name for arm in comparison.arms] == ["sac", "averaged", "averaged-spacing-200"]
    assert [arm.settings_text for arm in comparison.arms] == ["", "", "snapshot_interval 200"]
    assert [arm.paper_name for arm in comparison.arms] == ["sac", "averaged-sac", None]
    assert [len(group) for group in comparison.groups.values()] == [2, 2, 2]


def test_named_arms_are_compared_without_any_other_run(tmp_path):
    runs = [spaced(tmp_path), write_run(tmp_path, "sac", name="sac-lag", overrides={"polyak_rate": 0.0009})]
    assert [arm.name for arm in read_comparison(runs).arms] == ["sac-lag", "averaged-spacing-200"]


def test_what_all_runs_have_been_given_is_no_setting_of_an_arm(tmp_path):
    small = {"batch_size": 16, "discount": 0.9}
    runs = [write_run(tmp_path, variant, overrides=small) for variant in ("sac", "averaged")]
    runs.append(write_run(tmp_path, "averaged", name="far", overrides=SPACED | small))
    runs.append(write_run(tmp_path, "averaged", name="large", overrides=small | {"batch_size": 256}))
    assert [arm.settings_text for arm in read_comparison(runs).arms] == [
        "", "", "snapshot_interval 200", "batch_size 256",
    ]  # fmt: skip


def test_without_a_name_they_are_refused_with_the_way_out(tmp_path):
    runs = [write_run(tmp_path, "averaged", 0), write_run(tmp_path / "other", "averaged", 1, overrides=SPACED)]
    with pytest.raises(
        UserError, match=r"snapshot_interval is 200 .*a name of their own \(--name\), report them apart"
    ):
        read_comparison(runs)


@pytest.mark.parametrize("overrides", [{"update_interval": 1}, {"max_updates": 5}, {"replay_capacity": 50_000}])
def test_a_name_does_not_excuse_another_training(tmp_path, overrides):
    runs = [write_run(tmp_path, "averaged"), write_run(tmp_path, "averaged", name="mine", overrides=overrides)]
    with pytest.raises(UserError, match=r"not comparable: (?!.*--name)"):
        read_comparison(runs)


@pytest.mark.parametrize("change", [{"versions": {"mujoco": "3.0"}}, {"protocol": "standard"}])
def test_a_name_does_not_excuse_another_simulator_or_protocol(tmp_path, change):
    with pytest.raises(UserError, match="not comparable"):
        read_comparison([write_run(tmp_path, "averaged"), write_run(tmp_path, "averaged", name="mine", **change)])


def test_one_name_has_the_same_settings_in_all_its_runs(tmp_path):
    runs = [spaced(tmp_path, 0), write_run(tmp_path, "averaged", 1, name="averaged-spacing-200")]
    with pytest.raises(UserError, match=r"snapshot_interval is 1 in .* and 200 in"):
        read_comparison(runs)
    elsewhere = write_run(tmp_path, "averaged", 0, "Humanoid-v4", name="averaged-spacing-200")
    with pytest.raises(UserError, match=r"snapshot_interval is 1 in .* and 200 in"):
        read_comparison([runs[0], elsewhere])


def test_one_name_is_one_arm_on_all_environments(tmp_path):
    runs = [write_run(tmp_path, "sac", 0, environment, name="sac-lag", overrides={"polyak_rate": 0.0009})
            for environment in ("HalfCheetah-v4", "Humanoid-v4")]  # fmt: skip
    (arm,) = read_comparison(runs).arms
    assert arm.settings_text == "polyak_rate 0.0009"


def test_the_same_run_under_two_names_counts_once(tmp_path):
    """In the arm that has more finished runs, then in that without a name of its own; no arm is torn in two."""
    again, run = write_run(tmp_path, "averaged", 3, name="again"), write_run(tmp_path, "averaged", 3)
    others = [write_run(tmp_path, "sac", seed, name="other") for seed in (0, 1)]
    fewer = [write_run(tmp_path, "sac", seed, finished=seed == 0) for seed in (0, 1)]
    comparison = read_comparison([again, run, *fewer, *others])
    assert {each.path for each in comparison.runs} == {run, *others}
    assert sorted(comparison.left_out) == sorted(
        f"{repeated} is the same experiment with the same seed as {kept}"
        for repeated, kept in ((again, run), *zip(fewer, others))
    )
    with pytest.raises(UserError, match="same experiment with the same seed 3"):
        read_comparison([again, run], strict=True)


def test_a_name_is_read_from_a_path_as_saclab_makes_it_only(tmp_path):
    run = spaced(tmp_path)
    assert own_name(read_run(run)) == "averaged-spacing-200"
    assert own_name(read_run(write_run(tmp_path, "averaged"))) is None
    moved = run.rename(tmp_path / "received")
    assert own_name(read_run(moved)) is None


def test_training_settings_of_a_variants_row_are_its_own(tmp_path, monkeypatch):
    monkeypatch.setitem(VARIANTS, "fast", Variant("Fast", "", {"updates_per_interval": 20, "batch_size": 32}))
    assert len(read_comparison([write_run(tmp_path, "sac"), write_run(tmp_path, "fast")]).arms) == 2
    slower = write_run(tmp_path / "slower", "fast", 1, overrides={"updates_per_interval": 10})
    with pytest.raises(UserError, match="update-to-data ratio is 2"):
        read_comparison([write_run(tmp_path / "a", "sac"), write_run(tmp_path / "a", "sac", 1), slower])


def test_a_row_set_back_to_the_protocol_is_no_plain_run(tmp_path, monkeypatch):
    """Where the user sets what the row changes to the protocol's value, the run is trained in another way."""
    monkeypatch.setitem(VARIANTS, "fast", Variant("Fast", "", {"updates_per_interval": 20}))
    fast, sac = write_run(tmp_path, "fast"), write_run(tmp_path, "sac")
    back = write_run(tmp_path, "fast", 1, overrides={"updates_per_interval": 1})
    with pytest.raises(UserError, match=r"update-to-data ratio is (0.2|4.0) in .* and (0.2|4.0) in"):
        read_comparison([fast, back])
    with pytest.raises(UserError, match=r"updates_per_interval is 1 in .*fast.* and the variant's own 1 in .*sac"):
        read_comparison([sac, back, write_run(tmp_path, "sac", 1)])
    arms = read_comparison([fast, back], allow_mixed=True).arms
    assert len(arms) == 2, "they are not averaged"
    given = {"update_interval": 2}
    both = [write_run(tmp_path / "given", variant, overrides=given) for variant in ("sac", "fast")]
    assert len(read_comparison(both).arms) == 2, "what all have been given leaves the row its own"


@pytest.fixture
def seven(tmp_path):
    """Seven arms with five seeds each, two of them under names of their own, on the path of the averaging study."""
    return [
        write_run(tmp_path, variant, seed, name=name, overrides=overrides, evaluations=50, q_bias=True,
                  level=8000 + 150 * index + 40 * seed)
        for index, (name, (variant, overrides)) in enumerate(SEVEN.items()) for seed in range(5)
    ]  # fmt: skip


@pytest.mark.slow
def test_the_report_of_seven_arms_is_small_and_names_them(seven, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DOTS_PER_INCH", 40)
    out = write_report(seven, tmp_path / "out").parent
    page = (out / "index.html").read_text()
    assert len(page) < 3e6
    for text in (page, (out / "report.md").read_text().replace("\\_", "_")):
        assert text.count("snapshot_interval 200") == 1, "what an arm is stands there once"
        assert text.count("polyak_rate 0.0009") == 1
    assert "--name averaged-spacing-200" in page, "its command puts it where it was"
    assert "35 runs: 7 arms" in page
    rows = list(csv.DictReader((out / "scores.csv").open()))
    assert {row["name"] for row in rows} == set(SEVEN)
    assert {row["differs"] for row in rows if row["name"] == "sac-lag"} == {"polyak_rate 0.0009"}


def test_many_arms_are_ranked_and_each_winner_takes_one_sentence(seven):
    entry = score_environment(read_comparison(seven), "HalfCheetah-v4")
    assert len(entry.pairs) == 21
    *verdicts, undecided, levels = environment_sentences(entry)
    count = sum(not pair.improvement.decided for pair in entry.pairs)
    decided = [pair for pair in entry.pairs if pair.improvement.decided]
    assert len(decided) == 21 - count > len(verdicts) > 0
    beaten = {
        verdict.partition(" beats ")[0]: verdict.partition(" beats ")[2].partition(":")[0].split(", ")
        for verdict in verdicts
    }
    assert len(beaten) == len(verdicts)
    assert sum(map(len, beaten.values())) == len(decided)
    for pair in decided:  # by the returns, the later an arm stands the better it is
        worse, better = sorted((pair.x.name, pair.y.name), key=list(SEVEN).index)
        assert worse in beaten[better]
    assert undecided.startswith(
        f"{count} of the 21 pairs cannot be told apart with these seeds; the nearest to a verdict is "
    )
    best = max(entry.arms, key=lambda arm: arm.final.estimate).arm.name
    assert levels.startswith(f"Final evaluation return (highest first): {best} ")


def test_a_setting_that_another_row_has_already_is_given_to_both(tmp_path):
    """As sac-auto whose terms are logged beside the curriculum, which names them itself."""
    terms = {"reward_terms": ("reward_linvel", "reward_quadctrl", "reward_alive")}
    plain = write_run(tmp_path, "sac-auto", environment="Humanoid-v4", overrides=terms)
    other = write_run(tmp_path, "curriculum", environment="Humanoid-v4")
    assert [arm.name for arm in read_comparison([plain, other]).arms] == ["sac-auto", "curriculum"]
    third = write_run(tmp_path, "sac", environment="Humanoid-v4")
    with pytest.raises(UserError, match="reward_terms is"):
        read_comparison([plain, other, third])
