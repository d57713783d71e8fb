"""The report's tables as plain text cells, and as Markdown, LaTeX and CSV. Escaping happens here, once per format."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from saclab.config import flatten
from saclab.records import csv_text
from saclab.report.pairs import MEASURES, PairScores
from saclab.report.paper import AVERAGED_CAVEAT, SOURCE
from saclab.report.runs import Comparison
from saclab.report.scores import EnvironmentScores
from saclab.report.sentences import environment_sentences
from saclab.report.statistics import Interval
from saclab.report.text import interval_text, number_text, shown

SCORES_NOTE = (
    "Interquartile means over seeds (means, if there are fewer than four) with 95 % bootstrap intervals in brackets. "
    "Final: mean over the last tenth of the evaluations. Best: a maximum over many noisy evaluations, which flatters; "
    "it is what the paper's Table 2 reports. Mean over training: area under the curve of evaluation returns, divided "
    "by its steps. Steps: median over seeds of the first evaluation that reaches the final level of the weakest."
)
DIFFERENCES_NOTE = (
    "Difference: mean over seeds of the first minus that of the second, with Welch's 95 % interval. P: probability "
    "that a run of the first scores above one of the second, with its 95 % interval. Neither is corrected for the "
    "number of pairs."
)
LEFT_OUT = "Left out"
CSV_COLUMNS = ("environment", "variant", "name", "differs", "protocol", "seed", "finished", "tests", "final", "best",
               "area", "steps_to_threshold", "threshold", "horizon_steps", "paper_best")  # fmt: skip


class Table(NamedTuple):
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def scores_table(entry: EnvironmentScores) -> Table:
    """Ours beside the paper's, one row for each arm."""
    head = ["variant", "seeds", "best evaluation return", "final evaluation return", "mean over training"]
    head += [f"steps to {number_text(entry.threshold)}"] if entry.threshold == entry.threshold else ["steps"]
    in_paper = any(arm.paper_best is not None for arm in entry.arms)
    if in_paper:
        head.insert(3, "paper, best (1 seed)")
    rows = []
    for scores in entry.arms:
        to_threshold = f"{interval_cell(scores.steps_to_threshold)}; {scores.reached} of {len(scores.runs)} runs"
        row = [scores.arm.title, str(len(scores.runs)), *map(interval_cell, (scores.best, scores.final, scores.area))]
        row.append(to_threshold if scores.runs else "no evaluation yet")
        if in_paper:
            row.insert(3, number_text(scores.paper_best) if scores.paper_best is not None else "not in it")
        rows.append(tuple(row))
    note = f"{SCORES_NOTE} Paper: {SOURCE}. {AVERAGED_CAVEAT}" if in_paper else SCORES_NOTE
    return Table(shown(entry.environment), tuple(head), tuple(rows), note)


def arms_table(comparison: Comparison) -> Table:
    """What stands behind the names that are no variant's; without rows if there is none."""
    rows = [(arm.name, shown(arm.variant), arm.settings_text or "nothing") for arm in comparison.arms if arm.own_name]
    return Table("Arms with a name of their own", ("name", "variant", "differs from it in"), tuple(rows))


def differences_table(entry: EnvironmentScores) -> Table:
    """How much each pair differs, and how probably, by both measures; without rows where no interval exists."""
    head = ["pair"]
    for title in MEASURES.values():
        head += [f"{title}: difference", f"{title}: P"]
    rows = [
        (f"{pair.x.name} − {pair.y.name}", *difference_cells(pair.final), *difference_cells(pair.area))
        for pair in entry.pairs
        if pair.improvement.exists
    ]
    return Table("Differences of means", tuple(head), tuple(rows), DIFFERENCES_NOTE)


def difference_cells(scores: PairScores) -> tuple[str, str]:
    p, low, high = scores.improvement[:3]
    return interval_cell(scores.difference), f"{p:.2f} [{low:.2f}, {high:.2f}]"


def interval_cell(interval: Interval) -> str:
    """An interval without its number of runs, which stands in a column of its own."""
    return re.sub(r", \d+ seeds$|: 1 seed(?=\)$)", "", interval_text(interval))


def settings_table(comparison: Comparison) -> Table:
    """Every setting; where it is not the same in all runs, who has which value."""
    rows = []
    arms = {id(run): arm.name for (_, arm), runs in comparison.groups.items() for run in runs}
    flats = [(run, flatten(run.config.to_dict())) for run in comparison.runs]
    names = dict.fromkeys(name for _, flat in flats for name in flat)
    for name in names:
        holders: dict[str, list[str]] = {}
        for run, flat in flats:
            who = shown(run.config.environment) if name in ("environment_arguments", "wrappers") else arms[id(run)]
            holders.setdefault(shown(flat.get(name)), []).append(who)
        rows.append((shown(name), holders_text(holders, name in ("environment", "variant", "seed"))))
    return Table("Settings", ("setting", "value"), tuple(rows))


