"""The settings of an algorithm and of a training: one docstring per field, checked when they are built.

This file imports no numerical library, so that `saclab --help` stays fast.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from saclab.errors import require
from saclab.limits import require_representable
from saclab.other_names import unknown_setting
from saclab.refusals import UPDATES, require_known, require_possible, require_prefill, require_ranges
from saclab.reward_schedule import ScheduledTerm, parse_schedule

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


PLAIN_NUMBER = "plain number"
"""Marks a setting that the compiled update takes as an argument, or that reaches it as part of one, as the weights of a
schedule do: another value needs no compilation, and runs that differ in such settings only can be one run group."""
Real = Annotated[float, PLAIN_NUMBER]
Whole = Annotated[int, PLAIN_NUMBER]

Activation = Literal["relu", "tanh", "elu", "silu", "gelu"]
NetworkName = Literal[
    "mlp", "layer_norm_mlp", "batch_norm_mlp", "batch_renorm_mlp", "batch_norm_residual", "hyperspherical"
]  # fmt: skip
Reduction = Literal["minimum", "mean"]


@dataclass(frozen=True)
class AlgorithmSettings:
    """One point in the space of SAC variants. Defaults: Table 1 of the paper, plain SAC."""

    discount: Real = 0.99
    """γ: weight of the next state's value, in [0, 1)."""
    batch_size: int = 256
    """Transitions per update."""
    critic_learning_rate: Real = 3e-4
    """Adam's learning rate for the Q-networks."""
    actor_learning_rate: Real = 3e-4
    """Adam's learning rate for the policy."""
    adam_beta_1: Real = 0.9
    """Decay of Adam's first moment, of all that is trained."""
    adam_beta_2: Real = 0.999
    """Decay of Adam's second moment, of all that is trained."""
    learning_rate_schedule: Literal["constant", "linear", "cosine"] = "constant"
    """How the three learning rates go from their values to `final_learning_rate_share` of them over the run's updates.
    Each counts the steps of its own optimizer: that of a policy with actor_interval n gets 1/n of the way."""
    final_learning_rate_share: Real = 0.0
    """What is left of the learning rates at the end of a schedule, in [0, 1]."""

    network: NetworkName = "mlp"
    """Architecture of the policy, and of the Q-networks unless `critic_network` says another."""
    critic_network: NetworkName | None = None
    """Architecture of the Q-networks; None is `network`."""
    hidden_layers: tuple[int, ...] = (256, 256)
    """Units of each hidden layer of the policy, and of the Q-networks unless `critic_hidden_layers` says others."""
    critic_hidden_layers: tuple[int, ...] | None = None
    """Units of each hidden layer of the Q-networks; None is `hidden_layers`."""
    activation: Activation = "relu"
    """Non-linearity after each hidden layer."""
    initialisation: Literal["network", "xavier"] = "network"
    """How the weights start: as each network has it, or Xavier-uniform with biases of zero."""
    weight_projection: Literal["none", "unit_columns"] = "none"
    """What is done to the weight matrices after each step: nothing, or the weights into each unit are scaled to
    length 1; in a `batch_norm_residual` the scales and biases of each normalisation too, to a mean square of 1."""
    critics: int = 2
    """Q-networks that are trained side by side."""
    critic_dropout: float = 0.0
    """Share of a Q-network's hidden units that are left out at random while it learns: 0, or 2e-5 to 0.99."""
    critic_head: Literal["scalar", "categorical", "quantile"] = "scalar"
    """What a Q-network predicts: a number, a distribution over `critic_atoms` values, or as many quantiles of one."""
    critic_atoms: int = 101
    """Values of the categorical head, evenly spaced from −`critic_bound` to `critic_bound`; quantiles of that head."""
    critic_bound: float = 5.0
    """The largest value that the categorical head can represent."""
    joint_forward: bool = False
    """Whether the critics learn in one pass over (s, a) and (s′, a′), so that batch statistics are those of both."""
    actor_joint_forward: bool = False
    """Whether the policy learns in one pass over s and s′, so that batch statistics are those of both."""

    polyak_rate: Real = 0.005
    """τ: share of the critic that enters its target at each update (Eq. 2)."""
    snapshots: int = 1
    """K: target snapshots over which the next state's value is averaged (Eq. 9). 1 is plain SAC, 0 has no target
    network: the critics themselves value the next state."""
    snapshot_interval: Whole = 1
    """Updates between two target snapshots. 1 is the literal Eq. 9."""
    entropy_window: int = 1
    """Minibatches over which α·log π of the target is averaged row by row, from zeros: what the paper's authors
    ran as "Averaged-SAC". The rows are unrelated to each other; this is not Eq. 9. 1 is plain SAC."""
    target_critics: int | None = None
    """Critics, drawn anew for each update, whose targets value the next state; None is all of them."""
    n_step: int = 1
    """Transitions whose discounted rewards come before the value of the state they lead to, as far as the episode and
    the replay buffer reach. 1 is plain SAC."""
    target_reduction: Literal["minimum", "mean", "truncated"] = "minimum"
    """How the critics are reduced to one Q in the target (Eq. 4); truncated: the quantiles of all of them together,
    without the largest."""
    dropped_quantiles: int = 2
    """Quantiles per critic that the truncated target leaves out."""
    actor_reduction: Reduction = "minimum"
    """How the critics are reduced to one Q in the policy loss (Eq. 5)."""
    critic_mode_for_actor: Literal["evaluation", "training"] = "evaluation"
    """How the critics run in the policy loss: as they act, or as they learn, with dropout and the batch's own
    statistics."""

    update_order: tuple[str, ...] = UPDATES
    """Order of the parts of an update; each sees what those before it have changed."""
    actor_interval: int = 1
    """Updates between two updates of the policy and the temperature."""

    temperature: Literal["fixed", "learned"] = "fixed"
    """Whether α is fixed or learned by dual descent (Eq. 8)."""
    initial_temperature: Real = 0.2
    """α, or its first value if it is learned."""
    temperature_learning_rate: Real = 3e-4
    """Adam's learning rate for log α, if it is learned."""
    temperature_gradient: Literal["log_alpha", "alpha"] = "log_alpha"
    """The factor before (−log π − target entropy) in the temperature loss: log α (the paper's authors,
    Stable-Baselines3) or α itself (Eq. 8 to the letter, CleanRL). Adam moves log α in both cases."""
    target_entropy: Annotated[float | None, PLAIN_NUMBER] = None
    """Entropy that the learned temperature holds the policy to, in nats; None is `target_entropy_per_action` times
    dim(A)."""
    target_entropy_per_action: Real = -1.0
    """Target entropy for each dimension of the action, in nats, if `target_entropy` gives none for all together."""
    log_std_minimum: float = -20.0
    """Lower bound of the policy's log standard deviation."""
    log_std_maximum: float = 2.0
    """Upper bound of the policy's log standard deviation."""
    log_std_bounding: Literal["clip", "tanh"] = "clip"
    """How the policy's log standard deviation is held between its bounds: clipped, or by a tanh that spans them."""

    longest_noise: int = 1
    """Most steps for which one draw of the exploration noise is held; how many, n, is drawn with a probability
    proportional to n⁻². 1 is a draw for each step."""
    observation_normalisation: Literal["none", "running"] = "none"
    """Whether observations are normalised by the running mean and deviation of all that the run has met."""
    reward_terms: tuple[str, ...] = ()
    """Names of reward terms in the `info` of an environment's step; what they leave of the reward is a term too."""
    reward_weights: Annotated[tuple[float, ...], PLAIN_NUMBER] = ()
    """The weight of each of `reward_terms` without a schedule in the reward that is learned from; the remainder's is 1.
    None given: 1 for each. Evaluations always count the environment's own reward."""
    reward_schedule: Annotated[tuple[str, ...], PLAIN_NUMBER] = ()
    """Weights that change as training goes on, a text for each term: 'reward_linvel: 0.2@0.1 1@0.5' weighs it by 0.2 up
    to a tenth of the planned updates, by 1 from half of them on; with points such as 1@return=3000, by the highest mean
    evaluation return so far. Terms that are not among `reward_terms` are added to them."""
    reward_scaling: Literal["none", "deviation", "deviation_or_bound"] = "none"
    """What rewards are divided by when a batch is drawn: nothing, the running standard deviation of the discounted
    return, or the larger of it and the largest discounted return so far divided by `critic_bound`."""

    def __post_init__(self) -> None:
        lists_to_tuples(self)
        object.__setattr__(self, "reward_schedule", tuple(term.text for term in self.scheduled_terms))
        require_representable(vars(self), plain_numbers())
        require_known(self, choices())
        require_ranges(self)
        require_possible(self)

    @property
    def layers_of_critic(self) -> tuple[int, ...]:
        return self.hidden_layers if self.critic_hidden_layers is None else self.critic_hidden_layers

    @property
    def network_of_critic(self) -> NetworkName:
        return self.network if self.critic_network is None else self.critic_network

    @cached_property
    def scheduled_terms(self) -> tuple[ScheduledTerm, ...]:
        return parse_schedule(self.reward_schedule)

    @property
    def terms_of_reward(self) -> tuple[str, ...]:
        """All terms that the reward is split into: those that are named, and those of the schedule."""
        scheduled = (term.name for term in self.scheduled_terms)
        return (*self.reward_terms, *(name for name in scheduled if name not in self.reward_terms))


