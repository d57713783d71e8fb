"""The report as one HTML file that needs nothing else, offline or not.

Names and settings come from run folders and are not trusted. All text goes through `escape`, the script's data through
`script_safe`, and the page's content security policy lets no other script and no request through.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from saclab.records import Damaged, read_bytes
from saclab.report.arms import Arm, own_name
from saclab.report.curves import Curves
from saclab.report.page_data import page_data
from saclab.report.pairs import Pair
from saclab.report.paper import CURVE_ACCURACY, SOURCE
from saclab.report.runs import Comparison
from saclab.report.scores import AggregateScores, EnvironmentScores
from saclab.report.sentences import summary_sentences
from saclab.report.tables import (
    LEFT_OUT,
    Table,
    arms_table,
    differences_table,
    runs_table,
    scores_table,
    settings_table,
    versions_table,
)
from saclab.report.text import count_text, shown
from saclab.report.train_command import train_command
from saclab.training.run_folder import RunRecord

VIDEO_BYTES = 500_000
"""Larger videos are named, not embedded."""
ALL_VIDEO_BYTES = 1_100_000


def make_page(
    comparison: Comparison,
    scores: Sequence[EnvironmentScores],
    together: AggregateScores | None,
    curves: Curves,
    warnings: Sequence[str],
    version: str = "",
) -> str:
    """The whole page; one with a version is served, and may ask its server for a newer one."""
    style, script = read_data("report.css"), read_data("report.js")
    sections = [summary(comparison, scores, together)]
    sections += [environment_section(entry, number) for number, entry in enumerate(scores)]
    sections += [together_section(together), videos(comparison, scores), left_out(comparison)]
    sections += [settings(comparison, scores)]
    return Template(read_data("report.html")).substitute(
        version=version,
        connect="connect-src 'self'; " if version else "",
        style=style,
        script=script,
        style_hash=content_hash(style),
        script_hash=content_hash(script),
        data=page_data(comparison, scores, together, curves),
        lead=lead(comparison),
        warnings="".join(f'<p class="warning">{escape(warning)}.</p>' for warning in warnings),
        sections="\n".join(sections),
        commands=commands(comparison),
        paper_note=escape(f"{SOURCE}. Curves {CURVE_ACCURACY}."),
    )


def read_data(name: str) -> str:
    return (resources.files("saclab.report") / "data" / name).read_text(encoding="utf-8")


def content_hash(text: str) -> str:
    """A source in a content security policy that allows exactly this inline text."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def lead(comparison: Comparison) -> str:
    """What was compared, in one line."""
    protocols = ", ".join(sorted({shown(run.config.protocol) for run in comparison.runs}))
    unfinished = sum(run.result is None for run in comparison.runs)
    state = f", {unfinished} of them unfinished" if unfinished else ""
    arms = "arm" if any(arm.own_name for arm in comparison.arms) else "variant"
    return escape(
        f"{count_text(len(comparison.runs), 'run')}{state}: {count_text(len(comparison.arms), arms)}, "
        f"{count_text(len(comparison.environments), 'environment')}, protocol {protocols}."
    )


def summary(comparison: Comparison, scores: Sequence[EnvironmentScores], together: AggregateScores | None) -> str:
    """The answer first: sentences for each environment, and what the arms with a name of their own are."""
    parts = [
        f"<h3>{escape(title)}</h3>{bullets(sentences)}" for title, sentences in summary_sentences(scores, together)
    ]
    arms = arms_table(comparison)
    if arms.rows:
        parts.append(f"<h3>{escape(arms.title)}</h3>{table_html(arms, headed=True)}")
    return f'<section id="summary"><h2>Summary</h2>{"".join(parts)}</section>'


