"""Two policies on the same problems with the same seeds, and how long problems stay unsolved: over all trials."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import wilson_interval


@dataclass(frozen=True, kw_only=True)
class Paired:
    """What two policies made of the same problems, seeds and levels of noise.

    Attributes:
        pairs: How many trials they have in common.
        only_first: Those in which only the first succeeded.
        only_second: Those in which only the second did.
        success_p: How likely it is that two equally good policies differ so much in successes: McNemar's exact test,
            two-sided.
        difference: Median of the first's cost less the second's.
        cost_p: The same for the costs: Wilcoxon's signed-rank test, two-sided.
    """

    pairs: int
    only_first: int
    only_second: int
    success_p: float
    difference: float
    cost_p: float


def paired(first: Sequence[Trial], second: Sequence[Trial], cost: Callable[[Trial], float]) -> Paired:
    """Compare two policies by the trials that they have in common.

    Args:
        first: Trials of one policy.
        second: Trials of another.
        cost: What counts, less being better, such as steps to the first solution with twice the budget for none.

    Raises:
        ValueError: If they have none in common.
    """
    from scipy import stats  # takes a second to import

    common = in_common(first, second)
    if not common:
        raise ValueError("the two policies have no problem, seed and noise in common; give trials of the same study")
    only_first = sum(one.success and not other.success for one, other in common)
    only_second = sum(other.success and not one.success for one, other in common)
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
    """How likely it is that two equally good policies differ so much in successes on the same trials, two-sided.

    Q. McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 12, 1947;
    exact, by the binomial distribution.

    Args:
        only_first: Trials in which only the first succeeded.
        only_second: Those in which only the second did.
    """
    from scipy import stats  # takes a second to import

    apart = only_first + only_second
    return float(stats.binomtest(only_first, apart).pvalue) if apart else 1.0


def _circumstances(trial: Trial) -> tuple[str, float, int, str, str]:
    return trial.problem, trial.control_noise_std, trial.seed, trial.disturbances, trial.physics


def steps_to_solution(trial: Trial) -> int | None:
    """Denoising steps of a sampling planner's solve that ended with its first solution; ``None`` if it found none."""
    if trial.status != "solved" or not trial.iterations:
        return None
    return trial.iterations * int(json.loads(trial.config)["num_steps"])


def penalised_steps(trial: Trial) -> int:
    """:func:`steps_to_solution`, and twice all the steps that there were where it found none (PAR-2)."""
    steps, config = steps_to_solution(trial), json.loads(trial.config)
    return 2 * int(config["num_steps"] * config["max_iterations"]) if steps is None else steps


@dataclass(frozen=True, eq=False)
class Survival:
    """The share of trials without a solution, by what was spent on them.

    Attributes:
        costs: ``(n,)`` rising costs at which some trial was solved.
        unsolved: ``(n,)`` share that is left from then on.
        lower: ``(n,)`` lower end of its 95% interval (Wilson).
        upper: ``(n,)`` upper end.
    """

    costs: Floats
    unsolved: Floats
    lower: Floats
    upper: Floats


def survival(costs: Sequence[float | None]) -> Survival:
    """How many trials are still unsolved when so much has been spent, of trials with the same budget.

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
