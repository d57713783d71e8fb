"""What is compared: a variant, or runs of one under a name of their own; and what runs must have in common."""

from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from saclab.config import Config
from saclab.errors import UserError
from saclab.machine import SIMULATION_PACKAGES, major
from saclab.protocols import PROTOCOLS, own_config, training_settings
from saclab.report.text import shown
from saclab.settings import TrainingSettings
from saclab.training.run_folder import RunRecord, safe_name
from saclab.variants import VARIANTS

ONLY_MEASURING = ("q_bias_episodes",)
"""Settings that change what is measured beside the training, and not its course."""

SHORT_VALUE = 30
"""Characters of a value that makes runs not comparable, in the name of an arm."""
RATIO_SETTINGS = ("updates_per_interval", "update_interval")
OWN = "the variant's own"
"""Stands for a value that no one has changed: variants are comparable though their rows say different ones. A value
that was set is never equal to it, not even where another variant has that value."""


class Arm(NamedTuple):
    """A variant, or runs of one under a name of their own; where differing runs stand side by side, what differs."""

    variant: str
    own_name: str | None = None
    """What stands in the variant's place in the run folders' paths, if it is something else."""
    settings: tuple[tuple[str, str], ...] = ()
    """Settings of the algorithm in which an arm with a name of its own differs from its variant."""
    differs: tuple[tuple[str, str], ...] = ()
    """What makes its runs not comparable with the others; they are shown on request only."""

    @property
    def name(self) -> str:
        """A short name for sentences and tables."""
        return shown(self.own_name or self.variant) + self.suffix

    @property
    def title(self) -> str:
        """A name for figures: the variant's title, or the arm's own name."""
        if self.own_name is not None or self.variant not in VARIANTS:
            return self.name
        return VARIANTS[self.variant].title + self.suffix

    @property
    def suffix(self) -> str:
        """The first differences in brackets; empty if there is none."""
        listed = [f"{name} {value}" for name, value in self.differs[:3]] + ["…"] * (len(self.differs) > 3)
        return f" ({', '.join(listed)})" if listed else ""

    @property
    def settings_text(self) -> str:
        """All settings in which it differs from its variant."""
        return ", ".join(f"{name} {value}" for name, value in self.settings + self.differs)

    @property
    def paper_name(self) -> str | None:
        """The system of the paper that it is; None if it has other settings."""
        return VARIANTS[self.variant].paper_name if self.variant in VARIANTS and not self.settings else None

    @property
    def order(self) -> tuple[Any, ...]:
        """A key to sort arms by: in the order of VARIANTS, those with a name of their own behind their variant."""
        known = list(VARIANTS)
        place = known.index(self.variant) if self.variant in known else len(known)
        return place, self.variant, self.own_name or "", self.settings, self.differs


def by_paper_name(places: Mapping[Arm, int]) -> dict[str, int]:
    """The paper's systems -> place of the first arm that is the same system."""
    return {arm.paper_name: place for arm, place in reversed(list(places.items())) if arm.paper_name is not None}


def own_name(run: RunRecord) -> str | None:
    """What stands in the variant's place in the path of a run folder; None if it is the variant.

    It is looked for only in a path as saclab makes it: <environment>/<name>/<protocol>/seed-<n>.
    """
    config, parts = run.config, run.path.absolute().parts
    expected = (safe_name(config.environment), safe_name(config.protocol), f"seed-{config.seed}")
    if len(parts) < 4 or (parts[-4], *parts[-2:]) != expected:
        return None
    return None if parts[-3] == safe_name(config.variant) else parts[-3]


def conditions(run: RunRecord) -> dict[str, Any]:
    """What must be equal for all runs of one environment: protocol, training and simulator."""
    versions = {f"{package} version": major(run.versions.get(package)) for package in SIMULATION_PACKAGES}
    training, own = asdict(run.config.training), own_training(run.config)
    unchanged = {} if own is None else asdict(own)
    return {
        "protocol": run.config.protocol,
        **versions,
        "environment_arguments": run.config.environment_arguments,
        **{name: OWN if name in unchanged and value == unchanged[name] else value
           for name, value in training.items() if name not in ONLY_MEASURING},
        **prefill_told(run),
    }  # fmt: skip


def prefill_told(run: RunRecord) -> dict[str, str]:
    """What a run began with, by its content, in place of the setting's text: its place may be another one elsewhere."""
    return {} if run.prefill is None else {"prefill": str(run.prefill)}


def own_training(config: Config) -> TrainingSettings | None:
    """How a run is trained if no one changes it: by its protocol, and by what its variant's row says for itself.

    By the protocol alone for a variant that this version does not know; None for such a protocol.
    """
    if config.protocol not in PROTOCOLS:
        return None
    if config.variant not in VARIANTS:
        return training_settings(config.protocol, config.environment)
    return own_config(config.environment, config.variant, config.protocol).training


