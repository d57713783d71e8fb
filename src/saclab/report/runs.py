"""Sort runs into groups that may be averaged, and refuse what is not comparable.

Runs that differ in anything but their seed are never averaged together. Runs of one environment must also agree in
everything but the variant, or, where they have a name of their own, the settings of the algorithm. Where they do not,
`group_runs` names the difference, or, if told to, shows them side by side, each group labelled with what differs.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from saclab.errors import UserError
from saclab.report.arms import (
    Arm,
    agreed_settings,
    arm_of,
    beside_variant,
    conditions,
    given_to_all,
    is_known,
    own_name,
    unlike,
    unlike_in_arm,
)
from saclab.report.text import shown
from saclab.settings import AlgorithmSettings, field_names
from saclab.training.run_folder import RunRecord, read_run


class Comparison(NamedTuple):
    """Runs, sorted into groups of equal runs with different seeds."""

    environments: tuple[str, ...]
    arms: tuple[Arm, ...]
    groups: dict[tuple[str, Arm], tuple[RunRecord, ...]]
    """(environment, arm) -> runs in the order of their seeds. Not every arm need have runs everywhere."""
    mixed: tuple[str, ...]
    """The differences that were accepted, each a sentence; empty if all runs are comparable."""
    left_out: tuple[str, ...] = ()
    """Why folders are left out, each a sentence."""

    def arms_of(self, environment: str) -> tuple[Arm, ...]:
        return tuple(arm for arm in self.arms if (environment, arm) in self.groups)

    def runs_of(self, environment: str) -> tuple[RunRecord, ...]:
        return tuple(run for arm in self.arms_of(environment) for run in self.groups[environment, arm])

    @property
    def runs(self) -> tuple[RunRecord, ...]:
        return tuple(run for environment in self.environments for run in self.runs_of(environment))


def read_comparison(folders: Sequence[Path], allow_mixed: bool = False, strict: bool = False) -> Comparison:
    """Read run folders and group them.

    Folders that cannot be read are left out, and all but one of those that hold the same experiment with the same seed,
    unless it is `strict`.

    Raises:
        UserError: if none can be read, if one cannot and it is `strict`, and as `group_runs` does.
    """
    runs, left_out = read_runs(folders)
    if left_out and (strict or not runs):
        more = f" (and {len(left_out) - 1} more)" if len(left_out) > 1 else ""
        raise UserError(f"{len(left_out)} of {len(runs) + len(left_out)} folders cannot be read: "
                        f"{shown(next(iter(left_out.values())), 1000)}{more}")  # fmt: skip
    if not strict:
        runs, repeated = each_once(runs)
        left_out |= repeated
    return group_runs(runs, allow_mixed)._replace(left_out=tuple(shown(reason, 1000) for reason in left_out.values()))


def read_runs(folders: Sequence[Path]) -> tuple[list[RunRecord], dict[Path, str]]:
    """The runs of these folders, each once, and why the others cannot be read."""
    runs: list[RunRecord] = []
    left_out: dict[Path, str] = {}
    for folder in {os.path.realpath(folder): folder for folder in folders}.values():
        try:
            runs.append(read_run(folder))
        except UserError as error:
            left_out[folder] = str(error)
    return runs, left_out


def group_runs(runs: Sequence[RunRecord], allow_mixed: bool = False) -> Comparison:
    """Sort runs into groups that differ in nothing but the seed.

    Args:
        runs: at least one, of any environments and variants.
        allow_mixed: show runs that are not comparable side by side, instead of refusing.

    Raises:
        UserError: for runs that are not comparable, naming the first difference and how many more there are; for two
            runs of the same settings and seed, naming both.
    """
    if not runs:
        raise UserError("there is no run to compare")
    runs = sorted(runs, key=lambda run: (run.config.seed, str(run.path)))
    require_independent(runs)
    of_each = {name: [run for run in runs if run.config.environment == name]
               for name in sorted({run.config.environment for run in runs})}  # fmt: skip
    references = {name: reference_run(own) for name, own in of_each.items()}
    agreed = {name: agreed_settings(own) for name, own in of_each.items()}
    refusals, common = environment_differences(references), given_to_all(runs)
    groups: dict[tuple[str, Arm], dict[int, RunRecord]] = {}
    firsts: dict[tuple[str | None, ...], RunRecord] = {}
    for run in runs:
        environment, reference = run.config.environment, references[run.config.environment]
        first = firsts.setdefault(arm_key(run), run)
        inside = unlike_in_arm(run, first)
        differences = unlike(run, reference, agreed[environment]) | inside
        arm = arm_of(run, first, differences, common)
        if differences and (environment, arm) not in groups:
            refusals.append(refusal(run, first if inside else reference, differences))
        same = groups.setdefault((environment, arm), {}).setdefault(run.config.seed, run)
        if same is not run:
            raise not_independent(same, run)
    if refusals and not allow_mixed:
        sentence, hint = refusals[0]
        more = f" (and {len(refusals) - 1} more like it)" if len(refusals) > 1 else ""
        ways_out = f"{hint}report them apart, or allow mixed runs side by side (--allow-mixed)"
        raise UserError(f"not comparable: {sentence}{more}: {ways_out}")
    arms = sorted({arm for _, arm in groups}, key=lambda arm: arm.order)
    by_seed = {key: tuple(group[seed] for seed in sorted(group)) for key, group in groups.items()}
    return Comparison(tuple(references), tuple(arms), by_seed, tuple(sentence for sentence, _ in refusals))


def arm_key(run: RunRecord) -> tuple[str | None, ...]:
    """What runs of one arm have in common. A name means the same settings on every environment."""
    config, name = run.config, own_name(run)
    return (config.variant, name, None if name is not None and is_known(config) else config.environment)


def each_once(runs: Sequence[RunRecord]) -> tuple[list[RunRecord], dict[Path, str]]:
    """Runs of which no two are the same experiment, and why the others are left out.

    Those stay whose arm has more finished runs, then those without a name of their own: an arm is not torn in two.
    """
    finished = Counter(run.path.parent for run in runs if run.result is not None)
    kept: dict[str, RunRecord] = {}
    repeated: dict[Path, str] = {}
    for run in sorted(runs, key=lambda run: (-finished[run.path.parent], own_name(run) is not None, str(run.path))):
        if (same := kept.setdefault(experiment_of(run), run)) is not run:
            repeated[run.path] = f"{run.path} is the same experiment with the same seed as {same.path}"
    return list(kept.values()), repeated


def require_independent(runs: Sequence[RunRecord]) -> None:
    """Raise UserError for two runs that are the same experiment under two names."""
    seen: dict[str, RunRecord] = {}
    for run in runs:
        if (same := seen.setdefault(experiment_of(run), run)) is not run:
            raise not_independent(same, run)


def experiment_of(run: RunRecord) -> str:
    """What decides a run's result, but for the machine: two runs that have it in common are one."""
    config = run.config
    return repr((config.environment, config.variant, config.seed, asdict(config.algorithm), conditions(run)))


