"""Folders that cannot be read are left out of a report and listed with their reasons; --strict refuses."""

from __future__ import annotations

import csv
import json
import os
import signal
from importlib.metadata import version
from pathlib import Path

import pytest

from saclab.api import compared
from saclab.cli.main import main
from saclab.errors import UserError
from saclab.grid.plan import Cell
from saclab.grid.tasks import make_statuses
from saclab.report.report import write_report
from saclab.report.runs import read_comparison
from saclab.training.run_folder import find_runs, read_config, read_run

from .synthetic import write_run

STORED = Path(__file__).parents[2] / "examples" / "averaging" / "runs" / "HalfCheetah-v4"


def test_the_scores_of_stored_runs_stay_what_they_were(tmp_path):
    """Three real runs of half a million steps. Who changes a score on purpose writes data/scores.csv anew."""
    runs = [STORED / arm / "paper" / "seed-0" for arm in ("sac", "averaged", "averaged-spacing-200")]
    write_report(runs, tmp_path)
    assert (tmp_path / "scores.csv").read_text() == (Path(__file__).parent / "data" / "scores.csv").read_text()


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """Two runs among folders that cannot be read, each in another way."""
    runs = [write_run(tmp_path / "runs", seed=seed, evaluations=3) for seed in range(5)]
    (tmp_path / "runs/bert").mkdir()
    (tmp_path / "runs/bert/config.json").write_text(json.dumps({"model_type": "bert"}))
    (tmp_path / "runs/folder/config.json").mkdir(parents=True)
    (tmp_path / "runs/pipe").mkdir()
    os.mkfifo(tmp_path / "runs/pipe/config.json")
    with (runs[2] / "evaluations.csv").open("a") as file:
        file.write("4,1,1,1,1e999," + ",".join(["1"] * 41) + "\n")
    (runs[3] / "metrics.jsonl").write_text("[1]\n")
    (runs[4] / "result.json").write_text("[]")
    return tmp_path / "runs"


REASONS = {
    "bert": "its config.json is not saclab's",
    "folder": "cannot be read (Is a directory)",
    "pipe": "it is no plain file",
    "seed-2": "line 5: Number out of range - at `$[4]`",
    "seed-3": "metrics.jsonl is damaged (line 1: Expected `object`, got `array`)",
    "seed-4": "result.json is damaged (Expected `object`, got `array`)",
}


@pytest.mark.parametrize(
    ("writer", "reason"),
    [
        (
            version("saclab"),
            r"config\.json is damaged \(unknown setting 'of_tomorrow'.*remove the folder and train again",
        ),
        (
            "99.0",
            r"config\.json does not fit this version of saclab \(.*'of_tomorrow'.*by saclab 99\.0, so read it with",
        ),
    ],
)
def test_a_setting_of_another_version_is_not_called_damage(tmp_path, writer: str, reason: str):
    path = write_run(tmp_path, seed=0, evaluations=3) / "config.json"
    description = json.loads(path.read_text())
    description["config"]["training"]["of_tomorrow"] = 1
    description["versions"]["saclab"] = writer
    path.write_text(json.dumps(description))
    with pytest.raises(UserError, match=reason):
        read_config(path.parent)


def test_one_bad_folder_does_not_stop_the_report(folders, tmp_path):
    lines: list[str] = []
    page = write_report(find_runs([folders]), tmp_path / "report", tell=lines.append)
    lines = [line for line in lines if line.startswith("left out: ")]
    assert len(lines) == len(REASONS)
    written = page.read_text(), (tmp_path / "report" / "report.md").read_text().replace("\\", "")
    for name, reason in REASONS.items():
        assert any(name in line and reason in line for line in lines), (name, lines)
        assert reason.replace("'", "&#x27;") in written[0]
        assert reason in written[1]
    for text in written:
        assert "6 folders left out; the report" in text
    with (tmp_path / "report" / "scores.csv").open() as file:
        assert [row["seed"] for row in csv.DictReader(file)] == ["0", "1"]


def test_strict_refuses_and_names_the_first(folders, tmp_path):
    with pytest.raises(UserError, match=r"6 of 8 folders cannot be read: .*\(and 5 more\)"):
        write_report(find_runs([folders]), tmp_path / "report", strict=True)
    assert not (tmp_path / "report").exists()