@dataclass(frozen=True)
class TrainingSettings:
    """How a run goes: how much experience, how many updates, when it is evaluated, when it stops."""

    wrappers: tuple[str, ...] = ()
    """What is put around the environment, the first one innermost: names of gymnasium.wrappers, such as
    FlattenObservation, FlattenAction, or package.module:Name of your own, a class or a function of an environment."""
    parallel_environments: int = 1
    """Training environments stepped in turn. The update-to-data ratio does not depend on it: steps are counted
    over all environments."""
    random_steps: int = 10_000
    """Environment steps with uniformly random actions before the first update."""
    update_interval: int = 1
    """N: environment steps between two rounds of updates."""
    updates_per_interval: int = 1
    """Updates in each round; updates_per_interval / update_interval is the update-to-data ratio."""
    acting_delay: int = 0
    """Rounds of updates by which the policy that acts is behind: 0 is the textbook's, 1 lets the environments be
    stepped while a round is computed, which saves time where there is more than one core."""
    replay_capacity: int = 1_000_000
    """Transitions that the replay buffer holds; the oldest is overwritten."""
    prefill: str | None = None
    """Where the experience comes from that a run begins with: minari:DATASET-ID or replay:RUN-FOLDER for the
    transitions in the replay buffer before the first step, which are no steps of the run; policy:RUN-FOLDER for the
    actions of the random steps, which that run's best policy then chooses."""
    prefill_transitions: int | None = None
    """The most transitions that are taken from a data set or a replay buffer: the newest. None: all that fit."""

    max_steps: int | None = None
    """Stop after so many environment steps."""
    max_updates: int | None = None
    """Stop after so many updates."""
    max_episodes: int | None = None
    """Stop after so many training episodes."""
    patience_episodes: int | None = None
    """Stop after so many training episodes without a better evaluation return."""

    evaluation_interval_episodes: int | None = None
    """Evaluate the policy after so many training episodes."""
    evaluation_interval_steps: int | None = None
    """Evaluate the policy after so many environment steps."""
    evaluation_episodes: int = 10
    """Episodes of one evaluation, with the deterministic policy (tanh of the mean), stepped side by side."""
    q_bias_episodes: int = 0
    """Episodes of the stochastic policy after each evaluation, to estimate the critics' bias from; 0 for none."""
    log_interval: int = 200
    """Updates that are averaged into one line of metrics.jsonl."""

    def __post_init__(self) -> None:
        lists_to_tuples(self)
        require_representable(vars(self), ())
        require(
            isinstance(self.wrappers, tuple) and all(isinstance(name, str) and name for name in self.wrappers),
            "wrappers", self.wrappers, "give a list of names; a class of your own is package.module:Name",
        )  # fmt: skip
        positive = ("parallel_environments", "update_interval", "updates_per_interval", "replay_capacity",
                    "evaluation_episodes", "log_interval")  # fmt: skip
        for name in positive:
            require(getattr(self, name) >= 1, name, getattr(self, name), "use a whole number of at least 1")
        optional = ("max_steps", "max_updates", "max_episodes", "patience_episodes", "prefill_transitions",
                    "evaluation_interval_episodes", "evaluation_interval_steps")  # fmt: skip
        for name in optional:
            value = getattr(self, name)
            require(value is None or value >= 1, name, value, "use a whole number of at least 1, or leave it out")
        require_prefill(self)
        require(self.acting_delay in (0, 1), "acting_delay", self.acting_delay, "use 0 or 1")
        for name in ("random_steps", "q_bias_episodes"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "use 0 or more")
        require(
            bool(self.limits),
            "max_steps", None, "give at least one of max_steps, max_updates and max_episodes",
        )  # fmt: skip
        require(
            (self.evaluation_interval_episodes is None) != (self.evaluation_interval_steps is None),
            "evaluation_interval_episodes", self.evaluation_interval_episodes,
            f"give exactly one of it and evaluation_interval_steps (now {self.evaluation_interval_steps}), "
            "and None for the other",
        )  # fmt: skip

    @property
    def prefill_source(self) -> tuple[str, str] | None:
        """Kind and name of what the run begins with; None if it begins with nothing."""
        if self.prefill is None:
            return None
        kind, _, name = self.prefill.partition(":")
        return kind, name

    @property
    def fills_replay(self) -> bool:
        """Whether there are transitions in the replay buffer before the first step."""
        return self.prefill_source is not None and self.prefill_source[0] != "policy"

    @property
    def update_to_data_ratio(self) -> float:
        """Updates per environment step."""
        return self.updates_per_interval / self.update_interval

    @cached_property
    def limits(self) -> dict[str, int]:
        """What ends a run -> how much of it at most."""
        limits = {"steps": self.max_steps, "updates": self.max_updates, "episodes": self.max_episodes}
        return {name: limit for name, limit in limits.items() if limit is not None}

    def updates_due(self, steps: int) -> int:
        """Updates that should have been made once `steps` environment steps are done."""
        rounds = max(0, steps - self.random_steps) // self.update_interval
        due = rounds * self.updates_per_interval
        return due if self.max_updates is None else min(due, self.max_updates)


