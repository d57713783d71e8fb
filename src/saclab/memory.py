"""Forecast of a run's memory: what its settings decide of it, before anything is allocated."""

from __future__ import annotations

from typing import NamedTuple

from saclab.algorithm.heads import HEADS
from saclab.algorithm.networks import critic_network
from saclab.algorithm.policy import make_policy
from saclab.config import Config
from saclab.errors import SettingError
from saclab.machine import available_memory
from saclab.replay import RowLayout, replay_bytes
from saclab.settings import AlgorithmSettings

GIB = 2**30
BYTES = 4  # of a number


class Needed(NamedTuple):
    """Bytes of one run."""

    replay: int
    """A full replay buffer."""
    networks: int
    """Weights, both moments of Adam, target snapshots, and the larger gradient."""
    batch: int
    """What an update keeps of a minibatch on its way through the networks, and the ring of entropy terms."""


def needed_memory(config: Config, layout: RowLayout) -> Needed:
    """What a run needs at least: XLA's own temporary arrays come on top."""
    settings = config.algorithm
    return Needed(
        replay_bytes(config.training.replay_capacity, layout),
        BYTES * network_numbers(settings, layout),
        BYTES * batch_numbers(settings, layout),
    )


def network_numbers(settings: AlgorithmSettings, layout: RowLayout) -> int:
    """Numbers that belong to the networks; those of a `LearnerState` and of a gradient."""
    actor = make_policy(settings, layout.observation_size, layout.action_size).network.size
    inputs = layout.observation_size + layout.action_size
    critic = settings.critics * critic_network(settings, inputs, head_outputs(settings)).size
    return 3 * (actor + critic) + settings.snapshots * critic + max(actor, critic)


def batch_numbers(settings: AlgorithmSettings, layout: RowLayout) -> int:
    """Numbers that exist together in the larger of the critics' and the policy's update, of one minibatch.

    A network that learns keeps all its layers and has as many gradients; of a target network, the widest exists.
    """
    size, critics = settings.batch_size, settings.critics
    widths = (*settings.layers_of_critic, head_outputs(settings))
    rows = 2 * size if settings.joint_forward else size
    valuing = settings.target_critics or critics
    of_critics = critics * rows * 2 * sum(widths) + valuing * rows * settings.snapshots * max(widths)
    if settings.critic_head == "categorical":
        of_critics += size * settings.critic_atoms**2  # the distance of each value from each
    if settings.critic_head == "quantile":
        of_target = settings.critic_atoms
        if settings.target_reduction == "truncated":
            of_target = valuing * (settings.critic_atoms - settings.dropped_quantiles)
        of_critics += critics * size * settings.critic_atoms * of_target  # of each quantile from each of the target
    rows = 2 * size if settings.actor_joint_forward else size
    of_policy = 2 * (rows * sum((*settings.hidden_layers, 2 * layout.action_size)) + critics * size * sum(widths))
    windows = size * settings.n_step * layout.width if settings.n_step > 1 else 0
    return max(of_critics, of_policy) + settings.entropy_window * size + windows


def head_outputs(settings: AlgorithmSettings) -> int:
    return HEADS[settings.critic_head](settings).outputs


WAYS_OUT = {
    "replay": "use --replay-capacity {fits} or less",
    "networks": "use smaller --hidden-layers, or fewer --critics or --snapshots",
    "batch": "use a smaller --batch-size, --hidden-layers, --critic-atoms, --n-step or --entropy-window",
}


def require_memory(
    config: Config, layout: RowLayout, runs_at_once: int = 1, fewer: str = "--workers", available: int | None = None
) -> None:
    """Refuse a run that memory cannot hold once its replay buffer is full, by the largest part of what it needs.

    Args:
        config: of the run.
        layout: of a transition.
        runs_at_once: each needs as much.
        fewer: the option that would lower their number.
        available: bytes; None for the machine's free memory.
    """
    needed, available = needed_memory(config, layout), available or available_memory()
    total = runs_at_once * sum(needed)
    if available is None or total <= available:
        return
    capacity, settings = config.training.replay_capacity, config.algorithm
    setting, value, what = {
        "replay": ("replay_capacity", capacity, f"{capacity} transitions of {layout.width} numbers"),
        "networks": ("hidden_layers", settings.hidden_layers, "the networks, Adam's moments and target networks"),
        "batch": ("batch_size", settings.batch_size, "the networks' layers for a minibatch"),
    }[largest := max(needed._fields, key=lambda part: getattr(needed, part))]
    share = getattr(needed, largest)
    rest = available / runs_at_once - (sum(needed) - share)
    fits = max(0, int(0.8 * rest / share * capacity))
    way_out = WAYS_OUT[largest].format(fits=fits) if fits or largest != "replay" else WAYS_OUT["networks"]
    together = f" in each of {runs_at_once} runs at once" if runs_at_once > 1 else ""
    parts = f"; with the rest {in_gib(total)}" if sum(needed) - share > GIB / 100 else ""
    raise SettingError(
        setting, value,
        f"{what}{together} take {in_gib(runs_at_once * share)}{parts}, and {in_gib(available)} are free: "
        f"{way_out}" + (f" or a smaller {fewer}" if runs_at_once > 1 else ""),
    )  # fmt: skip


def in_gib(size: int) -> str:
    return f"{size / GIB:,.2f} GiB"