def beside_variant(config: Config) -> dict[str, Any]:
    """Settings of the algorithm that are not the variant's own on this environment and protocol.

    None for a variant or protocol that this version does not know: nothing tells which are its own.
    """
    try:
        own = asdict(own_config(config.environment, config.variant, config.protocol).algorithm)
    except UserError:
        return {}
    return {name: value for name, value in asdict(config.algorithm).items() if value != own[name]}


def is_known(config: Config) -> bool:
    """Whether this version knows which settings are the variant's own."""
    return config.variant in VARIANTS and config.protocol in PROTOCOLS


def agreed_settings(runs: Sequence[RunRecord]) -> set[str]:
    """Settings that some runs of one environment have been given, and that the rows of all others say too."""
    plain = [run.config for run in runs if own_name(run) is None]
    values = [asdict(config.algorithm) for config in plain]
    given = {name for config in plain for name in beside_variant(config)}
    return {name for name in given if all(each[name] == values[0][name] for each in values)}


def unlike(run: RunRecord, reference: RunRecord, agreed: Container[str] = ()) -> dict[str, tuple[Any, Any]]:
    """Name -> (value here, value there), for what makes two runs of one environment not comparable.

    A run with a name of its own may have any settings of the algorithm; the others have their variant's, or those that
    all have been given, or that are `agreed_settings`.
    """
    here, there = conditions(run), conditions(reference)
    if own_name(run) is None:
        here, there = (
            found | {name: value for name, value in beside_variant(config).items() if name not in agreed}
            for found, config in ((here, run.config), (there, reference.config))
        )
    found = {
        name: (value_shown(name, run, here, reference), value_shown(name, reference, there, run))
        for name in here | there
        if name not in here or name not in there or here[name] != there[name]
    }
    ratios = run.config.training.update_to_data_ratio, reference.config.training.update_to_data_ratio
    if found.keys() & RATIO_SETTINGS and ratios[0] != ratios[1]:  # it says more than the settings it follows from
        found = {"update-to-data ratio": ratios, **found}
    return found


def value_shown(name: str, run: RunRecord, values: Mapping[str, Any], other: RunRecord) -> Any:
    """A value that makes a run not comparable with another.

    It says so if no one has changed it, but for the protocol's values of a training: these differ plainly enough.
    """
    if name in values and values[name] != OWN:
        return values[name]
    value, others = (asdict(each.config.algorithm) | asdict(each.config.training) for each in (run, other))
    row = VARIANTS[run.config.variant].settings if run.config.variant in VARIANTS else {}
    protocols = name in values and name not in row
    return value[name] if protocols and value[name] != others[name] else f"{OWN} {value[name]}"


def unlike_in_arm(run: RunRecord, first: RunRecord) -> dict[str, tuple[Any, Any]]:
    """The same for the settings of the algorithm of two runs under one name, or of one variant that is not known."""
    if own_name(run) is None and is_known(run.config):
        return {}
    here, there = asdict(run.config.algorithm), asdict(first.config.algorithm)
    names = list(here)
    if is_known(run.config):  # then the variant itself may have other values on another environment
        names = sorted({*beside_variant(run.config), *beside_variant(first.config)})
    return {name: (here[name], there[name]) for name in names if here[name] != there[name]}


def given_to_all(runs: Sequence[RunRecord]) -> dict[str, Any]:
    """Settings beside the variant's own that all runs without a name of their own have been given."""
    plain = [beside_variant(run.config) for run in runs if own_name(run) is None]
    first, *others = plain or [{}]
    return {name: value for name, value in first.items() if all(other.get(name) == value for other in others)}


def arm_of(
    run: RunRecord, first: RunRecord, differences: Mapping[str, tuple[Any, Any]], common: Mapping[str, Any]
) -> Arm:
    """The arm of a run.

    Args:
        run: of any name.
        first: the first run of its name or variant.
        differences: what makes it not comparable.
        common: what `given_to_all` found; it is no setting of a single arm.
    """
    name, settings = own_name(run), {}
    if name is not None and is_known(run.config):
        here = asdict(first.config.algorithm)
        names = beside_variant(first.config) | dict(common)
        settings = {name: here[name] for name in names if name not in common or here[name] != common[name]}
    return Arm(
        run.config.variant,
        name,
        tuple((setting, shown(value, 60)) for setting, value in settings.items()),
        tuple((shown(setting), short_value(here)) for setting, (here, _) in differences.items()),
    )


def short_value(value: Any) -> str:
    """A value in a few characters; in place of what is cut off a digest of the whole, for it tells arms apart."""
    whole = str(value)
    if len(whole) <= SHORT_VALUE:
        return shown(whole)
    digest = hashlib.sha256(whole.encode(errors="surrogatepass")).hexdigest()[:6]
    return f"{shown(whole, SHORT_VALUE - len(digest) - 1)} {digest}"
