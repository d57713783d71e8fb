"""The report of a comparison: a page, figures, and tables for other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from saclab.errors import UserError
from saclab.files import replace_file
from saclab.report.curves import Curves, gather_curves
from saclab.report.figures import write_figures
from saclab.report.notices import all_notices
from saclab.report.page import make_page
from saclab.report.runs import Comparison, read_comparison
from saclab.report.scores import AggregateScores, EnvironmentScores, aggregate, score_environment
from saclab.report.sentences import summary_sentences
from saclab.report.tables import latex, markdown, scores_csv
from saclab.training.lock import alone_in


class Compared(NamedTuple):
    """What a report tells of."""

    comparison: Comparison
    scores: list[EnvironmentScores]
    together: AggregateScores | None
    curves: Curves
    warnings: list[str]


def compared(runs: Sequence[Path], allow_mixed: bool = False, strict: bool = False) -> Compared:
    """Compare runs; raises UserError if no folder can be read or they are not comparable."""
    comparison = read_comparison(runs, allow_mixed, strict)
    scores = [score_environment(comparison, environment) for environment in comparison.environments]
    warnings = [*all_notices(comparison), *(f"Mixed on request: {difference}" for difference in comparison.mixed)]
    return Compared(comparison, scores, aggregate(scores), gather_curves(comparison), warnings)


def page_of(found: Compared, version: str = "") -> str:
    """The page of a comparison; one with a version asks the server it came from for a newer one."""
    return make_page(*found, version)


def write_report(
    runs: Sequence[Path],
    out: Path,
    allow_mixed: bool = False,
    strict: bool = False,
    tell: Callable[[str], None] = lambda text: None,
) -> Path:
    """Compare runs and write index.html, report.md, scores.csv, table.tex and figures/*.png, *.svg into `out`.

    Runs may be unfinished, or have no evaluation yet; the report says so. Folders that cannot be read, and a run that
    is another one under another name, are left out and listed with their reasons.

    Args:
        runs: run folders.
        out: folder of the report; made if it is missing, files of an earlier report are replaced.
        allow_mixed: show runs that are not comparable side by side, in place of refusing.
        strict: refuse if a folder cannot be read, or holds another's run, in place of leaving it out.
        tell: takes a line for each folder that is left out, then the summary's sentences.

    Returns:
        The path of index.html, one self-contained page.

    Raises:
        UserError: if no folder can be read, for runs that are not comparable, for what `strict` refuses, or for a place
            that cannot be written to.
    """
    found = compared(runs, allow_mixed, strict)
    for reason in found.comparison.left_out:
        tell(f"left out: {reason}")
    texts = {
        "report.md": markdown(found.comparison, found.scores, found.warnings),
        "scores.csv": scores_csv(found.comparison, found.scores),
        "table.tex": latex(found.scores, found.warnings),
        "index.html": page_of(found),
    }
    try:
        with alone_in(out):
            write_figures(found.comparison, found.scores, found.together, found.curves, out / "figures")
            for name, text in texts.items():
                replace_file(out / name, text.encode())
    except OSError as error:
        raise UserError(
            f"cannot write the report to {out}: {error.strerror or error}; name another folder (--out; --report of "
            "saclab compare)"
        ) from error
    for title, sentences in summary_sentences(found.scores, found.together):
        for sentence in sentences:
            tell(f"{title}: {sentence}")
    return out / "index.html"
