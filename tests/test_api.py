"""What the functions of `saclab.api` share is the same in each; what they refuse at once.

A signature and a docstring that are read by type checkers, editors and `help` alike have to be written out; this holds
them together.
"""

from __future__ import annotations

import inspect
import re

import pytest

from saclab import api
from saclab.errors import UserError


def arguments_of(function) -> dict[str, tuple[object, object, str]]:
    """Name -> annotation, default, and what the docstring says of it."""
    told = inspect.cleandoc(function.__doc__).partition("Args:\n")[2].partition("\n\n")[0]
    entries = dict(re.findall(r"^    (\w+|\*\*\w+): (.*(?:\n {8}.*)*)", told, re.MULTILINE))
    return {
        name: (each.annotation, repr(each.default).partition(" at 0x")[0], entries[str(each).partition(":")[0]])
        for name, each in inspect.signature(function).parameters.items()
    }


@pytest.mark.parametrize(("other", "own"), [(api.events, {"on_event", "requests"}), (api.resume, None)])
def test_what_others_share_with_train_is_the_same(other, own):
    ones, others = arguments_of(api.train), arguments_of(other)
    shared = ones.keys() & others.keys()
    assert len(shared) >= 2
    assert {name: ones[name] for name in shared} == {name: others[name] for name in shared}
    if own:
        assert ones.keys() ^ others.keys() == own


def test_two_versions_of_an_environment_are_refused_at_once(tmp_path):
    with pytest.raises(UserError, match="Hopper-v4 and Hopper-v5 are different tasks: compare them apart"):
        api.compare(["Hopper-v4", "Hopper-v5"], ["sac"], 1, "quick", runs=tmp_path)
    assert not list(tmp_path.iterdir())
