"""Robustness: how often policies succeed when their controls are executed with noise."""

from __future__ import annotations

import os
from collections.abc import Iterable

from d4orm_env.core.arrays import whole_number
from d4orm_planners.evaluation.cells import Policies
from d4orm_planners.evaluation.harness import Progress, measure
from d4orm_planners.evaluation.summary import SuccessRate

NOISE = (0.0, 0.05, 0.1, 0.2)


def robustness(
    policies: Policies,
    out: str | os.PathLike[str],
    *,
    scenarios: Iterable[str] = ("circle",),
    robots: Iterable[int | None] = (None,),
    noise: Iterable[float] = NOISE,
    trials: int = 50,
    model: str | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> list[SuccessRate]:
    """Run every policy on every scenario and team size, ``trials`` times at every level of noise.

    An :func:`~d4orm_planners.evaluation.harness.evaluate` of seeds from 0 up that writes nothing but the store: a call
    that was broken off, or one with more trials, goes on from there.

    Args:
        policies: Policies, or policies and settings by label; see :func:`~d4orm_planners.evaluation.harness.evaluate`.
        out: Folder to keep the trials in; made if it does not exist.
        scenarios: Scenario names, or YAML scenario files.
        robots: Team sizes; ``None`` is the scenario's own.
        noise: Standard deviations of the Gaussian noise added to the controls, in their units.
        trials: Trials per policy, scenario, team size and level of noise.
        model: Robot model; ``None`` is the scenario's own.
        workers: Processes; by default as many as there are cores.
        progress: Called as ``progress(what, trials done, trials in all)``.

    Returns:
        One row per scenario, team size, policy and level of noise, in that order.

    Raises:
        ValueError: For an unknown name, a number that makes no sense, or a store that is something else. Nothing has
            run then.
        ImportError: If a policy needs a library that is not installed.
        OSError: If the folder or the store cannot be used, or workers do not start.
    """
    return measure(
        policies,
        scenarios,
        out=out,
        seeds=range(whole_number(trials, "trials", 1)),
        control_noise_std=noise,
        num_robots=robots,
        model=model,
        workers=workers,
        progress=progress,
    )
