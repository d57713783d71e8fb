"""What an algorithm's settings refuse, with the reason: values that cannot work, alone or together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from saclab.errors import require

if TYPE_CHECKING:
    from saclab.settings import AlgorithmSettings, TrainingSettings

UPDATES = ("critic", "actor", "temperature", "targets")
"""The parts of an update."""
PREFILLS = ("minari", "replay", "policy")
"""Kinds of what a run can begin with."""


def require_known(settings: AlgorithmSettings, choices: Mapping[str, tuple[str | None, ...]]) -> None:
    """Raise SettingError for a name that is not among the choices of its setting."""
    for name, known in choices.items():
        value = getattr(settings, name)
        require(value in known, name, value, f"use one of {', '.join(map(str, known))}")


def require_ranges(settings: AlgorithmSettings) -> None:
    """Raise SettingError for a value that cannot work whatever the others are."""

    def check(name: str, condition: Callable[[Any], bool], way_out: str) -> None:
        require(condition(getattr(settings, name)), name, getattr(settings, name), way_out)

    check("discount", lambda value: 0 <= value < 1, "use a value in [0, 1), such as 0.99")
    check("polyak_rate", lambda value: 0 < value <= 1, "use a value in (0, 1], such as 0.005")
    check("snapshots", lambda value: value >= 0, "use a whole number, of 0 for no target network")
    check("critic_atoms", lambda value: value >= 2, "use a whole number of at least 2, such as 101")
    check("critic_bound", lambda value: value > 0, "use a value above 0, such as 5")
    check("final_learning_rate_share", lambda value: 0 <= value <= 1, "use a value in [0, 1], such as 0.5")
    check("critic_dropout", lambda value: value == 0 or 2e-5 <= value <= 0.99, "use 0, or a value from 2e-5 to 0.99")
    check("dropped_quantiles", lambda value: value >= 0, "use a whole number of at least 0")
    check(
        "target_critics", lambda value: value is None or value >= 1, "use a whole number of at least 1, or leave it out"
    )
    for name in (
        "batch_size",
        "critics",
        "snapshot_interval",
        "entropy_window",
        "actor_interval",
        "longest_noise",
        "n_step",
    ):
        check(name, lambda value: value >= 1, "use a whole number of at least 1")
    for name in ("critic_learning_rate", "actor_learning_rate", "temperature_learning_rate"):
        check(name, lambda value: 0 <= value < 1, "use a value in [0, 1), such as 3e-4")
    for name in ("adam_beta_1", "adam_beta_2"):
        check(name, lambda value: 0 <= value < 1, "use a value in [0, 1), such as 0.9")
    for name in ("hidden_layers", "critic_hidden_layers"):
        check(
            name,
            lambda layers: layers is None or (len(layers) > 0 and min(layers) >= 1),
            "use one or more positive widths, such as 256 256",
        )


def require_possible(settings: AlgorithmSettings) -> None:
    """Raise SettingError for values that cannot work together."""
    lowest_allowed = "above 0" if settings.temperature == "learned" else "of at least 0"
    require(
        settings.initial_temperature > 0 or (settings.temperature == "fixed" and settings.initial_temperature == 0),
        "initial_temperature", settings.initial_temperature, f"use a value {lowest_allowed}, such as 0.2",
    )  # fmt: skip
    require(
        settings.log_std_minimum < settings.log_std_maximum,
        "log_std_minimum", settings.log_std_minimum, f"use a value below log_std_maximum {settings.log_std_maximum}",
    )  # fmt: skip
    require(
        settings.snapshots <= 1 or settings.entropy_window == 1,
        "entropy_window", settings.entropy_window,
        f"use 1 together with snapshots {settings.snapshots}: averaging values (Eq. 9) and averaging the entropy "
        "term are two different algorithms",
    )  # fmt: skip
    require(
        settings.critic_head == "scalar" or settings.entropy_window == 1,
        "entropy_window", settings.entropy_window,
        f"use 1 together with critic_head {settings.critic_head}: it is there to check the paper's numbers, those of "
        "scalar critics",
    )  # fmt: skip
    names = settings.reward_terms
    require(len(set(names)) == len(names), "reward_terms", " ".join(names), "name each term once")
    scheduled = {term.name for term in settings.scheduled_terms}
    weighed = [name for name in names if name not in scheduled]
    require(
        len(settings.reward_weights) in (0, len(weighed)),
        "reward_weights", " ".join(map(str, settings.reward_weights)),
        f"give one for each of the {len(weighed)} reward_terms" + " without a reward_schedule" * bool(scheduled)
        + ", or none",
    )  # fmt: skip
    require_possible_layers(settings)
    require_possible_critics(settings)
    order = settings.update_order
    require(
        sorted(order) == sorted(UPDATES) and order.index("actor") < order.index("temperature"),
        "update_order", " ".join(order),
        f"name each of {', '.join(UPDATES)} once, and actor before temperature, which is judged by its entropy",
    )  # fmt: skip


def require_possible_layers(settings: AlgorithmSettings) -> None:
    """Raise SettingError for layers that a network cannot have, or that learn nothing from such batches."""
    normalised = [name for name in (settings.network, settings.network_of_critic) if name.startswith("batch_")]
    require(
        not normalised or settings.batch_size >= 2,
        "batch_size", settings.batch_size,
        f"use at least 2 with {', '.join(normalised[:1])}: what is normalised over a batch of one is 0",
    )  # fmt: skip
    for network, name in ((settings.network, "hidden_layers"), (settings.network_of_critic, "critic_hidden_layers")):
        layers = settings.hidden_layers if name == "hidden_layers" else settings.layers_of_critic
        require(
            network not in ("batch_norm_residual", "hyperspherical") or len(set(layers)) == 1,
            name, " ".join(map(str, layers)), f"use one width for all: what goes into a block of {network} is added to "
            "what comes out",
        )  # fmt: skip


def require_possible_critics(settings: AlgorithmSettings) -> None:
    """Raise SettingError for critics that cannot be built or reduced as the settings say."""
    require(
        settings.target_critics is None or settings.target_critics <= settings.critics,
        "target_critics", settings.target_critics, f"use at most the number of critics, {settings.critics}",
    )  # fmt: skip
    require(
        settings.target_reduction != "truncated" or settings.critic_head == "quantile",
        "target_reduction", settings.target_reduction,
        f"use it with critic_head quantile: the head {settings.critic_head} has no quantiles to leave out",
    )  # fmt: skip
    require(
        settings.target_reduction != "truncated" or settings.dropped_quantiles < settings.critic_atoms,
        "dropped_quantiles", settings.dropped_quantiles, f"use fewer than critic_atoms, {settings.critic_atoms}",
    )  # fmt: skip
    require(
        settings.critic_dropout == 0 or settings.network_of_critic == "layer_norm_mlp",
        "critic_dropout", settings.critic_dropout,
        f"use critic_network layer_norm_mlp: {settings.network_of_critic} has no dropout",
    )  # fmt: skip
    own = {settings.network, settings.network_of_critic} - {"mlp", "layer_norm_mlp", "batch_renorm_mlp"}
    require(
        settings.initialisation == "network" or not own,
        "initialisation", settings.initialisation, f"use network: {', '.join(sorted(own))} starts in a way of its own",
    )  # fmt: skip


def require_prefill(settings: TrainingSettings) -> None:
    """Raise SettingError for a prefill that is none, or that cannot be together with the other settings."""
    known = settings.prefill is None or isinstance(settings.prefill, str)
    kind, name = (known and settings.prefill_source) or (None, "-")
    require(
        known and kind in (*PREFILLS, None) and bool(name.strip()) and name.isprintable(),
        "prefill", settings.prefill, "write minari:DATASET-ID, replay:RUN-FOLDER or policy:RUN-FOLDER",
    )  # fmt: skip
    require(
        settings.prefill_transitions is None or settings.fills_replay,
        "prefill_transitions", settings.prefill_transitions,
        f"use it with a prefill that holds transitions (minari:, replay:): it is {settings.prefill!r}",
    )  # fmt: skip
    require(
        kind != "policy" or settings.random_steps >= 1,
        "prefill", settings.prefill, "the policy acts in the random steps: use --random-steps 1 or more",
    )  # fmt: skip
