"""Several values of some settings: every combination an arm with a name of its own."""

from __future__ import annotations

import pytest

from saclab.config import group_key
from saclab.errors import UserError
from saclab.grid.plan import make_grid
from saclab.grid.sweep import parse_sweep, swept_arms
from saclab.report.arms import own_name
from saclab.training.run_folder import RunRecord


def test_the_words_of_a_line_are_values_of_the_settings_types():
    assert parse_sweep(
        [
            "polyak_rate=0.001,5e-3",
            "snapshots=1, 10",
            "hidden-layers=256 256,64",
            "target_entropy=none,-3",
            "network=mlp",
            "reward_scaling=none,deviation",
        ]
    ) == {
        "polyak_rate": (0.001, 0.005),
        "snapshots": (1, 10),
        "hidden_layers": ((256, 256), (64,)),
        "target_entropy": (None, -3.0),
        "network": ("mlp",),
        "reward_scaling": ("none", "deviation"),
    }


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["polyak_rate"], "sweep = 'polyak_rate': write a setting and its values: polyak_rate=0.001,0.005"),
        (["polyak_rate="], "write a setting and its values"),
        (["polyak_rate=0.1,"], "sweep = 'polyak_rate': a value is missing"),
        (["polyak_rat=1"], "unknown setting 'polyak_rat': did you mean 'polyak_rate'"),
        (["polyak_rate=fast"], "sweep = 'polyak_rate=fast': Expected `float`"),
        (["snapshots=1.5"], "sweep = 'snapshots=1.5': Expected `int`"),
        (["polyak_rate=0.1", "polyak-rate=0.2"], "polyak_rate is swept already: give all its values at once"),
        (["random_steps=1,2"], "sweep = 'random_steps': it is a setting of the training"),
    ],
)
def test_what_cannot_be_swept_is_refused_with_what_would_work(texts, message):
    with pytest.raises(UserError, match=message):
        parse_sweep(texts)


def test_every_combination_is_an_arm_and_values_given_twice_are_one():
    arms = list(swept_arms({"snapshots": [1, 10, 1], "hidden_layers": [[8, 8], [4]]}))
    assert [arm.suffix for arm in arms] == [
        "-snapshots-1-hidden_layers-8x8", "-snapshots-1-hidden_layers-4",
        "-snapshots-10-hidden_layers-8x8", "-snapshots-10-hidden_layers-4",
    ]  # fmt: skip
    assert arms[0].settings == {"snapshots": 1, "hidden_layers": (8, 8)}
    assert [arm.suffix for arm in swept_arms({})] == [""]


def test_a_grid_has_each_arm_of_each_variant_under_its_name(tmp_path):
    sweep = {"polyak_rate": (0.001, 0.05), "snapshots": (2, 4)}
    cells = make_grid(["Pendulum-v1"], ["sac", "sac-auto"], "quick", 2, tmp_path, sweep=sweep)
    assert len(cells) == 2 * 2 * 4
    assert len({cell.folder for cell in cells}) == len(cells)
    first = cells[1]
    assert first.folder.relative_to(tmp_path).parts[1] == "sac-polyak_rate-0.001-snapshots-4"
    assert (first.config.variant, first.config.algorithm.polyak_rate, first.config.algorithm.snapshots) == (
        "sac", 0.001, 4,
    )  # fmt: skip
    assert {cell.config.seed for cell in cells[:8]} == {0}, "a seed is whole before the next"
    assert own_name(RunRecord(first.folder, first.config, *[None] * (len(RunRecord._fields) - 2))) is not None
    one = [cell for cell in cells if cell.config.algorithm.snapshots == 2]
    assert len({group_key(cell.config) for cell in one}) == 1, "runs that differ in plain numbers are one program"
    assert len({group_key(cell.config) for cell in cells}) == 2


def test_a_value_that_cannot_be_is_refused_before_anything_starts(tmp_path):
    with pytest.raises(UserError, match="polyak_rate = 2"):
        make_grid(["Pendulum-v1"], ["sac"], "quick", 1, tmp_path, sweep={"polyak_rate": [0.1, 2]})
    with pytest.raises(UserError, match=r"polyak_rate.*give a list of values"):
        make_grid(["Pendulum-v1"], ["sac"], "quick", 1, tmp_path, sweep={"polyak_rate": []})
    with pytest.raises(UserError, match="sweep = 'snapshots': it is given for all runs as well"):
        make_grid(["Pendulum-v1"], ["sac"], "quick", 1, tmp_path, None, {"snapshots": 3}, sweep={"snapshots": [1]})


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        ({"snapshots": 10}, "sweep = 'snapshots: 10': give a list of values"),
        ({"network": "mlp"}, "give a list of values"),
        ({"hidden_layers": (256, 256)}, "sweep = 'hidden_layers: .256, 256.': Expected `array`"),
        ({"polyak_rate": ["0.1"]}, "Expected `float`, got `str`"),
    ],
)
def test_values_from_python_are_of_the_settings_types_too(sweep, message):
    with pytest.raises(UserError, match=message):
        list(swept_arms(sweep))


def test_an_arm_has_one_name_however_its_value_was_written(tmp_path):
    (whole,), (text,) = swept_arms({"initial_temperature": [1]}), swept_arms(parse_sweep(["initial_temperature=1.0"]))
    assert whole == text


def test_the_arm_of_the_variants_own_values_is_the_variant(tmp_path):
    cells = make_grid(["Pendulum-v1"], ["sac"], "quick", 1, tmp_path, sweep={"polyak_rate": (0.005, 0.05)})
    assert [cell.folder.parts[-3] for cell in cells] == ["sac", "sac-polyak_rate-0.05"]


def test_a_name_stands_in_the_place_of_the_variant(tmp_path):
    cells = make_grid(["Pendulum-v1"], ["sac"], "quick", 1, tmp_path, name="mine", sweep={"snapshots": (1, 2)})
    assert [cell.folder.parts[-3] for cell in cells] == ["mine", "mine-snapshots-2"]
