"""The panels of the page for reward terms: what each brings, and how a schedule weighs it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from saclab.errors import UserError
from saclab.report.curves import diagnostics, gather_curves
from saclab.report.report import compared, page_of
from saclab.report.runs import read_comparison
from saclab.report.train_command import train_command
from saclab.sharing.share import copy_results
from saclab.training.logs import reward_term_columns
from saclab.training.run_folder import read_run

from .synthetic import write_run

TERMS = ("reward_linvel", "reward_quadctrl", "reward_alive")
PANELS = ["return of reward_linvel", "return of reward_quadctrl", "return of reward_alive", "weight of reward_linvel"]


def write_terms(folder: Path, count: int = 30, terms: tuple[str, ...] = TERMS) -> Path:
    """Three terms of which the remainder is nothing but rounding, and a weight that rises."""
    with (folder / "reward_terms.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(reward_term_columns(terms))
        for index in range(1, count + 1):
            counters = [index, 10_000 * index, 2000 * index, 10 * index]
            writer.writerow([*counters, 100.0 * index, -3.0, 500.0, 1e-13, min(1, index / 20), 1.0, 1.0, 20.0 * index])
    return folder


@pytest.fixture
def folders(tmp_path):
    """A curriculum of two seeds, and plain runs that have no terms."""
    scheduled = [write_terms(write_run(tmp_path, "curriculum", seed, "Humanoid-v4")) for seed in (0, 1)]
    return [*scheduled, *(write_run(tmp_path, "sac-auto", seed, "Humanoid-v4") for seed in (0, 1))]


def test_the_page_has_a_panel_for_each_term_and_each_weight_but_one(folders):
    page = page_of(compared(folders))
    data = json.loads(page.partition('<script type="application/json" id="data">')[2].partition("</script>")[0])
    panels = {panel["title"]: panel for panel in data["environments"][0]["panels"]}
    assert [title for title in panels if " of reward" in title or "remainder" in title] == PANELS
    (arm,) = panels["weight of reward_linvel"]["arms"]
    assert len(arm["runs"]) == 2
    assert arm["middle"][9] == 0.5
    assert data["pool"][arm["x"]["updates"]][9] == 20_000


def test_terms_that_the_log_numbers_are_named_on_the_page(tmp_path):
    folders = []
    for first in ("vitesse é", "speed (m/s)"):
        terms = (first, "reward_quadctrl", "reward_alive")
        folder = write_run(tmp_path, "sac-auto", 0, "Humanoid-v4", overrides={"reward_terms": terms}, name=first[:5])
        folders.append(write_terms(folder, terms=terms))
    curves = gather_curves(read_comparison(folders, allow_mixed=True))
    arms = {quantity.title: [arm for _, arm, other in curves if other == quantity] for _, _, quantity in curves}
    assert not [title for title in arms if title.endswith(" of 0")]
    for kind in ("return", "weight"):
        (french,), (english,) = arms[f"{kind} of vitesse é"], arms[f"{kind} of speed (m/s)"]
        assert french != english
    assert len(arms["return of reward_alive"]) == 2


def test_runs_without_terms_have_no_such_panels(folders):
    curves = gather_curves(read_comparison(folders[2:]))
    assert not [quantity for quantity in diagnostics(curves, "Humanoid-v4") if quantity.table == "reward_terms"]


def test_the_terms_of_a_run_are_shared_with_it(folders, tmp_path):
    """A copy without them would not be read."""
    copy = tmp_path / "copy"
    copy.mkdir()
    copy_results(folders[0], read_run(folders[0]), copy)
    assert (copy / "reward_terms.csv").read_bytes() == (folders[0] / "reward_terms.csv").read_bytes()
    copy_results(folders[2], read_run(folders[2]), tmp_path)
    assert not (tmp_path / "reward_terms.csv").exists()


@pytest.mark.parametrize("line", ["31,310000,62000,310,1,2,3\n", "31,310000,62000,310,x,1,1,1,1,1,1,620\n"])
def test_a_damaged_log_of_terms_is_named(folders, line):
    path = folders[0] / "reward_terms.csv"
    path.write_text(path.read_text() + line)
    with pytest.raises(UserError, match=r"reward_terms\.csv is damaged \(line 32"):
        read_run(folders[0])


def test_a_row_that_was_given_a_schedule_is_trained_anew_with_it(tmp_path):
    schedule = ("reward_run: 0.5@0 1@1",)
    folder = write_run(tmp_path, "curriculum", overrides={"reward_schedule": schedule}, name="own")
    assert train_command(read_run(folder).config).endswith("--reward-schedule 'reward_run: 0.5@0 1@1'")
    assert read_comparison([folder]).arms[0].own_name == "own"