def not_independent(first: RunRecord, second: RunRecord) -> UserError:
    return UserError(
        f"{shown(first.path, 300)} and {shown(second.path, 300)} are the same experiment with the same seed "
        f"{first.config.seed}: leave one of them out, since they are not independent"
    )


def reference_run(runs: Sequence[RunRecord]) -> RunRecord:
    """The first of the runs that most others are comparable with; one without a name of its own, if there is any."""
    runs = [run for run in runs if own_name(run) is None] or runs
    signatures = [repr((conditions(run), beside_variant(run.config))) for run in runs]
    (most, _), *_ = Counter(signatures).most_common(1)
    return runs[signatures.index(most)]


def refusal(run: RunRecord, reference: RunRecord, differences: Mapping[str, tuple[Any, Any]]) -> tuple[str, str]:
    """Why two runs are not comparable, and what would make them so; see `difference_sentence`."""
    only_algorithm = differences.keys() <= set(field_names(AlgorithmSettings))
    nameless = only_algorithm and own_name(run) is None and is_known(run.config)
    hint = "give runs with other settings of the algorithm a name of their own (--name), " if nameless else ""
    return difference_sentence(run, reference, differences), hint


def difference_sentence(run: RunRecord, reference: RunRecord, differences: Mapping[str, tuple[Any, Any]]) -> str:
    """The first difference with both values and both runs, and the names of the others."""
    (name, (here, there)), *others = differences.items()
    also = f" (and {', '.join(shown(other) for other, _ in others)})" if others else ""
    return (
        f"{shown(name)} is {shown(here)} in {shown(run.path, 300)} and {shown(there)} in {shown(reference.path, 300)}"
        f"{also}"
    )


def environment_differences(references: Mapping[str, RunRecord]) -> list[tuple[str, str]]:
    """Why the environments of a report cannot be summed up together: two versions of one, or two protocols."""
    first = next(iter(references.values()))
    sentences = [(sentence, "") for sentence in two_versions(references)]
    for run in references.values():
        if run.config.protocol != first.config.protocol:
            difference = {"protocol": (run.config.protocol, first.config.protocol)}
            sentences.append((difference_sentence(run, first, difference), ""))
    return sentences


def two_versions(environments: Iterable[str]) -> list[str]:
    """A sentence for each environment of which there are several versions."""
    names = list(environments)
    return [
        f"{' and '.join(shown(name) for name in names if base_name(name) == base)} are different tasks"
        for base, count in Counter(map(base_name, names)).items()
        if count > 1
    ]


def base_name(environment: str) -> str:
    return re.sub(r"-v\d+$", "", environment)
