"""How the pages of this folder, whose links work where the sources are read, become a site (mkdocs.yml).

A link that leaves this folder leads to a page of the site if its file is one, else to the file where the sources are
hosted (`repo_url`); if they are not, it becomes the file's path.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
ALSO = {
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "examples/halfcheetah/index.html": "examples/halfcheetah.html",
}
"""Files outside this folder that the site has -> their places there."""
CODE_OR_LINK = re.compile(
    r"^```.*?^```$ | (`+)[^`].*?\1 | (?<!!)\[(?P<text>[^][]+)\]\((?P<target>[^()\s]+)\)",
    re.DOTALL | re.MULTILINE | re.VERBOSE,
)


def on_files(files: Files, config: Any) -> Files:
    """Add the files of ALSO."""
    for path, place in ALSO.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn every link that leaves this folder."""
    places = {os.path.realpath(file.abs_src_path): file.src_uri for file in files if file.abs_src_path}

    def turned(found: re.Match[str]) -> str:
        text, target = found["text"], found["target"]
        if target is None or ":" in target or target.startswith("#"):
            return found[0]
        path, _, anchor = target.partition("#")
        file = os.path.realpath(Path(page.file.abs_src_path).parent / path)
        anchor = anchor and f"#{anchor}"
        if file in places:
            return f"[{text}]({os.path.relpath(places[file], Path(page.file.src_uri).parent)}{anchor})"
        return outside(text, os.path.relpath(file, ROOT), anchor, config.repo_url)

    return CODE_OR_LINK.sub(turned, markdown)


def outside(text: str, path: str, anchor: str, repository: str | None) -> str:
    """A link to a file that the site does not have."""
    if not (ROOT / path).exists():
        raise ValueError(f"there is no {path}")
    if repository:
        return f"[{text}]({repository.rstrip('/')}/blob/HEAD/{path}{anchor})"
    return f"`{path}`" if text.strip("`") in path else f"{text} (`{path}`)"
