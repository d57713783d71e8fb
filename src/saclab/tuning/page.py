"""The page of a tune, one HTML file that needs nothing else: the best settings, what mattered, every trial."""

from __future__ import annotations

import base64
import json
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from saclab.files import replace_file
from saclab.report.page import content_hash, read_data, table_html
from saclab.report.tables import Table
from saclab.report.text import count_text, shown
from saclab.report.train_command import flag_values
from saclab.settings import TrainingSettings, field_names
from saclab.training.run_folder import run_path
from saclab.tuning.figures import figures
from saclab.tuning.plan import TunePlan, trial_name
from saclab.tuning.space import value_text, values_of
from saclab.tuning.study import WHY, best_trial, ended_trials, is_complete, value_in_words

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

LINE_LETTERS = 100
FRESH_SEED, FRESH_SEEDS = 1000, 5
"""The seeds of the commands that judge the best settings: others than the trials'."""
LINES = 100
"""Trials that the table shows at most, the best first."""
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src '${style_hash}'; img-src data:; base-uri 'none'; form-action 'none'">
<title>${title} · saclab</title>
<style>${style}</style>
</head>
<body>
<header><h1>${title}</h1><p class="lead">${lead}</p></header>
<main>
<section><h2>Best settings</h2>${best}</section>
<section><h2>What mattered</h2>${figures}</section>
<section><h2>Trials</h2>${trials}</section>
</main>
</body>
</html>
""")


def write_page(study: optuna.Study, plan: TunePlan, folder: Path) -> Path | None:
    """Write index.html into the folder of a tune; None if no trial has ended yet."""
    if not ended_trials(study):
        return None
    path = folder / "index.html"
    replace_file(path, page_of(study, plan, folder).encode())
    return path


def page_of(study: optuna.Study, plan: TunePlan, folder: Path) -> str:
    style = read_data("report.css")
    return PAGE.substitute(
        title=escape(f"{shown(plan.variant)} tuned on {shown(plan.environment)}"),
        lead=escape(lead(study, plan)),
        style=style,
        style_hash=content_hash(style),
        best=best_html(study, plan, folder),
        figures="".join(figure_html(caption, picture) for caption, picture in figures(study, plan)),
        trials=table_html(trials_table(study, plan), headed=True),
    )


def lead(study: optuna.Study, plan: TunePlan) -> str:
    """What was searched, in a line."""
    ended = ended_trials(study)
    finished = sum(map(is_complete, ended))
    return (
        f"{count_text(len(ended), 'trial')}, {len(ended) - finished} of them given up: "
        f"{count_text(len(plan.seeds), 'seed')} each, protocol {shown(plan.protocol)}. Looked for: "
        f"{'least' if plan.objective.kind.to_score else 'highest'} {plan.objective.title}."
    )


def best_html(study: optuna.Study, plan: TunePlan, folder: Path) -> str:
    """The best trial beside the variant's own values, and the commands that judge it."""
    best = best_trial(study, plan)
    if best is None:
        at_score = ", with all of its runs at the score" if plan.objective.kind.to_score else ""
        return f"<p>No trial has come to its end{at_score} yet.</p>"
    settings = values_of(plan.space, best.params)
    rows = [(name, value_text(own), value_text(settings[name])) for name, own in plan.own_values.items()]
    own = own_trial(study, plan)
    if own is not None and own.number == best.number:
        return f"<p>Nothing better than the variant's own settings was found: trial {own.number}, {own.value:.4g}.</p>"
    against = (
        f", against {value_in_words(own, plan)} of the variant's own (trial {own.number})" if own is not None else ""
    )
    caveat = (
        "It is the best of many noisy ones, so the value flatters: the commands train it and the variant's own "
        f"settings with {FRESH_SEEDS} seeds that no trial had, and compare them."
    )
    commands = "\n".join(map(folded, judging_commands(plan, settings, best.number, folder)))
    return (
        f"<p>Trial {best.number}: {best.value:.4g}{against}. {caveat}</p>"
        f"{table_html(Table('Best settings', ('setting', 'own value', 'best'), tuple(rows)), headed=True)}"
        f'<pre tabindex="0">{escape(commands)}</pre>'
    )


def folded(words: Sequence[str]) -> str:
    """A command over several lines, as a shell takes it."""
    lines = [""]
    for word in map(shlex.quote, words):
        if len(lines[-1]) + len(word) > LINE_LETTERS:
            lines.append("")
        lines[-1] += f" {word}" if lines[-1] else word
    return " \\\n    ".join(lines)


def own_trial(study: optuna.Study, plan: TunePlan) -> FrozenTrial | None:
    """The trial of the variant's own settings, if it came to its end."""
    first = study.trials[0] if study.trials and not plan.own_outside else None
    return first if first is not None and is_complete(first) else None


def judging_commands(plan: TunePlan, settings: Mapping[str, Any], number: int, folder: Path) -> list[list[str]]:
    """The words of commands that compare a trial's settings with the variant's own, on seeds that no trial had."""
    first = max(FRESH_SEED, max(plan.seeds) + 1)
    runs, name = folder / "judged", f"{plan.variant}-{trial_name(number)}"
    common = ["saclab", "compare", plan.environment, "--variants", plan.variant, "--protocol", plan.protocol,
              "--seeds", str(FRESH_SEEDS), "--first-seed", str(first), "--runs", str(runs),
              *option_words(plan.overrides)]  # fmt: skip
    if plan.environment_arguments:
        common += ["--environment-arguments", json.dumps(plan.environment_arguments)]
    arms = [str(run_path(runs, plan.config({}, first), arm).parent) for arm in (plan.variant, name)]
    mixed = ["--allow-mixed"] if any(setting in field_names(TrainingSettings) for setting in settings) else []
    return [
        common,
        [*common, "--name", name, *option_words(settings)],
        ["saclab", "report", *arms, *mixed, "--out", str(runs / "report")],
    ]


def option_words(settings: Mapping[str, Any]) -> list[str]:
    return [word for name, value in settings.items() for word in ("--" + name.replace("_", "-"), *flag_values(value))]


def trials_table(study: optuna.Study, plan: TunePlan) -> Table:
    """Every trial that has ended, the best first."""
    sign = 1 if plan.objective.kind.to_score else -1
    ended = sorted(ended_trials(study), key=lambda trial: (not is_complete(trial), sign * (trial.value or 0.0)))
    rows = tuple(
        (
            str(trial.number),
            unbroken_words(value_in_words(trial, plan) if is_complete(trial) else "given up"),
            *(value_text(values_of(plan.space, trial.params).get(name, "")) for name in plan.space),
            unbroken_words(shown(trial.user_attrs.get(WHY, ""), 120)),
        )
        for trial in ended[:LINES]
    )
    more = f" The first {LINES} of {len(ended)}." if len(ended) > LINES else ""
    note = f"The runs of trial n lie in runs/…/{trial_name(0)[:-4]}n: saclab report shows their curves.{more}"
    return Table("Trials", ("trial", "value", *plan.space, "why given up"), rows, note)


def unbroken_words(text: str) -> str:
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def figure_html(caption: str, picture: bytes) -> str:
    source = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
    return f'<figure><figcaption>{escape(caption)}</figcaption><img alt="{escape(caption)}" src="{source}"></figure>'
