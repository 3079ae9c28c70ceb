"""Two policies on the same problems with the same seeds, and how long problems stay unsolved: over all trials."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from operator import attrgetter
from typing import Any

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.lazy import LazyModule
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import TrialGroup, mean_interval, wilson_interval

stats: Any = LazyModule("scipy.stats")


@dataclass(frozen=True, kw_only=True)
class Paired:
    """Paired comparison of two policies on the same problems, seeds and levels of noise."""

    pairs: int  #: Number of trials that they have in common
    only_first: int  #: Those in which only the first succeeded
    only_second: int  #: Those in which only the second did
    success_p: float  #: Probability that equals differ so much in successes: McNemar's exact test, two-sided
    difference: float  #: Median of the first's cost less the second's
    cost_p: float  #: The same for the costs: Wilcoxon's signed-rank test, two-sided


def paired(
    first: Sequence[Trial],
    second: Sequence[Trial],
    cost: Callable[[Trial], float],
    succeeded: Callable[[Trial], bool] = attrgetter("success"),
) -> Paired:
    """Compare two policies by the trials that they have in common.

    Args:
        first: Trials of one policy.
        second: Trials of another.
        cost: Cost, such as steps to the first solution with twice the budget for none.
        succeeded: Criterion of success; by default that everyone arrived and nothing was touched. A plan that touches
            nothing and does not keep the margin is no solution.

    Raises:
        ValueError: If they have none in common.
    """
    common = in_common(first, second)
    if not common:
        raise ValueError("the two policies have no problem, seed and noise in common; give trials of the same study")
    wins = [(succeeded(one), succeeded(other)) for one, other in common]
    only_first = sum(one and not other for one, other in wins)
    only_second = sum(other and not one for one, other in wins)
    differences = np.array([cost(one) - cost(other) for one, other in common])
    moved = differences[differences != 0]
    return Paired(
        pairs=len(common),
        only_first=only_first,
        only_second=only_second,
        success_p=mcnemar(only_first, only_second),
        difference=float(np.median(differences)),
        cost_p=float(stats.wilcoxon(moved).pvalue) if len(moved) else 1.0,
    )


def in_common(first: Sequence[Trial], second: Sequence[Trial]) -> list[tuple[Trial, Trial]]:
    """Pairs of trials of two policies with the same problem, seed, noise, disturbances and physics."""
    others = {_circumstances(trial): trial for trial in second}
    return [(trial, others[_circumstances(trial)]) for trial in first if _circumstances(trial) in others]


def mcnemar(only_first: int, only_second: int) -> float:
    """Return the p-value of two policies' successes on the same trials, two-sided.

    Q. McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 12, 1947;
    exact, by the binomial distribution.
    """
    apart = only_first + only_second
    return float(stats.binomtest(only_first, apart).pvalue) if apart else 1.0


def _circumstances(trial: Trial) -> tuple[str, float, int, str, str]:
    return trial.problem, trial.control_noise_std, trial.seed, trial.disturbances, trial.physics


@dataclass(frozen=True, kw_only=True)
class PairedPolicies:
    """Paired comparison of two policies under one condition, by trials with the same problem and seed.

    The first six fields are those of :class:`~d4orm_planners.evaluation.summary.Compared`.
    """

    scenario: str
    num_robots: int
    model: str
    control_noise_std: float
    disturbance: str
    level: float | None
    first: str  #: A policy's label
    second: str  #: Another's
    trials: int  #: Pairs of trials
    only_first: int  #: Pairs in which only the first succeeded
    only_second: int  #: Those in which only the second did
    p_value: float  #: That rates of success are equal, two-sided: :func:`mcnemar`
    difference: float  #: Success rate of the first less that of the second
    lower: float  #: Lower end of its 95% confidence interval: :func:`newcombe_interval`
    upper: float  #: Upper end
    slower: float | None  #: Mean of how much longer the first travelled where both succeeded [s]; ``None`` without any
    slower_lower: float | None  #: Lower end of its 95% confidence interval (Student's t); ``None`` with fewer than two
    slower_upper: float | None  #: Upper end


def compare_pairs(groups: Iterable[TrialGroup]) -> list[PairedPolicies]:
    """Every two policies that have trials under the same condition with the same problems and seeds."""
    cells: dict[tuple[object, ...], list[TrialGroup]] = {}
    for group in groups:
        one = group.trials[0]
        cell = (one.scenario, one.num_robots, one.model, one.control_noise_std, group.disturbance, group.level)
        cells.setdefault(cell, []).append(group)
    return [pair for group in cells.values() for two in combinations(group, 2) if (pair := _compared(*two)) is not None]


def _compared(first: TrialGroup, second: TrialGroup) -> PairedPolicies | None:
    common = in_common(first.trials, second.trials)
    if not common:
        return None
    won = np.array([(one.success, other.success) for one, other in common], float)
    only_first, only_second = int((won[:, 0] > won[:, 1]).sum()), int((won[:, 0] < won[:, 1]).sum())
    both = [pair for pair in common if all(trial.success for trial in pair)]
    slower = [(one.travel_time or 0.0) - (other.travel_time or 0.0) for one, other in both]
    neither = len(common) - only_first - only_second - len(both)
    lower, upper = newcombe_interval(len(both), only_first, only_second, neither)
    mean_slower, slower_lower, slower_upper = mean_interval(slower)
    trial = first.trials[0]
    return PairedPolicies(
        **{name: getattr(trial, name) for name in ("scenario", "num_robots", "model", "control_noise_std")},
        disturbance=first.disturbance,
        level=first.level,
        first=first.label,
        second=second.label,
        trials=len(common),
        only_first=only_first,
        only_second=only_second,
        p_value=mcnemar(only_first, only_second),
        difference=float((won[:, 0] - won[:, 1]).mean()),
        lower=lower,
        upper=upper,
        slower=mean_slower,
        slower_lower=slower_lower,
        slower_upper=slower_upper,
    )


def newcombe_interval(both: int, only_first: int, only_second: int, neither: int) -> tuple[float, float]:
    """95% confidence interval of the difference of two policies' success rates on the same trials.

    Method 10 of R. G. Newcombe, "Improved confidence intervals for the difference between binomial proportions based
    on paired data", Statistics in Medicine 17, 1998. It has a width too where all trials agree.
    """
    n = both + only_first + only_second + neither
    rates, lows, highs = zip(*((k / n, *wilson_interval(k, n)) for k in (both + only_first, both + only_second)))
    cross = both * neither - only_first * only_second
    spread = np.prod([rate * (1 - rate) for rate in rates]) ** 0.5 * n**2
    phi = (max(cross - n / 2, 0) if cross > 0 else cross) / spread if spread else 0.0
    difference, below, above = rates[0] - rates[1], np.subtract(rates, lows), np.subtract(highs, rates)

    def half_width(one: float, other: float) -> float:
        return max(one**2 - 2 * phi * one * other + other**2, 0) ** 0.5

    return float(difference - half_width(below[0], above[1])), float(difference + half_width(above[0], below[1]))


@dataclass(frozen=True, eq=False)
class Survival:
    """The share of trials without a solution, by what was spent on them."""

    costs: Floats  #: ``(n,)`` rising costs at which some trial was solved
    unsolved: Floats  #: ``(n,)`` share that is left from then on
    lower: Floats  #: ``(n,)`` lower end of its 95% interval (Wilson)
    upper: Floats  #: ``(n,)`` upper end


def survival(costs: Sequence[float | None]) -> Survival:
    """Return the survival curve of trials with the same budget: how many are unsolved when so much has been spent.

    Args:
        costs: Of every trial what its solution cost; ``None`` without one.

    Raises:
        ValueError: If there are no trials.
    """
    if not costs:
        raise ValueError("there are no trials; give at least one")
    solved, counts = np.unique([cost for cost in costs if cost is not None], return_counts=True)
    left = len(costs) - np.cumsum(counts)
    ends = np.array([wilson_interval(int(number), len(costs)) for number in left]).reshape(-1, 2)
    return Survival(solved.astype(np.float64), left / len(costs), ends[:, 0], ends[:, 1])
