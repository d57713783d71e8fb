"""Every variant has its page, and the page tells each setting of its row."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from saclab.variants import VARIANTS

PAGES = Path(__file__).parents[2] / "docs" / "variants"
ROWS = [line for line in (PAGES / "README.md").read_text().splitlines() if line.startswith("| `") and ".md)" in line]


def page_of(variant: str) -> str:
    (row,) = [row for row in ROWS if f"`{variant}`" in row.split("|")[1]]
    (name,) = re.findall(r"\]\((\w+\.md)\)", row)
    return (PAGES / name).read_text()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_page_tells_every_setting_of_its_variant(variant):
    page = page_of(variant)
    assert f"`{variant}`" in page
    assert "## What differs from the authors' code" in page
    row = VARIANTS[variant]
    for settings in (row.settings, *row.by_environment.values()):
        assert [name for name in settings if not re.search(rf"`{name}[ `]", page)] == []
