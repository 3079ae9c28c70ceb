"""Many trials in a few numbers: success rates, times, success within a deadline, tolerance of disturbances."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import positive_number
from d4orm_env.core.lazy import LazyModule
from d4orm_planners.evaluation.store import Trial

stats: Any = LazyModule("scipy.stats")


class TrialGroup(NamedTuple):
    """Trials of one policy, one per seed, that have all but their seeds in common."""

    label: str  #: Name of the policy with its settings
    trials: Sequence[Trial]  #: At least one
    disturbance: str = ""  #: Further disturbance, such as ``"push.speed"``; empty for nothing
    level: float | None = None  #: Its level


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Successes of a policy on one scenario, model and team size, at one level of noise."""

    label: str  #: Name of the policy with its settings
    policy: str  #: Registry name
    scenario: str  #: Scenario name
    num_robots: int  #: Team size
    model: str  #: Models of the team
    control_noise_std: float  #: Standard deviation of the execution noise, in the controls' units
    disturbance: str = ""  #: Further disturbance, such as ``"push.speed"``; empty for nothing
    level: float | None = None  #: Its level
    physics: str = "model"  #: Physics of the robots, see :func:`~d4orm_planners.base.episode.find_physics`
    undisturbed: bool = False  #: True if no disturbance changed anything, as at level zero
    trials: int  #: Trials, those with an error included
    successes: int  #: Those that succeeded
    lower: float  #: Lower end of the 95% confidence interval of the success rate (Wilson)
    upper: float  #: Upper end
    errors: int  #: Trials that raised an error; they count as failures
    error: str  #: The first error

    @property
    def rate(self) -> float:
        return self.successes / self.trials

    @staticmethod
    def of(trials: Sequence[Trial], successes: int, label: str) -> Compared:
        """Return the row of the trials, at least one, so many of which succeeded."""
        first, errors = trials[0], [trial.error for trial in trials if trial.error]
        lower, upper = wilson_interval(successes, len(trials))
        same = ("policy", "scenario", "num_robots", "model", "control_noise_std", "physics")
        return Compared(
            label=label,
            **{name: getattr(first, name) for name in same},
            undisturbed=all(trial.disturbances == "[]" for trial in trials),
            trials=len(trials),
            successes=successes,
            lower=lower,
            upper=upper,
            errors=len(errors),
            error=errors[0] if errors else "",
        )


@dataclass(frozen=True, kw_only=True)
class SuccessRate(Compared):
    """Rate at which all arrived in time and none was ever in contact, and the time taken; intervals are of 95%."""

    #: Trials with whose executed controls :func:`d4orm_env.verify` found no fault; ``None`` where none could be judged
    verified: int | None
    contacts: int  #: Those in which robots touched something
    late: int  #: Those in which a robot did not arrive in time
    travel_time: float | None  #: Mean over the successes of the mean arrival time [s]; ``None`` without any
    travel_time_lower: float | None  #: Lower end of its interval (Student's t); ``None`` with fewer than two successes
    travel_time_upper: float | None  #: Upper end
    stretch: float | None  #: Mean over the successes of the path travelled over the shortest path; ``None`` without any
    denoising_steps: float | None  #: Median denoising steps until the last better plan; ``None`` without a plan
    denoising_share: float | None  #: Mean share of the iterations that denoised, where it is known
    #: Mean share of the time until then that was spent denoising; ``None`` unless it is known of all plans
    denoising_time_share: float | None
    wall_time: float | None  #: Median seconds of planning or choosing actions per trial; ``None`` if all raised errors
    #: Median seconds of choosing the actions of one step, without what came before the first one; ``None`` if all
    #: raised errors
    decision: float | None
    training_time: float | None  #: Seconds of training behind a learned policy, where its file tells; else ``None``
    compute: float | None  #: Mean seconds of planning, or of choosing actions, per second of motion, likewise
    compute_lower: float | None  #: Lower end of its interval (Student's t); ``None`` with fewer than two trials
    compute_upper: float | None  #: Upper end


@dataclass(frozen=True)
class SuccessWithin:
    """Successes of trials with so much time for planning."""

    deadline: float  #: The time [s]
    trials: int  #: Trials, those with an error included
    successes: int  #: Those that succeeded within it
    lower: float  #: Lower end of the 95% confidence interval of the success rate (Wilson)
    upper: float  #: Upper end

    @property
    def rate(self) -> float:
        return self.successes / self.trials