def versions_table(comparison: Comparison) -> Table:
    """Versions of packages and the machines that the runs were made with."""
    rows = []
    for field in ("versions", "machine"):
        for name in dict.fromkeys(name for run in comparison.runs for name in getattr(run, field)):
            values = dict.fromkeys(shown(getattr(run, field).get(name, "unknown")) for run in comparison.runs)
            rows.append((shown(name), ", ".join(values)))
    return Table("Versions and machine", ("what", "value"), tuple(rows))


def holders_text(holders: dict[str, list[str]], only_values: bool) -> str:
    if only_values or len(holders) == 1:
        return ", ".join(holders)
    return "; ".join(f"{value} ({', '.join(dict.fromkeys(who))})" for value, who in holders.items())


def runs_table(comparison: Comparison, scores: Sequence[EnvironmentScores]) -> Table:
    """One row for each run, finished or not."""
    by_run = {(entry.environment, arm.arm, run.seed): run for entry in scores for arm in entry.arms for run in arm.runs}
    rows = []
    for (environment, arm), runs in comparison.groups.items():
        for run in runs:
            score = by_run.get((environment, arm, run.config.seed))
            hours = run.evaluations["seconds"][-1] / 3600 if score else None
            rows.append((
                shown("/".join(run.path.parts[-4:]), 200),
                "finished" if run.result is not None else "unfinished",
                str(score.evaluations) if score else "0",
                number_text(score.final) if score else "no evaluation yet",
                number_text(score.best) if score else "no evaluation yet",
                f"{hours:.2f}" if hours is not None else "",
            ))  # fmt: skip
    return Table("Runs", ("run", "state", "evaluations", "final", "best", "hours"), tuple(rows))


def scores_csv(comparison: Comparison, scores: Sequence[EnvironmentScores]) -> str:
    """One line for each run with an evaluation, numbers in full."""
    rows: list[Sequence[object]] = [CSV_COLUMNS]
    for entry in scores:
        for arm in entry.arms:
            records = {run.config.seed: run for run in comparison.groups[entry.environment, arm.arm]}
            for run in arm.runs:
                record = records[run.seed]
                protocol = shown(record.config.protocol)
                rows.append([
                    shown(entry.environment), shown(arm.arm.variant), shown(arm.arm.own_name or arm.arm.variant),
                    arm.arm.settings_text, protocol, run.seed,
                    record.result is not None, run.evaluations, run.final, run.best, run.area, run.steps_to_threshold,
                    entry.threshold, entry.horizon, arm.paper_best,
                ])  # fmt: skip
    return csv_text(rows)


def markdown(comparison: Comparison, scores: Sequence[EnvironmentScores], warnings: Sequence[str]) -> str:
    """The summary and the tables as Markdown."""
    lines = ["# Comparison of SAC variants", ""]
    lines += [line for warning in warnings for line in (f"> **{markdown_escape(warning)}**", ">")][:-1]
    for entry in scores:
        lines += ["", f"## {markdown_escape(shown(entry.environment))}", ""]
        lines += [f"- {markdown_escape(sentence)}" for sentence in environment_sentences(entry)]
        lines += ["", *markdown_table(scores_table(entry))]
        if (differences := differences_table(entry)).rows:
            lines += ["", f"### {differences.title}", "", *markdown_table(differences)]
    if (arms := arms_table(comparison)).rows:
        lines += ["", f"## {arms.title}", "", *markdown_table(arms)]
    lines += ["", "## Runs", "", *markdown_table(runs_table(comparison, scores))]
    if comparison.left_out:
        lines += ["", f"## {LEFT_OUT}", "", *(f"- {markdown_escape(reason)}" for reason in comparison.left_out)]
    return "\n".join(lines) + "\n"


def markdown_table(table: Table) -> list[str]:
    rows = [table.head, tuple("---" for _ in table.head), *table.rows]
    lines = ["| " + " | ".join(cell if cell == "---" else markdown_escape(cell) for cell in row) + " |" for row in rows]
    return lines + (["", markdown_escape(table.note)] if table.note else [])


def markdown_escape(text: str) -> str:
    return re.sub(r"([\\`*_{}\[\]<>#|!&~$])", r"\\\1", text)


LATEX_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "α": r"$\alpha$", "−": "$-$", "…": r"\dots{}",
}  # fmt: skip


def latex_escape(text: str) -> str:
    return "".join(LATEX_SPECIAL.get(character, character) for character in text)


def latex(scores: Sequence[EnvironmentScores], warnings: Sequence[str]) -> str:
    """One booktabs table for each environment."""
    parts = []
    for entry in scores:
        table = scores_table(entry)
        rows = [" & ".join(map(latex_escape, row)) + r" \\" for row in (table.head, *table.rows)]
        caption = latex_escape(" ".join([f"{table.title}.", *(f"{warning}." for warning in warnings), table.note]))
        parts.append("\n".join([
            r"\begin{table}", r"\centering", rf"\caption{{{caption}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}", r"\toprule", rows[0], r"\midrule", *rows[1:],
            r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
        ]))  # fmt: skip
    return "% needs \\usepackage{booktabs}\n" + "\n".join(parts)
