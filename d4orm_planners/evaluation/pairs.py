"""Two policies that met the same seeds, compared trial by trial."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from d4orm_planners.evaluation.comparison import in_common, mcnemar
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import TrialGroup

_RESAMPLES = 2000


@dataclass(frozen=True, kw_only=True)
class PairedPolicies:
    """How two policies differ under one condition, by trials with the same problem and seed.

    Attributes:
        scenario: Scenario name.
        num_robots: Team size.
        model: Models of the team.
        control_noise_std: Standard deviation of the execution noise, in the controls' units.
        disturbance: What else went wrong; empty for nothing.
        level: How much of it.
        first: A policy's label.
        second: Another's.
        trials: Pairs of trials.
        only_first: Pairs in which only the first succeeded.
        only_second: Those in which only the second did.
        p_value: That rates of success are equal, two-sided: :func:`~d4orm_planners.evaluation.comparison.mcnemar`.
        difference: Success rate of the first less that of the second.
        lower: Lower end of its 95% confidence interval, by a paired bootstrap (percentiles).
        upper: Upper end.
        slower: Mean of how much longer the first travelled where both succeeded [s]; ``None`` without any.
        slower_lower: Lower end of its interval, likewise; ``None`` with fewer than two.
        slower_upper: Upper end.
    """

    scenario: str
    num_robots: int
    model: str
    control_noise_std: float
    disturbance: str
    level: float | None
    first: str
    second: str
    trials: int
    only_first: int
    only_second: int
    p_value: float
    difference: float
    lower: float
    upper: float
    slower: float | None
    slower_lower: float | None
    slower_upper: float | None


def compare_pairs(groups: Iterable[TrialGroup]) -> list[PairedPolicies]:
    """Every two policies that have trials under the same condition with the same problems and seeds."""
    cells: dict[tuple[object, ...], list[TrialGroup]] = {}
    for group in groups:
        one = group.trials[0]
        cell = (one.scenario, one.num_robots, one.model, one.control_noise_std, group.disturbance, group.level)
        cells.setdefault(cell, []).append(group)
    return [pair for group in cells.values() for two in combinations(group, 2) if (pair := _compared(*two)) is not None]


def _compared(first: TrialGroup, second: TrialGroup) -> PairedPolicies | None:
    met = in_common(first.trials, second.trials)
    if not met:
        return None
    won = np.array([(one.success, other.success) for one, other in met], float)
    only_first, only_second = int((won[:, 0] > won[:, 1]).sum()), int((won[:, 0] < won[:, 1]).sum())
    slower = [_time(one) - _time(other) for one, other in met if one.success and other.success]
    trial, lower, upper = first.trials[0], *_bootstrap(won[:, 0] - won[:, 1])
    slower_lower, slower_upper = _bootstrap(slower) if len(slower) > 1 else (None, None)
    return PairedPolicies(
        scenario=trial.scenario,
        num_robots=trial.num_robots,
        model=trial.model,
        control_noise_std=trial.control_noise_std,
        disturbance=first.disturbance,
        level=first.level,
        first=first.label,
        second=second.label,
        trials=len(met),
        only_first=only_first,
        only_second=only_second,
        p_value=mcnemar(only_first, only_second),
        difference=float((won[:, 0] - won[:, 1]).mean()),
        lower=lower,
        upper=upper,
        slower=float(np.mean(slower)) if slower else None,
        slower_lower=slower_lower,
        slower_upper=slower_upper,
    )


def _time(trial: Trial) -> float:
    return trial.travel_time or 0.0


def _bootstrap(differences: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """95% confidence interval of the mean of paired differences."""
    from scipy import stats

    values = np.asarray(differences, float)
    if len(values) < 2 or not np.ptp(values):
        return float(values[0]), float(values[0])
    found = stats.bootstrap(
        (values,), np.mean, n_resamples=_RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)
