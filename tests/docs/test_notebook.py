"""The notebook runs from its first cell to its last one, and its runs are what its words say."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import saclab

NOTEBOOK = Path(__file__).parents[2] / "examples" / "python" / "saclab.ipynb"


def value_of(cell: str, names: dict) -> object:
    """Run a cell; what its last line is worth, if it is an expression."""
    *body, last = ast.parse(cell).body
    if not isinstance(last, ast.Expr):
        body, last = [*body, last], None
    exec(compile(ast.Module(body, []), "cell", "exec"), names)
    return last and eval(compile(ast.Expression(last.value), "cell", "eval"), names)


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What each code cell shows."""
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    names: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("notebook"))
        return [value_of("".join(cell["source"]), names) for cell in cells]


def test_a_run_stopped_by_its_events_goes_on_to_its_end(told):
    _, stopped_at, (reason, updates), *_ = told
    assert stopped_at == 800
    assert "max_updates" in reason
    assert updates == 400


def test_a_tracker_of_ones_own_sees_every_line_of_the_log(told):
    assert told[3] == 400 / 50


def test_an_environment_of_ones_own_is_trained_on(told):
    returns, (discount, steps, shape) = told[4:]
    assert len(returns) == len(steps) > 1
    assert (returns < 0).all()
    assert discount == 0.99
    assert shape == (1,)


def test_the_notebook_holds_no_outputs():
    """They would be somebody's, and grow with every run."""
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


def test_every_public_name_is_there():
    assert set(saclab.__all__) == {name for names in saclab._HOMES.values() for name in names}
    for name in saclab.__all__:
        assert getattr(saclab, name).__name__ == name
    assert dir(saclab) == sorted(saclab.__all__)


def test_events_are_checked_at_once_and_free_the_run_when_closed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(saclab.UserError, match="unknown setting 'bogus'"):
        saclab.events("Pendulum-v1", bogus=1)
    small = {"protocol": "quick", "random_steps": 40, "batch_size": 8, "hidden_layers": (4,), "max_updates": 5}
    stream = saclab.events("Pendulum-v1", **small)
    assert isinstance(next(stream), saclab.Started)
    with pytest.raises(saclab.UserError, match="in use by this process: close the iterator of its events first"):
        saclab.train("Pendulum-v1", **small)
    stream.close()
    assert saclab.train("Pendulum-v1", **small).result["updates"] == 5