Settings = TypeVar("Settings", AlgorithmSettings, TrainingSettings)


def lists_to_tuples(settings: AlgorithmSettings | TrainingSettings) -> None:
    """As Python's users and JSON write lists, for settings that are being made."""
    for name in field_names(type(settings)):
        if isinstance(value := getattr(settings, name), list):
            object.__setattr__(settings, name, tuple(value))


def field_names(settings: type[DataclassInstance]) -> tuple[str, ...]:
    """Names of the settings in a dataclass."""
    return tuple(entry.name for entry in dataclasses.fields(settings))


def replace_settings(settings: Settings, overrides: Mapping[str, Any]) -> Settings:
    """`settings` with some values changed; raises for a name that is not one of its settings."""
    known = field_names(type(settings))
    for name in overrides:
        if name not in known:
            raise unknown_setting(name, known)
    return dataclasses.replace(settings, **overrides)


@lru_cache(maxsize=1)
def choices() -> dict[str, tuple[str | None, ...]]:
    """The values that a setting may have, for each setting of AlgorithmSettings that is a choice between names."""
    found: dict[str, tuple[str | None, ...]] = {}
    for name, hint in get_type_hints(AlgorithmSettings).items():
        for kind in (hint, *get_args(hint)):
            if get_origin(kind) is Literal:
                found[name] = get_args(kind) if kind is hint else (*get_args(kind), None)
    return found


@lru_cache(maxsize=1)
def plain_numbers() -> tuple[str, ...]:
    """Names of the settings that are arguments of the compiled update, or parts of one."""
    hints = get_type_hints(AlgorithmSettings, include_extras=True)
    return tuple(name for name, hint in hints.items() if PLAIN_NUMBER in getattr(hint, "__metadata__", ()))


def structure(settings: AlgorithmSettings) -> AlgorithmSettings:
    """`settings` with all plain numbers at their defaults: what a compiled program depends on.

    Whether α is learned is a plain number too: the learning rate of a fixed one is 0.
    """
    defaults = {name: getattr(AlgorithmSettings, name) for name in plain_numbers()}
    return dataclasses.replace(
        settings, temperature="learned", critic_network=settings.network_of_critic,
        critic_hidden_layers=settings.layers_of_critic, reward_terms=settings.terms_of_reward, **defaults,
    )  # fmt: skip
