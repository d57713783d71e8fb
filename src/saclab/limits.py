"""The largest values of anything: what the arithmetic holds, what can be counted, what a machine can start."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from saclab.errors import SettingError

SMALLEST_FLOAT, LARGEST_FLOAT = 1.2e-38, 3.4e38
"""The range of 32-bit numbers, without loss."""
LARGEST_INDEX, LARGEST_COUNT = 2**31 - 1, 2**53
"""The largest of what is compiled, and of what is counted."""
MOST = {
    "parallel_environments": 100_000,
    "evaluation_episodes": 100_000,
    "q_bias_episodes": 100_000,
    "longest_noise": 10_000,
    "n_step": 1000,
    "actor_interval": LARGEST_INDEX,
}
"""Setting -> its largest value, where each one more is made or gone through one by one, or where it is compiled."""
MOST_THREADS = 4096


def require_representable(settings: Mapping[str, object], indices: Collection[str]) -> None:
    """Refuse a number that nothing could hold; whether it makes sense is another question.

    Args:
        settings: name -> value.
        indices: names of the whole numbers that are compiled as such.

    Raises:
        SettingError: for the first that cannot be held.
    """
    for name, value in settings.items():
        most = MOST.get(name, LARGEST_INDEX if name in indices else LARGEST_COUNT)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and number > most:
                raise SettingError(name, value, f"use whole numbers of at most {most}")
            if isinstance(number, float) and not (number == 0 or SMALLEST_FLOAT <= abs(number) <= LARGEST_FLOAT):
                way_out = f"use finite numbers, 0 or of a size from {SMALLEST_FLOAT:g} to {LARGEST_FLOAT:g}"
                raise SettingError(name, value, way_out)


def require_threads(threads: int | None) -> None:
    """Raise SettingError for a number of threads that nothing can start; None leaves it to the machine."""
    if threads is not None and not 1 <= threads <= MOST_THREADS:
        raise SettingError("threads", threads, f"use at least 1 and at most {MOST_THREADS}")


def require_minutes(checkpoint_minutes: float) -> None:
    """Raise SettingError unless a time between checkpoints is one; it may be infinite."""
    if not checkpoint_minutes >= 0:
        way_out = "use a number of at least 0, such as 10, or inf for no checkpoint before the end"
        raise SettingError("checkpoint_minutes", checkpoint_minutes, way_out)
