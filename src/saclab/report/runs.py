"""Sort runs into groups that may be averaged, and refuse what is not comparable.

Runs that differ in anything but their seed are never averaged together. Runs of one environment must also agree in
everything but the variant; where they do not, `group_runs` names the difference, or, if told to, shows them side by
side, each group labelled with what differs.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from saclab.config import Config, TrainingSettings
from saclab.errors import UserError
from saclab.protocols import PROTOCOLS, make_config, training_settings
from saclab.training.run_folder import RunRecord, read_run
from saclab.variants import VARIANTS

SIMULATION_PACKAGES = ("gymnasium", "mujoco")
"""Runs whose major versions of these differ are not comparable."""

ONLY_MEASURING = ("q_bias_episodes",)
"""Settings that change what is measured beside the training, and not its course."""


class Arm(NamedTuple):
    """What is compared: a variant, and where differing runs stand side by side, what differs."""

    variant: str
    differs: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """For sentences and tables: the variant's key."""
        return shown(self.variant) + self.suffix

    @property
    def title(self) -> str:
        """For figures: the variant's title."""
        title = VARIANTS[self.variant].title if self.variant in VARIANTS else shown(self.variant)
        return title + self.suffix

    @property
    def suffix(self) -> str:
        """The first differences in brackets; empty if there is none."""
        listed = [f"{name} {value}" for name, value in self.differs[:3]] + ["…"] * (len(self.differs) > 3)
        return f" ({', '.join(listed)})" if listed else ""

    @property
    def paper_name(self) -> str | None:
        return VARIANTS[self.variant].paper_name if self.variant in VARIANTS else None


class Comparison(NamedTuple):
    """Runs, sorted into groups of equal runs with different seeds."""

    environments: tuple[str, ...]
    arms: tuple[Arm, ...]
    groups: dict[tuple[str, Arm], tuple[RunRecord, ...]]
    """By environment and arm; runs in the order of their seeds. Not every arm need have runs everywhere."""
    mixed: tuple[str, ...]
    """The differences that were accepted, each a sentence; empty if all runs are comparable."""

    def arms_of(self, environment: str) -> tuple[Arm, ...]:
        return tuple(arm for arm in self.arms if (environment, arm) in self.groups)

    def runs_of(self, environment: str) -> tuple[RunRecord, ...]:
        return tuple(run for arm in self.arms_of(environment) for run in self.groups[environment, arm])

    @property
    def runs(self) -> tuple[RunRecord, ...]:
        return tuple(run for environment in self.environments for run in self.runs_of(environment))


def by_paper_name(places: Mapping[Arm, int]) -> dict[str, int]:
    """The paper's systems -> place of the first arm that is the same system."""
    return {arm.paper_name: place for arm, place in reversed(list(places.items())) if arm.paper_name is not None}


def shown(text: object, limit: int = 80) -> str:
    """Text from a run folder as one short printable line: no control characters, nothing that cannot be encoded."""
    printable = "".join(character if character.isprintable() else " " for character in str(text))
    return printable if len(printable) <= limit else printable[: limit - 1] + "…"


def read_comparison(folders: Sequence[Path], allow_mixed: bool = False) -> Comparison:
    """Read run folders and group them; raises UserError as `read_run` and `group_runs` do."""
    once = {folder.resolve(): folder for folder in folders}
    return group_runs([read_run(folder) for folder in once.values()], allow_mixed)


def group_runs(runs: Sequence[RunRecord], allow_mixed: bool = False) -> Comparison:
    """Sort runs into groups that differ in nothing but the seed.

    Args:
        runs: at least one, of any environments and variants.
        allow_mixed: show runs that are not comparable side by side, instead of refusing.

    Raises:
        UserError: for runs that are not comparable, naming the first difference and how many more there are; for two
            runs of the same group and seed, naming both.
    """
    if not runs:
        raise UserError("there is no run to compare")
    runs = sorted(runs, key=lambda run: (run.config.seed, str(run.path)))
    references = {name: reference_run([run for run in runs if run.config.environment == name])
                  for name in sorted({run.config.environment for run in runs})}  # fmt: skip
    mixed = environment_differences(references)
    groups: dict[tuple[str, Arm], dict[int, RunRecord]] = {}
    firsts: dict[tuple[str, str], RunRecord] = {}
    for run in runs:
        environment, variant = run.config.environment, run.config.variant
        reference, first = references[environment], firsts.setdefault((environment, variant), run)
        differences = differing(run, reference) | unknown_differing(run, first)
        arm = Arm(variant, tuple((shown(name), shown(here, 30)) for name, (here, _) in differences.items()))
        if differences and (environment, arm) not in groups:
            mixed.append(difference_sentence(run, first if variant not in VARIANTS else reference, differences))
        same = groups.setdefault((environment, arm), {}).setdefault(run.config.seed, run)
        if same is not run:
            raise UserError(
                f"{shown(same.path, 300)} and {shown(run.path, 300)} are the same experiment with the same seed "
                f"{run.config.seed}: leave one of them out, since they are not independent"
            )
    if mixed and not allow_mixed:
        more = f" (and {len(mixed) - 1} more like it)" if len(mixed) > 1 else ""
        raise UserError(f"not comparable: {mixed[0]}{more}: report them apart, or allow mixed runs side by side")
    known = list(VARIANTS)
    arms = sorted({arm for _, arm in groups}, key=lambda arm: (
        known.index(arm.variant) if arm.variant in known else len(known), arm.variant, arm.differs))  # fmt: skip
    by_seed = {key: tuple(group[seed] for seed in sorted(group)) for key, group in groups.items()}
    return Comparison(tuple(references), tuple(arms), by_seed, tuple(mixed))


