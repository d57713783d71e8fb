"""The pages of docs/: each in the site's navigation, no link that leads nowhere, and a site that needs nothing else."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from mkdocs.config import load_config
from mkdocs.structure.files import File, get_files
from mkdocs.structure.pages import Page
from mkdocs.utils.yaml import yaml_load
from pymdownx.slugs import slugify

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
import site_hooks  # noqa: E402

CONFIG = (ROOT / "mkdocs.yml").read_text()
PAGES = sorted(DOCS.rglob("*.md"))
READ = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *PAGES]
CODE = re.compile(r"^```.*?^```$|(`+)[^`].*?\1", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^()\s]+)\)")
BUILD = [sys.executable, "-m", "mkdocs", "build", "--strict"]  # not --quiet: it counts no warning
SAID_BY = {page: [text for text in page.read_text().splitlines() if text.startswith("::: ")] for page in PAGES}
"""Page -> what it takes from docstrings."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def in_navigation(entries: object) -> list[str]:
    if isinstance(entries, str):
        return [entries]
    parts = entries.values() if isinstance(entries, dict) else entries
    return [page for part in parts for page in in_navigation(part)]


def test_the_navigation_has_every_page_once():
    wanted = [page.relative_to(DOCS).as_posix() for page in PAGES]
    wanted += [place for place in site_hooks.ALSO.values() if place.endswith(".md")]
    assert sorted(in_navigation(yaml_load(CONFIG)["nav"])) == sorted(wanted)


def links_of(page: Path) -> list[str]:
    """Targets of the links and pictures of a page, without those into the net."""
    return [target for target in LINK.findall(CODE.sub("``", page.read_text())) if "://" not in target]


def anchors_of(page: Path) -> set[str]:
    """What a link to a heading of the page may end in, as GitHub and the site have it."""
    anchor = slugify(case="lower")
    headings = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S), re.M)
    return {anchor(re.sub(r"[`*]|\]\(.*?\)", "", heading), "-") for heading in headings}


@pytest.mark.parametrize("page", READ, ids=name_of)
def test_every_link_leads_to_a_file_and_its_heading(page):
    for target in links_of(page):
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), target
        assert not anchor or anchor in anchors_of(file), target


@pytest.mark.parametrize("page", READ, ids=name_of)
def test_a_list_begins_after_an_empty_line(page):
    """Where it does not, GitHub shows a list, and the site a paragraph."""
    lines = CODE.sub("``", page.read_text()).splitlines()
    for before, line in pairwise(lines):
        if re.match(r"(- |\d+\. )", line):
            assert not before or re.match(r"(- |\d+\. |  )", before), f"{before}\n{line}"


def turned(markdown: str, repo_url: str | None = None) -> str:
    """A page docs/variants/new.md as the site gets it."""
    config = load_config(str(ROOT / "mkdocs.yml"), repo_url=repo_url)
    page = Page(None, File("variants/new.md", str(DOCS), config.site_dir, False), config)
    files = config.plugins.on_files(get_files(config), config=config)
    return site_hooks.on_page_markdown(markdown, page, config, files)


def test_links_to_pages_of_the_site_stay_links():
    assert turned("[a](sac.md#equations), [b](../index.md)") == "[a](sac.md#equations), [b](../index.md)"
    assert turned("[what changed](../../CHANGELOG.md)") == "[what changed](../changes.md)"
    assert turned("[`map`](../../CONTRIBUTING.md#how-to-test)") == "[`map`](../contributing.md#how-to-test)"
    assert turned("[a](https://example.org/b), [c](#here)") == "[a](https://example.org/b), [c](#here)"


def test_links_to_other_files_lead_to_the_sources_or_become_paths():
    link, words = "[replay.py](../../src/saclab/replay.py)", "[the buffer](../../src/saclab/replay.py#L3)"
    assert turned(link) == "`src/saclab/replay.py`"
    assert turned(words) == "the buffer (`src/saclab/replay.py`)"
    there = "https://example.org/us/saclab/blob/HEAD/src/saclab/replay.py"
    assert (
        turned(f"{link} {words}", "https://example.org/us/saclab/") == f"[replay.py]({there}) [the buffer]({there}#L3)"
    )
    with pytest.raises(ValueError, match="there is no src/saclab/missing"):
        turned("[gone](../../src/saclab/missing.py)")


def test_code_is_left_as_it_is():
    for code in ("`x[0](../../src)`", "```python\nx[0](../../src)\n```", "``a`[b](../../src)``"):
        assert turned(code) == code


def build(config: str, out: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    command = [*BUILD, "--config-file", "-", "--site-dir", str(out)]
    return subprocess.run(command, cwd=ROOT, env=environment, input=config, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("site")
    done = build(CONFIG, out)
    assert done.returncode == 0, done.stderr
    return out


def test_the_site_loads_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        loaded = re.findall(r"<(?:script|img|iframe|source|video)\b[^>]*\bsrc=[\"']?((?:https?:)?//[^\"' >]+)", text)
        loaded += re.findall(r"<link\b[^>]*\bhref=[\"']?((?:https?:)?//[^\"' >]+)", text)
        assert loaded == [], page.name
    for style in site.rglob("*.css"):
        assert re.findall(r"(?:url\(|@import )[\"']?(?:https?:)?//[^\"')]+", style.read_text()) == [], style.name


def test_the_reference_tells_what_the_docstrings_do(site):
    reference = (site / "api.html").read_text()
    for name in (text.removeprefix("::: ") for text in SAID_BY[DOCS / "api.md"]):
        assert f'id="{name}"' in reference
    assert "Whether its mean is the run's best so far." in reference, "docstrings of fields"
    assert "UserError" in reference
    assert 'id="saclab.settings.AlgorithmSettings.discount"' in (site / "settings.html").read_text()


def test_the_reference_has_all_that_is_public():
    import saclab

    told = {text.removeprefix("::: saclab.") for text in SAID_BY[DOCS / "api.md"]}
    assert set(saclab.__all__) <= told


def test_a_page_that_is_not_in_the_navigation_is_an_error(tmp_path):
    without = re.sub(r"^.*protocols\.md\n", "", CONFIG, flags=re.MULTILINE)
    done = build(without, tmp_path)
    assert done.returncode != 0
    assert "protocols.md" in done.stderr