def bullets(sentences: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{unbroken(sentence)}</li>' for sentence in sentences)}</ul>"


def environment_section(entry: EnvironmentScores, number: int) -> str:
    """Table, curves, intervals, pairs and diagnostics of one environment; the script fills the empty elements."""
    name, table = escape(shown(entry.environment)), scores_table(entry)
    return f"""<section class="environment" id="environment-{number}">
<h2>{name}</h2>
{table_html(table if number == 0 else table._replace(note=""), headed=True)}
<h3>Learning curves</h3><div class="charts" data-environment="{number}" data-draw="curves"></div>
<h3>Scores with intervals</h3><div class="charts" data-environment="{number}" data-draw="intervals"></div>
{pairs_html(entry.pairs)}
{differences_html(entry)}
<h3>Share of runs above a score</h3><div class="charts" data-environment="{number}" data-draw="profile"></div>
<h3>Diagnostics</h3><div class="charts" data-environment="{number}" data-draw="diagnostics"></div>
</section>"""


def together_section(together: AggregateScores | None) -> str:
    if together is None:
        return ""
    return f"""<section id="together"><h2>All environments together</h2>
<p>Final evaluation returns, normalised by environment: 0 is the lowest and 1 the highest of any run there. Such numbers
hold within this report only. The probability of improvement is the mean over environments; the seeds told with it are
those of the environment with the fewest.</p>
<div class="charts" data-environment="together" data-draw="intervals"></div>
{pairs_html(together.pairs)}
<h3>Share of runs above a score</h3><div class="charts" data-environment="together" data-draw="profile"></div>
</section>"""


def table_html(table: Table, headed: bool = False) -> str:
    """A table; with `headed`, the first cell of each row names the row."""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.head)
    rows = []
    for row in table.rows:
        first = f'<th scope="row">{escape(row[0])}</th>' if headed else f"<td>{escape(row[0])}</td>"
        rest = "".join(f"<td>{unbroken(cell)}</td>" for cell in row[1:])
        rows.append(f"<tr>{first}{rest}</tr>")
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(table.title)}"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>{note}"
    )


def unbroken(text: str) -> str:
    """Escaped text whose intervals stay on one line."""
    return re.sub(r"\[[^\]]{1,40}\]", lambda found: found[0].replace(" ", "\u00a0"), escape(text))


def pairs_html(pairs: Sequence[Pair]) -> str:
    """The matrix of P(row ends higher than column), with what equal seeds say below each; where intervals exist."""
    pairs = [pair for pair in pairs if pair.improvement.exists]
    if not pairs:
        return ""
    arms = list(dict.fromkeys(arm for pair in pairs for arm in (pair.x, pair.y)))
    cells = {(pair.x, pair.y): pair_cell(pair, False) for pair in pairs}
    cells |= {(pair.y, pair.x): pair_cell(pair, True) for pair in pairs}
    rows = "".join(
        f'<tr><th scope="row">{escape(row.title)}</th>'
        + "".join(cells.get((row, column), "<td>–</td>") for column in arms)
        + "</tr>"
        for row in arms
    )
    head = "".join(f'<th scope="col">{escape(arm.title)}</th>' for arm in arms)
    few = f"{count_text(len(pairs), 'pair')}, not corrected for their number" if len(pairs) > 1 else "one pair"
    return f"""<h3>Probability that a run of the row ends higher than one of the column</h3>
<div class="scroll" tabindex="0" role="region" aria-label="Probability of improvement"><table class="matrix">
<thead><tr><td></td>{head}</tr></thead><tbody>{rows}</tbody></table></div>
<p class="note">By final evaluation return, with 95 % intervals; bold where the interval excludes ½ ({few}).</p>"""


def differences_html(entry: EnvironmentScores) -> str:
    table = differences_table(entry)
    return f"<h3>{escape(table.title)}</h3>{table_html(table, headed=True)}" if table.rows else ""


