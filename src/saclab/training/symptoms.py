"""What in a run's numbers is worth a warning: it goes on, but will hardly learn what its user wants."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from saclab.settings import AlgorithmSettings

SANE_TEMPERATURES = (1e-5, 100.0)
NEAR = 0.9
"""Share of the bound of a categorical critic from which on values are about to be cut off."""

Means = Mapping[str, float]
"""Metric -> its mean over a window of updates."""


def strange_temperature(settings: AlgorithmSettings, means: Means) -> str:
    """A learned temperature that explodes or collapses."""
    low, high = SANE_TEMPERATURES
    temperature = means["temperature"]
    if settings.temperature == "fixed" or low < temperature < high:
        return ""
    advice = (
        "the policy cannot reach the target entropy: lower --target-entropy"
        if temperature >= high
        else "the policy stays above the target entropy without any bonus: raise --target-entropy"
    )
    return (
        f"the temperature is {temperature:.3g}, outside {low:g} to {high:g}: {advice}, or lower "
        "--temperature-learning-rate, or scale the environment's rewards"
    )


def values_at_the_bound(settings: AlgorithmSettings, means: Means) -> str:
    """A categorical critic whose values come near the largest that it can represent."""
    value, bound = means["q_mean"], settings.critic_bound
    within = settings.reward_scaling == "deviation_or_bound"  # the largest return lies at the bound then
    if settings.critic_head != "categorical" or within or abs(value) < NEAR * bound:
        return ""
    scale = ", or scale rewards with --reward-scaling deviation_or_bound" if settings.reward_scaling == "none" else ""
    return (
        f"the critics' mean value is {value:.3g}, and the categorical head cuts off what lies beyond {bound:g}: raise "
        f"--critic-bound{scale}"
    )


SYMPTOMS: dict[str, Callable[[AlgorithmSettings, Means], str]] = {
    "temperature": strange_temperature,
    "critic bound": values_at_the_bound,
}
"""Name -> what is to be said, or nothing."""