def test_the_command_lists_what_is_left_out_and_strict_exits_with_2(folders, tmp_path, capsys):
    def report(*arguments: str) -> tuple[int, str, str]:
        status = main(["report", str(folders / "bert"), *arguments])
        return status, *capsys.readouterr()

    status, told, errors = report(str(folders / "HalfCheetah-v4"), "--out", str(tmp_path / "report"))
    assert status == 0, errors
    assert told.count("left out: ") == 4
    status, _, errors = report(str(folders / "HalfCheetah-v4"), "--out", str(tmp_path / "report"), "--strict")
    assert (status, errors.count("\n")) == (2, 1)
    assert "4 of 6 folders cannot be read" in errors
    status, _, errors = report()
    assert (status, errors.count("\n")) == (2, 1)


def test_runs_that_do_not_compare_are_still_refused(folders, tmp_path):
    write_run(folders, "averaged", overrides={"replay_capacity": 300_000})
    with pytest.raises(UserError, match="not comparable"):
        read_comparison(find_runs([folders]))


def test_a_comparison_reports_what_it_can_read_and_calls_the_rest_failed(tmp_path):
    runs = [write_run(tmp_path, seed=seed, evaluations=2) for seed in (0, 1)]
    cells = [Cell(read_config(run), run) for run in runs]
    (runs[1] / "evaluations.csv").write_text("nothing\n")
    result = compared(make_statuses(cells), tmp_path / "report", 0)
    assert [run.path for run in result.runs] == runs[:1]
    assert "evaluations.csv is damaged" in result.failed[runs[1]]
    assert result.report is not None


def test_a_comparison_without_a_report_says_what_failed_all_the_same(tmp_path):
    """A worker that was told to stop from outside is no success."""
    cells = [Cell(read_config(run), run) for run in (write_run(tmp_path, seed=seed, evaluations=2) for seed in (0, 1))]
    statuses = make_statuses(cells)
    statuses[1].status = "interrupted"
    (tmp_path / "file").write_text("")
    result = compared(statuses, tmp_path / "file", 0)
    assert (len(result.runs), result.report) == (2, None)
    assert result.failed[tmp_path / "file"].startswith("no report: cannot write the report to ")
    assert "the same command goes on" in result.failed[cells[1].folder]
    assert compared(statuses, tmp_path / "report", signal.SIGINT).failed == {}


@pytest.mark.parametrize("place", ["file", "file/report", "/proc/none"])
def test_a_place_that_cannot_be_written_to_is_one_line(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write the report to .*name another folder"):
        write_report([write_run(tmp_path, evaluations=2)], tmp_path / place)


def test_a_formula_as_a_name_is_text_in_the_scores(tmp_path):
    formula = "=cmd|' /C calc'!A0"
    run = write_run(tmp_path, evaluations=2, rename={"environment": formula, "variant": "@SUM(A1)", "protocol": "-1+1"})
    write_report([run], tmp_path / "report")
    with (tmp_path / "report" / "scores.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["environment"], row["variant"], row["protocol"]) == ("'" + formula, "'@SUM(A1)", "'-1+1")
    assert float(row["final"]) == read_run(run).evaluations["mean_return"][-1]


DAMAGE = {
    "numbered 1, 2, 3": lambda rows: [*rows, rows[-1]],
    "its steps go back": lambda rows: [*rows[:-1], [rows[-1][0], "1", *rows[-1][2:]]],
    "not the mean of its episodes": lambda rows: [*rows[:-1], [*rows[-1][:4], "1e6", *rows[-1][5:]]],
    "its best mean_return is": lambda rows: rows[:-1],
    "there is no evaluation": lambda rows: rows[:1],
}


@pytest.mark.parametrize("reason", DAMAGE)
def test_evaluations_of_before_checksums_are_computed_again(tmp_path, reason):
    run = write_run(tmp_path, evaluations=4)
    rows = list(csv.reader((run / "evaluations.csv").read_text().splitlines()))
    (run / "evaluations.csv").write_text("".join(",".join(row) + "\n" for row in DAMAGE[reason](rows)))
    with pytest.raises(UserError, match=rf"evaluations\.csv is damaged \(.*{reason}"):
        read_run(run)


def test_a_place_that_is_not_there_is_not_passed_over(tmp_path: Path) -> None:
    """Beside others: alone it is an error."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.json").write_text("{}")
    assert find_runs([tmp_path / "run", tmp_path / "nowhere"]) == [tmp_path / "nowhere", tmp_path / "run"]
    with pytest.raises(UserError, match="nowhere"):
        find_runs([tmp_path / "nowhere"])
