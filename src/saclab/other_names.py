"""What other libraries call the settings, for users who come from one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from saclab.errors import UserError, shown, unknown_name

OTHER_NAMES: dict[str, tuple[str, ...]] = {
    "activation_fn": ("activation",),
    "alpha": ("initial_temperature", "temperature"),
    "autotune": ("temperature",),
    "buffer_size": ("replay_capacity",),
    "dropout_rate": ("critic_dropout",),
    "ent_coef": ("initial_temperature", "temperature"),
    "eval_episodes": ("evaluation_episodes",),
    "eval_freq": ("evaluation_interval_steps",),
    "gamma": ("discount",),
    "gradient_steps": ("updates_per_interval",),
    "learning_rate": ("actor_learning_rate", "critic_learning_rate", "temperature_learning_rate"),
    "learning_starts": ("random_steps",),
    "lr": ("actor_learning_rate", "critic_learning_rate", "temperature_learning_rate"),
    "n_critics": ("critics",),
    "n_envs": ("parallel_environments",),
    "n_eval_episodes": ("evaluation_episodes",),
    "net_arch": ("hidden_layers",),
    "num_envs": ("parallel_environments",),
    "pi_lr": ("actor_learning_rate",),
    "policy_delay": ("actor_interval",),
    "policy_frequency": ("actor_interval",),
    "policy_lr": ("actor_learning_rate",),
    "q_lr": ("critic_learning_rate",),
    "start_steps": ("random_steps",),
    "tau": ("polyak_rate",),
    "total_timesteps": ("max_steps",),
    "train_freq": ("update_interval",),
    "utd_ratio": ("update_interval", "updates_per_interval"),
}
"""A setting's name in Stable-Baselines3, CleanRL, Tianshou or Spinning Up -> the settings that say it here."""


def unknown_setting(name: str, known: Iterable[str]) -> UserError:
    """The error for a setting that does not exist; tells what saclab calls it, or the nearest name."""
    if name in OTHER_NAMES:
        return UserError(f"unknown setting {shown(name)}: here it is {', '.join(OTHER_NAMES[name])}")
    return unknown_name("setting", name, known)


def require_own_names(words: Sequence[str]) -> None:
    """Raise UserError for the first option among words of a command line that has another library's name."""
    for word in words:
        name = word.partition("=")[0].removeprefix("--").replace("-", "_")
        if word.startswith("--") and name in OTHER_NAMES:
            here = ", ".join("--" + own.replace("_", "-") for own in OTHER_NAMES[name])
            raise UserError(f"unknown option {word.partition('=')[0]}: here it is {here}")
