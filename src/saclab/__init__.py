"""saclab: a laboratory for Soft Actor-Critic."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from saclab.api import Comparison, compare, events, resume, train
    from saclab.errors import TrainingFailed, UserError
    from saclab.trackers.asked import Tracking
    from saclab.trained_policy import TrainedPolicy, load_policy
    from saclab.training.events import (
        EpisodeEnded,
        Evaluated,
        Finished,
        Interrupted,
        Progress,
        Saved,
        Started,
        UpdatesLogged,
        Warned,
    )
    from saclab.training.requests import Requests
    from saclab.training.run_folder import RunRecord, read_run
    from saclab.tuning.tune import Tuned, tune

__all__ = [
    "Comparison", "EpisodeEnded", "Evaluated", "Finished", "Interrupted", "Progress", "Requests", "RunRecord", "Saved",
    "Started", "Tracking", "TrainedPolicy", "TrainingFailed", "Tuned", "UpdatesLogged", "UserError", "Warned",
    "compare", "events", "load_policy", "read_run", "resume", "train", "tune",
]  # fmt: skip

_HOMES = {
    "saclab.api": ("Comparison", "compare", "events", "resume", "train"),
    "saclab.errors": ("TrainingFailed", "UserError"),
    "saclab.trackers.asked": ("Tracking",),
    "saclab.trained_policy": ("TrainedPolicy", "load_policy"),
    "saclab.training.events": (
        "EpisodeEnded", "Evaluated", "Finished", "Interrupted", "Progress", "Saved", "Started", "UpdatesLogged",
        "Warned",
    ),
    "saclab.training.requests": ("Requests",),
    "saclab.training.run_folder": ("RunRecord", "read_run"),
    "saclab.tuning.tune": ("Tuned", "tune"),
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import on first use, so that `import saclab` and `saclab --help` do not wait for JAX."""
    from importlib import import_module
    from importlib.metadata import version

    if name == "__version__":
        return version("saclab")
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'saclab' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