def reference_run(runs: Sequence[RunRecord]) -> RunRecord:
    """The first of the runs that most others are comparable with."""
    signatures = [repr(signature(run)) for run in runs]
    (most, _), *_ = Counter(signatures).most_common(1)
    return runs[signatures.index(most)]


def signature(run: RunRecord) -> dict[str, Any]:
    """What must be equal for runs of one environment, whatever their variant and seed."""
    versions = {f"{package} version": major(run.versions.get(package)) for package in SIMULATION_PACKAGES}
    training = {name: value for name, value in asdict(run.config.training).items() if name not in ONLY_MEASURING}
    return {
        "protocol": run.config.protocol,
        "update-to-data ratio": run.config.training.update_to_data_ratio,
        **versions,
        "environment_arguments": run.config.environment_arguments,
        **training,
        **beside_variant(run.config),
    }


def beside_variant(config: Config) -> dict[str, Any]:
    """Settings of the algorithm that are not the variant's own on this environment and protocol.

    None for a variant or protocol that this version does not know: nothing tells which are its own.
    """
    try:
        own = asdict(make_config(config.environment, config.variant, config.protocol).algorithm)
    except UserError:
        return {}
    return {name: value for name, value in asdict(config.algorithm).items() if value != own[name]}


def major(version: str | None) -> str:
    return re.split(r"[.+]", version)[0] if version else "unknown"


def differing(run: RunRecord, reference: RunRecord) -> dict[str, tuple[Any, Any]]:
    """Name -> (value here, value there), for what makes two runs of one environment not comparable."""
    here, there = signature(run), signature(reference)
    own_here, own_there = asdict(run.config.algorithm), asdict(reference.config.algorithm)
    return {
        name: (
            here[name] if name in here else f"the variant's own {own_here[name]}",
            there[name] if name in there else f"the variant's own {own_there[name]}",
        )
        for name in here | there
        if name not in here or name not in there or here[name] != there[name]
    }


def unknown_differing(run: RunRecord, first: RunRecord) -> dict[str, tuple[Any, Any]]:
    """The same for the algorithm's settings of two runs of one variant that this version does not know."""
    if run.config.variant in VARIANTS and run.config.protocol in PROTOCOLS:
        return {}
    here, there = asdict(run.config.algorithm), asdict(first.config.algorithm)
    return {name: (here[name], there[name]) for name in here if here[name] != there[name]}


def difference_sentence(run: RunRecord, reference: RunRecord, differences: Mapping[str, tuple[Any, Any]]) -> str:
    """The first difference with both values and both runs, and the names of the others."""
    (name, (here, there)), *others = differences.items()
    also = f" (and {', '.join(shown(other) for other, _ in others)})" if others else ""
    return (
        f"{shown(name)} is {shown(here)} in {shown(run.path, 300)} and {shown(there)} in {shown(reference.path, 300)}"
        f"{also}"
    )


def environment_differences(references: Mapping[str, RunRecord]) -> list[str]:
    """Why the environments of a report cannot be summed up together: two versions of one, or two protocols."""
    sentences: list[str] = []
    names, first = list(references), next(iter(references.values()))
    for base, count in Counter(base_name(name) for name in names).items():
        if count > 1:
            versions = " and ".join(shown(name) for name in names if base_name(name) == base)
            sentences.append(f"{versions} are different tasks")
    for run in references.values():
        if run.config.protocol != first.config.protocol:
            difference = {"protocol": (run.config.protocol, first.config.protocol)}
            sentences.append(difference_sentence(run, first, difference))
    return sentences


def base_name(environment: str) -> str:
    return re.sub(r"-v\d+$", "", environment)


def scale_notice(run: RunRecord) -> str | None:
    """How far a run's settings fall short of its protocol; None if they do not. Quick always falls short."""
    config = run.config
    if config.protocol == "quick":
        return "quick protocol, far shorter than the paper's: too short to judge a variant by"
    try:
        full = training_settings(config.protocol, config.environment)
    except UserError:
        return None
    cuts = []
    if most_updates(config.training) < most_updates(full):
        cuts.append(f"{most_updates(config.training):,.0f} of {most_updates(full):,.0f} updates")
    if (config.training.max_episodes or np.inf) < (full.max_episodes or np.inf):
        cuts.append(f"at most {config.training.max_episodes:,} episodes")
    return f"scaled down: {', '.join(cuts)} of the {config.protocol} protocol" if cuts else None


def most_updates(settings: TrainingSettings) -> float:
    """Updates that the limits on updates and steps allow; infinite if neither is set."""
    by_steps = np.inf if settings.max_steps is None else settings.updates_due(settings.max_steps)
    return min(by_steps, np.inf if settings.max_updates is None else settings.max_updates)


def notices(runs: Sequence[RunRecord]) -> tuple[str, ...]:
    """What every figure of these runs must say: scaled down, unfinished, without a test yet."""
    scaled = Counter(notice for run in runs if (notice := scale_notice(run)))
    unfinished = sum(run.result is None for run in runs)
    untested = sum(tests(run) == 0 for run in runs)
    sentences = [notice[0].upper() + notice[1:] for notice in scaled]
    if unfinished:
        sentences.append(f"{unfinished} of {len(runs)} runs unfinished")
    if untested:
        sentences.append(f"{untested} of {len(runs)} runs without a test so far")
    return tuple(sentences)


def all_notices(comparison: Comparison) -> tuple[str, ...]:
    """The notices of every environment, each with its name if there are several."""
    several = len(comparison.environments) > 1
    return tuple(
        f"{shown(environment)}: {notice}" if several else notice
        for environment in comparison.environments
        for notice in notices(comparison.runs_of(environment))
    )


def tests(run: RunRecord) -> int:
    """Evaluations that the run has made."""
    return len(run.evaluations.get("mean_return", ()))
