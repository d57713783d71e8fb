"""Every promise of docs/edges.md names a test, and the test is there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "edges.md").read_text()


def test_every_promise_names_a_test_that_exists():
    rows = [line for line in TEXT.splitlines() if line.startswith("| ") and not line.startswith("| edge")]
    assert len(rows) > 60
    for row in rows:
        named = re.findall(r"(tests/\S+\.py)::(\w+)", row)
        assert named, row
        for path, name in named:
            before, found, _ = (ROOT / path).read_text().partition(f"def {name}(")
            assert found, f"{path}::{name}"
            slow = "@pytest.mark.slow\n" in before.rpartition("\n\n\n")[2]
            assert slow <= ("slow" in row.rpartition("::")[2]), f"{name} is slow"


def test_every_fuzzer_is_in_the_table():
    for path in (ROOT / "tests" / "fuzz").glob("test_*.py"):
        assert f"tests/fuzz/{path.name}::" in TEXT, path.name
