"""Statistics of repeated trials."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

Z_95 = 1.959963984540054
"""The 97.5% quantile of the standard normal distribution."""


_T_95 = (12.706204736, 4.302652730, 3.182446305, 2.776445105, 2.570581836, 2.446911851, 2.364624252, 2.306004135)
"""The 97.5% quantiles of Student's t distribution with 1, 2, ... degrees of freedom."""


def t_quantile(degrees: int) -> float:
    """The 97.5% quantile of Student's t distribution, exact to four digits or more.

    Args:
        degrees: Of freedom, at least one.
    """
    if degrees <= len(_T_95):
        return _T_95[degrees - 1]
    # Abramowitz and Stegun, 26.7.5.
    z, v = Z_95, float(degrees)
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / v**power for power, term in enumerate(terms, 1))


def mean_interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Mean of a sample, and its 95% confidence interval by Student's t.

    Returns:
        Mean, lower and upper end; the ends are ``None`` for fewer than two values, and the mean for none.
    """
    if not values:
        return None, None, None
    mean = float(np.mean(values))
    if len(values) == 1:
        return mean, None, None
    reach = t_quantile(len(values) - 1) * float(np.std(values, ddof=1)) / sqrt(len(values))
    return mean, mean - reach, mean + reach


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
