"""Statistics of repeated trials."""

from __future__ import annotations

from math import sqrt

Z_95 = 1.959963984540054
"""The 97.5% quantile of the standard normal distribution."""


def wilson_interval(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Confidence interval of a success rate (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Unlike the normal approximation it stays inside [0, 1] and says something at 0 and at all successes.

    Args:
        successes: How many succeeded.
        trials: Out of how many.
        z: Half-width in standard deviations; 95% by default.

    Returns:
        Lower and upper end; ``(0, 1)`` without trials.

    Raises:
        ValueError: If there are more successes than trials, or fewer than none.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes is {successes}; it must lie between 0 and the number of trials, {trials}")
    if trials == 0:
        return 0.0, 1.0
    rate, weight = successes / trials, z * z / trials
    centre = (rate + weight / 2) / (1 + weight)
    half_width = sqrt(weight * (rate * (1 - rate) + weight / 4)) / (1 + weight)
    # The two ends that are exact come out exact, whatever the rounding.
    lower = 0.0 if successes == 0 else centre - half_width
    return lower, 1.0 if successes == trials else centre + half_width
