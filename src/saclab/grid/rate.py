"""How fast a run goes, and how long it will take."""

from __future__ import annotations


class RateMeter:
    """Updates per second and time left, since the first update of this session: compilation is not in the rate."""

    def __init__(self) -> None:
        self.began: tuple[float, float, int] | None = None
        """Clock, fraction and updates when the first update had been made."""
        self.updates_per_second = 0.0
        self.seconds_left: float | None = None

    def enter(self, seconds: float, fraction: float, updates: int) -> None:
        """Take in how far the run is.

        Args:
            seconds: a clock that only goes forward.
            fraction: share of the whole run that is done.
            updates: made so far, earlier sessions counted in.
        """
        if self.began is None:
            self.began = (seconds, fraction, updates) if updates > 0 else None
            return
        began, first_fraction, first_updates = self.began
        if seconds > began and fraction > first_fraction:
            self.updates_per_second = (updates - first_updates) / (seconds - began)
            self.seconds_left = (1 - fraction) * (seconds - began) / (fraction - first_fraction)
