"""Robustness: how often policies succeed when their controls are executed with noise."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from d4orm_env.core.arrays import positive_number, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.engine.threads import available_cores
from d4orm_env.scenarios import make_problem
from d4orm_planners.evaluation.statistics import wilson_interval
from d4orm_planners.evaluation.store import Trial, TrialStore
from d4orm_planners.evaluation.trials import Job, run_jobs
from d4orm_planners.registry import make_policy

STORE = "trials.sqlite"
NOISE = (0.0, 0.05, 0.1, 0.2)
Progress = Callable[[str, int, int], Any]


@dataclass(frozen=True)
class SuccessRate:
    """How often a policy succeeded at one level of noise.

    Attributes:
        policy: Registry name.
        scenario: Scenario name.
        robots: Team size.
        model: Models of the team.
        noise: Standard deviation of the execution noise, in the controls' units.
        trials: Trials, those with an error included.
        successes: Those in which everyone arrived in time and none was ever in contact.
        contacts: Those in which robots touched something.
        late: Those in which somebody did not arrive in time.
        errors: Those that raised an error; they count as failures.
        lower: Lower end of the 95% confidence interval of the success rate (Wilson).
        upper: Upper end.
        travel_time: Mean over the successes of the mean arrival time [s]; ``None`` without any.
        wall_time: Median seconds of planning, or of choosing all actions, in a trial; ``None`` if all raised errors.
        error: The first error.
    """

    policy: str
    scenario: str
    robots: int
    model: str
    noise: float
    trials: int
    successes: int
    contacts: int
    late: int
    errors: int
    lower: float
    upper: float
    travel_time: float | None
    wall_time: float | None
    error: str

    @property
    def rate(self) -> float:
        return self.successes / self.trials


def robustness(
    policies: Mapping[str, Mapping[str, Any]] | Iterable[str],
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

    Trial ``s`` has seed ``s``: of the scenario, of the policy and of the noise. Trials are stored in
    ``out/trials.sqlite`` as they finish. Those found there are not run again, so that a call that was broken off, or
    one with more trials, goes on from there; those that raised an error are.

    Args:
        policies: Policy names, or settings by policy name; see :func:`d4orm_planners.list_policies`.
        out: Folder to keep the trials in; made if it does not exist.
        scenarios: Scenario names.
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
        OSError: If the folder or the store cannot be used, or a worker process dies.
    """
    settings = policies if isinstance(policies, Mapping) else {name: {} for name in policies}
    levels = tuple(dict.fromkeys(positive_number(level, "noise", zero_allowed=True) for level in noise))
    whole_number(trials, "trials", 1)
    workers = available_cores() if workers is None else whole_number(workers, "workers", 1)
    for name, values in (("policies", settings), ("noise", levels)):
        if not values:
            raise ValueError(f"{name} is empty; give at least one")
    for policy, given in settings.items():
        make_policy(policy, **given)
    cells = [
        [make_problem(scenario, num_robots=size, seed=seed, model=model) for seed in range(trials)]
        for scenario in dict.fromkeys(scenarios)
        for size in dict.fromkeys(robots)
    ]
    if not cells:
        raise ValueError("scenarios or robots is empty; give at least one of each")
    Path(out).mkdir(parents=True, exist_ok=True)
    store = TrialStore(Path(out) / STORE)
    groups = [_jobs(name, given, problems, levels) for problems in cells for name, given in settings.items()]
    _run_missing([job for group in groups for job in group], store, workers, progress or _silent)
    stored = {trial.key: trial for trial in store.trials()}
    return [
        success_rate([stored[job.keys[index]] for job in group]) for group in groups for index in range(len(levels))
    ]


def _jobs(policy: str, settings: Mapping[str, Any], problems: Sequence[Problem], noise: tuple[float, ...]) -> list[Job]:
    return [Job(policy, settings, problem, seed, noise) for seed, problem in enumerate(problems)]


def _run_missing(jobs: list[Job], store: TrialStore, workers: int, progress: Progress) -> None:
    finished = store.finished()
    total = done = sum(len(job.noise) for job in jobs)
    missing = []
    for job in jobs:
        left = tuple(key.noise for key in job.keys if key not in finished)
        done -= len(left)
        if left:
            missing.append(replace(job, noise=left))
    progress("starting", done, total)
    with closing(run_jobs(missing, store, workers)) as running:
        for job in running:
            done += len(job.noise)
            progress(job.label, done, total)


def _silent(what: str, done: int, total: int) -> None:
    """Say nothing."""


def success_rate(trials: Sequence[Trial]) -> SuccessRate:
    """Sum up the trials of one policy on one scenario, team size and level of noise."""
    first, count = trials[0], len(trials)
    successes = [trial for trial in trials if trial.success]
    errors = [trial.error for trial in trials if trial.error]
    lower, upper = wilson_interval(len(successes), count)
    times = [trial.travel_time for trial in successes if trial.travel_time is not None]
    planning = [trial.wall_time for trial in trials if trial.wall_time is not None]
    return SuccessRate(
        policy=first.policy,
        scenario=first.scenario,
        robots=first.robots,
        model=first.model,
        noise=first.noise,
        trials=count,
        successes=len(successes),
        contacts=sum(trial.collided > 0 for trial in trials),
        late=sum(not trial.error and trial.arrived < trial.robots for trial in trials),
        errors=len(errors),
        lower=lower,
        upper=upper,
        travel_time=float(np.mean(times)) if times else None,
        wall_time=float(np.median(planning)) if planning else None,
        error=errors[0] if errors else "",
    )