def mean_interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Mean, and its 95% confidence interval by Student's t; ``None`` for what takes more values than there are."""
    if not values:
        return None, None, None
    mean = float(np.mean(values))
    if len(values) == 1:
        return mean, None, None
    half_width = float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))
    return mean, mean - half_width, mean + half_width


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95% confidence interval of a success rate of at least one trial by Wilson's method.

    Unlike the normal approximation it stays inside [0, 1] and says something at 0 and at all successes.
    """
    interval = stats.binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def success_rates(groups: Iterable[TrialGroup]) -> list[SuccessRate]:
    return [
        replace(success_rate(group.trials, group.label), disturbance=group.disturbance, level=group.level)
        for group in groups
    ]


def success_rate(trials: Sequence[Trial], label: str | None = None) -> SuccessRate:
    """Sum up the trials, at least one, of one policy on one scenario, team size and level of noise."""
    successes = [trial for trial in trials if trial.success]
    travel = mean_interval([trial.travel_time for trial in successes if trial.travel_time is not None])
    stretch = [trial.stretch for trial in successes if trial.stretch is not None]
    steps = [trial.denoising_steps for trial in trials if trial.denoising_steps is not None]
    shares = [trial.denoising_share for trial in trials if trial.denoising_share is not None]
    of_time = [trial.denoising_time_share for trial in trials if trial.progress]
    timed = [(trial.wall_time, trial.steps * trial.dt) for trial in trials if trial.wall_time is not None]
    compute = mean_interval([seconds / motion for seconds, motion in timed if motion > 0])
    judged = [trial.verified for trial in trials if trial.verified is not None]
    choosing = [trial.decision_time for trial in trials if trial.decision_time is not None]
    return SuccessRate(
        **vars(Compared.of(trials, len(successes), trials[0].label if label is None else label)),
        verified=sum(judged) if judged else None,
        contacts=sum(trial.collided > 0 for trial in trials),
        late=sum(not trial.error and trial.arrived < trial.num_robots for trial in trials),
        travel_time=travel[0],
        travel_time_lower=travel[1],
        travel_time_upper=travel[2],
        stretch=float(np.mean(stretch)) if stretch else None,
        denoising_steps=float(np.median(steps)) if steps else None,
        denoising_share=float(np.mean(shares)) if shares else None,
        denoising_time_share=mean_if_known(of_time),
        wall_time=float(np.median([seconds for seconds, _ in timed])) if timed else None,
        decision=float(np.median(choosing)) if choosing else None,
        training_time=max((trial.training_time for trial in trials if trial.training_time is not None), default=None),
        compute=compute[0],
        compute_lower=compute[1],
        compute_upper=compute[2],
    )


def mean_if_known(values: Sequence[float | None]) -> float | None:
    """The mean of some values; ``None`` for none, or where one of them is not known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def solved_after(trial: Trial) -> float | None:
    """Seconds of planning after which the success of a trial was certain; ``None`` for a trial that failed.

    For a plan that is the time of the first solution. A policy that plans under way, and a plan that succeeded
    although it was no solution (it came within the margin and touched nothing), need all the time that they took.
    """
    if not trial.success:
        return None
    return next((best.seconds for best in trial.progress if best.solved), trial.wall_time)


def success_by(trials: Iterable[Trial], deadline: float) -> SuccessWithin:
    """Count the trials that would have succeeded, had planning been cut short; computed, not run again.

    A trial with execution noise counts by the plan that was executed: exact unless the planner went on improving
    (``improve=True``) after its first solution, which might have fared otherwise under the noise.

    Args:
        trials: Trials of one policy; those with an error count as failures.
        deadline: Seconds for planning.

    Raises:
        ValueError: If there are no trials, or the deadline is not positive.
    """
    deadline = positive_number(deadline, "deadline")
    times = [solved_after(trial) for trial in trials]
    if not times:
        raise ValueError("there are no trials; run some with evaluate()")
    successes = sum(time is not None and time <= deadline for time in times)
    return SuccessWithin(deadline, len(times), successes, *wilson_interval(successes, len(times)))