def pair_cell(pair: Pair, flipped: bool) -> str:
    """One cell of the matrix; its shade has ten steps, so that it needs no inline style."""
    p, low, high, runs_x, runs_y, paired = pair.improvement
    same_seed, same_low, same_high, count = paired
    if flipped:
        p, low, high, runs_x, runs_y = 1 - p, 1 - high, 1 - low, runs_y, runs_x
        same_seed, same_low, same_high = 1 - same_seed, 1 - same_high, 1 - same_low
    seeds = f"{runs_x} against {runs_y} seeds"
    if count:
        paired_bounds = f" [{same_low:.2f}, {same_high:.2f}]" if same_low == same_low else ", no interval"
        seeds += f"; equal seeds {same_seed:.2f}{paired_bounds}, {count_text(count, 'pair')}"
    style = f"shade-{min(9, int(10 * p))}{' clear' * pair.improvement.decided}"
    return f'<td class="{style}">{unbroken(f"{p:.2f} [{low:.2f}, {high:.2f}]")}<small>{unbroken(seeds)}</small></td>'


def videos(comparison: Comparison, scores: Sequence[EnvironmentScores]) -> str:
    """The best recorded policy of each arm in each environment, as long as the page stays small."""
    figures, spent = [], 0
    for entry in scores:
        for arm in comparison.arms_of(entry.environment):
            run = best_recorded(comparison.groups[entry.environment, arm])
            if run is None:
                continue
            content, size = None, run_video(run).stat().st_size
            if size <= VIDEO_BYTES and spent + size <= ALL_VIDEO_BYTES:
                with suppress(Damaged):
                    content = read_bytes(run_video(run))
            spent += len(content or b"")
            figures.append(video_html(entry.environment, arm, run, size, content))
    if not figures:
        return ""
    return f'<section id="videos"><h2>Best policies</h2><div class="charts">{"".join(figures)}</div></section>'


def best_recorded(runs: Sequence[RunRecord]) -> RunRecord | None:
    """The run with the highest evaluation return among those with a video."""
    recorded = [run for run in runs if os.path.isfile(run_video(run)) and best_return(run) is not None]
    return max(recorded, key=lambda run: best_return(run) or 0.0, default=None)


def run_video(run: RunRecord) -> Path:
    """Where `record` films the best policy; `os.path.isfile` takes a folder that may not be looked into for none."""
    return run.path / "best" / "video.mp4"


def best_return(run: RunRecord) -> float | None:
    returns = run.evaluations.get("mean_return", ())
    return float(max(returns)) if len(returns) else None


def video_html(environment: str, arm: Arm, run: RunRecord, size: int, content: bytes | None) -> str:
    caption = escape(
        f"{arm.title} on {shown(environment)}, seed {run.config.seed}: the policy with the best evaluation return, "
        f"{best_return(run):,.0f}"
    )
    if content is None:
        place = escape(shown("/".join(run.path.parts[-4:]), 200))
        too_large = f"Too large to embed ({size / 1e6:.1f} MB): {place}/best/video.mp4"
        return f"<figure><figcaption>{caption}. {too_large}</figcaption></figure>"
    return (
        f'<figure><video controls muted loop playsinline preload="metadata" aria-label="{caption}" '
        f'src="data:video/mp4;base64,{base64.b64encode(content).decode()}"></video><figcaption>{caption}.</figcaption></figure>'
    )


def settings(comparison: Comparison, scores: Sequence[EnvironmentScores]) -> str:
    tables = [runs_table(comparison, scores), settings_table(comparison), versions_table(comparison)]
    parts = [f"<details><summary>{escape(table.title)}</summary>{table_html(table)}</details>" for table in tables]
    return f'<section id="settings"><h2>Runs, settings and versions</h2>{"".join(parts)}</section>'


def left_out(comparison: Comparison) -> str:
    """The folders that are left out, each with its reason."""
    if not comparison.left_out:
        return ""
    return f'<section id="left-out"><h2>{LEFT_OUT}</h2>{bullets(comparison.left_out)}</section>'


def commands(comparison: Comparison) -> str:
    """One line for each run."""
    return escape("\n".join(shown(train_command(run.config, own_name(run)), 2000) for run in comparison.runs))
