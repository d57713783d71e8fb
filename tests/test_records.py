"""What is read from disk fits its schema or is told of, with the file, the place and the reason."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import numpy as np
import pytest

from saclab.files import write_json
from saclab.records import (
    EPISODES,
    EVALUATIONS,
    METRICS,
    Q_BIAS,
    Damaged,
    FileRecord,
    Missing,
    Result,
    csv_text,
    read_bytes,
    read_json,
    table_from_csv,
    table_from_json_lines,
)
from saclab.training.logs import evaluation_columns

LOG = Path("evaluations.csv")
HEAD = ",".join(evaluation_columns(2)) + "\n"
ROW = "1,1000,200,10,2.5,2,3,1000,1000,5.5\n"


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.mkdir(), "cannot be read"),
        (os.mkfifo, "no plain file"),
        (lambda path: path.symlink_to("/dev/zero"), "no plain file"),
        (lambda path: path.symlink_to(path), "cannot be read"),
        (lambda path: path.symlink_to("nowhere"), "missing"),
        (lambda path: path.touch() or os.truncate(path, 2**43), "bytes of memory are free"),
    ],
    ids=["folder", "pipe", "device", "link to itself", "dangling link", "larger than memory"],
)
def test_only_a_plain_file_is_read_and_nothing_hangs(tmp_path: Path, make, reason: str) -> None:
    make(tmp_path / "file")
    with pytest.raises(Damaged, match=reason) as error:
        read_bytes(tmp_path / "file")
    assert error.value.path == tmp_path / "file"
    assert isinstance(error.value, Missing) == (reason == "missing")


def test_a_record_comes_back_as_it_was_written(tmp_path: Path) -> None:
    result = Result("max_steps = 5", 5, 4, 3, -1.5, 2.5, 0.1, {"config.json": FileRecord(3, "0" * 64)})
    write_json(tmp_path / "result.json", result)
    assert read_json(tmp_path / "result.json", Result) == result
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "result.json", Result("", 5, 4, 3, float("nan"), 2.5, 0.1))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("[]", "Expected `object`, got `array`"),
        ('{"reason": 1}', r"Expected `str`, got `int` - at `\$\.reason`"),
        ('{"reason": "", "steps": -1}', r"`int` >= 0 - at `\$\.steps`"),
        ('{"reason": "", "steps": 1e999}', r"out of range - at `\$\.steps`"),
        ('{"files":' + '{"a":' * 100_000, "depth|Expected"),
        ("{", "truncated"),
    ],
)
def test_json_that_does_not_fit_is_told_with_its_place(tmp_path: Path, content: str, reason: str) -> None:
    (tmp_path / "result.json").write_text(content)
    with pytest.raises(Damaged, match=rf"result\.json is damaged \(.*{reason}"):
        read_json(tmp_path / "result.json", Result)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (HEAD + ROW + ROW.replace("2.5", "1e999"), r"line 3: Number out of range - at `\$\[4\]`"),
        (HEAD + ROW.replace("2.5", "nan"), r"line 2: Expected `float`, got `null`"),
        (HEAD + ROW.replace("2.5", "2_5"), "line 2"),
        (HEAD + ROW.replace("1000", "1000.5"), "line 2: Expected `int`, got `float`"),
        (HEAD + ROW.replace("1000", "-1000"), "line 2: Expected `int` >= 0"),
        (HEAD + ROW + "1,2\n", "line 3: Expected `array` of length 10"),
        (HEAD + "\n" + ROW, "line 2"),
        (HEAD + ROW.replace("2.5", "2" * 140_000), "line 2: Number out of range"),
        (HEAD + ROW.replace("2.5", "x" * 140_000), "line 2"),
        (HEAD.replace("length_1", "length_0") + ROW, "a column twice"),
        (HEAD.replace("updates", "update") + ROW, "no column 'updates'"),
        ("\xff\n", "no column 'evaluation'"),
    ],
)
def test_each_kind_of_damage_to_a_log_is_named(text: str, reason: str) -> None:
    with pytest.raises(Damaged, match=rf"evaluations\.csv is damaged \(.*{reason}"):
        table_from_csv(LOG, text.encode("latin-1"), EVALUATIONS)


def test_a_line_that_is_being_written_and_new_columns_are_no_damage() -> None:
    table = table_from_csv(LOG, (HEAD[:-1] + ",new\n" + ROW[:-1] + ",-7\n" + ROW[:5]).encode(), EVALUATIONS)
    assert table["mean_return"].tolist() == [2.5]
    assert table["new"].tolist() == [-7]
    assert table_from_csv(LOG, b"", EVALUATIONS) == {}


def test_a_bias_without_pairs_is_no_number_and_no_damage() -> None:
    text = ",".join(Q_BIAS) + "\n1,10,5,0,0,nan,nan,nan,nan,0.5\n"
    assert np.isnan(table_from_csv(Path("q_bias.csv"), text.encode(), Q_BIAS)["mean_bias"]).all()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[1]\n", "line 1: Expected `object`, got `array`"),
        ('{"updates": 1, "steps": 2, "seconds": 3, "q": NaN}\n', "line 1: JSON is malformed"),
        ('{"updates": 1, "steps": 2, "seconds": 3, "q": "4"}\n', "line 1: Expected `float`, got `str`"),
        ('{"updates": 1, "steps": 2, "seconds": 3}\n{"updates": 1, "steps": 2, "secs": 3}\n', "line 2 has other names"),
        ('{"updates": 1, "q": 2}\n', "it has no 'steps'"),
    ],
)
def test_each_kind_of_damage_to_the_metrics_is_named(text: str, reason: str) -> None:
    with pytest.raises(Damaged, match=rf"metrics\.jsonl is damaged \({reason}"):
        table_from_json_lines(Path("metrics.jsonl"), text.encode(), METRICS)


FORMULAS = ("=1+1", "=cmd|' /C calc'!A0", "+1", "-1+2", "@SUM(A1)", "\t=1", "\r=1", " =1", "＝1")


def test_no_text_reaches_a_spreadsheet_as_a_formula_and_numbers_stay() -> None:
    numbers = [-1.5, 2, 1e-30, -float("inf"), True, None]
    harmless = ["sac", "averaged-auto", "a=b", "10%", "it's", "a,b"]
    rows = list(csv.reader(csv_text([harmless, numbers]).splitlines()))
    assert rows == [harmless, ["-1.5", "2", "1e-30", "-inf", "True", ""]]
    back = list(csv.reader(io.StringIO(csv_text([[formula] for formula in FORMULAS]), newline="")))
    assert [cell for (cell,) in back] == ["'" + formula.replace("\r", " ") for formula in FORMULAS]


def test_the_schemas_of_logs_are_what_is_written() -> None:
    assert tuple(EPISODES)[:4] == ("episode", "steps", "updates", "return")
    assert set(EVALUATIONS) < set(evaluation_columns(3))
