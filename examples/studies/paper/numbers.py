"""Numbers of a reproduced figure: each policy on each problem, and how the tables write it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from examples.denoising import denoising_time_shares, loop_steps, steps_spent, steps_to_solution, told_of
from examples.studies.paper.figure import TIMES, Figure, Group

from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import Compared, mean_if_known


@dataclass(frozen=True, kw_only=True)
class Measured(Compared):
    """One policy on one problem; all but counts, quartiles and reward over the successes, see :func:`first_solution`.

    Quartiles are over all trials, of which those that failed count as never, which ``None`` is. ``None`` is also a mean
    without successes, and what a policy has none of.
    """

    section: str  # title of the section
    runtime: float | None  # seconds to the first solution, median
    runtime_lower: float | None  # and quartiles
    runtime_upper: float | None
    runtime_mean: float | None
    runtime_deviation: float | None  # standard deviation; 0 for one success
    runtime_restricted: float | None  # mean over all trials, of which those that failed count all the time they took
    first_steps: float | None  # denoising steps to the first solution, median; none of policies that execute no plan
    first_steps_lower: float | None  # and quartiles
    first_steps_upper: float | None
    first_steps_restricted: float | None  # mean over all trials, of which those that failed count all their steps
    first_steps_loop: int | None  # of a loop of a controller
    denoising_time_share: float | None  # of the time to the first solution, or of all spent, mean of those that tell it
    denoising_time_told: int  # how many these are
    iterations: float | None  # none of policies that execute no plan
    iterations_restricted: float | None  # mean over all trials, of which those that failed count all that they made
    reward: float | None  # of the last best plan, per step of the horizon and robot, over all trials
    travel_time: float | None  # mean arrival time [s]
    makespan: float | None  # latest arrival time [s]
    jerk: float | None  # mean squared [m^2/s^6]
    nodes: int  # that plan; 1 unless the planner is a distributed one
    messages: float | None  # candidates that nodes sent, each to all others
    message_bytes: float | None  # their length together
    waiting_share: float | None  # of the nodes' time that they waited for each other
    step_time: float | None  # seconds of a control loop; none of policies that execute a plan


def is_time(name: str) -> bool:
    """Check whether an attribute of :class:`Measured` is about seconds of planning."""
    return name.startswith("runtime") or name in TIMES


def first_solution(trial: Trial) -> float | None:
    """Seconds until a trial was solved; ``None`` for one that failed.

    A plan is a solution when everyone arrives and the margin is kept, as in the paper; its time is that of the first
    one, also when planning went on. Under noise what counts is what happened, and the time is that of the plan, if
    there was one. For a policy that plans under way the time is that before its first action.
    """
    times = (best.seconds for best in trial.progress if best.solved)
    if trial.error or (not trial.success and (trial.control_noise_std > 0 or not trial.status)):
        return None
    if not trial.status:
        return trial.preparation
    return next(times, trial.wall_time if trial.control_noise_std > 0 else None)


def measured(group: Group) -> Measured:
    trials = group.trials
    times = [first_solution(trial) for trial in trials]
    solved = [(trial, seconds) for trial, seconds in zip(trials, times) if seconds is not None]
    rewards = [progress[-1].reward for trial in trials if (progress := trial.progress)]
    lower, runtime, upper = _quartiles(times)
    all_steps = [steps_to_solution(trial) for trial in trials]
    fewer, steps, more = _quartiles(all_steps)
    average, deviation = _mean_and_deviation([seconds for _, seconds in solved])
    shares = denoising_time_shares(trials)

    def mean(name: str) -> float | None:
        values = [value for trial, _ in solved if (value := getattr(trial, name)) is not None]
        return float(np.mean(values)) if values else None

    means = ("iterations", "travel_time", "makespan", "messages", "message_bytes", "waiting_share")
    return Measured(
        **vars(Compared.of(trials, len(solved), group.label)),
        section=group.section,
        runtime=runtime, runtime_lower=lower, runtime_upper=upper, runtime_mean=average, runtime_deviation=deviation,
        runtime_restricted=_restricted(times, [trial.wall_time for trial in trials]),
        first_steps=steps, first_steps_lower=fewer, first_steps_upper=more,
        first_steps_restricted=_restricted(all_steps, [steps_spent(trial) for trial in trials]),
        first_steps_loop=loop_steps(trials[0]),
        denoising_time_share=mean_if_known(shares),
        denoising_time_told=len(shares),
        iterations_restricted=_restricted([trial.iterations for trial in trials], times),
        reward=float(np.mean(rewards)) if rewards else None,
        jerk=mean("mean_squared_jerk"),
        nodes=_nodes(trials[0]),
        step_time=None if any(trial.status for trial in trials) else mean("decision_time"),
        **{name: mean(name) for name in means},
    )  # fmt: skip


def _quartiles(times: Sequence[float | None]) -> tuple[float | None, ...]:
    """Return the quartiles of the times of all trials; ``None`` is never."""
    # Not infinite: percentiles multiply the distance to the next trial by zero where they fall on one.
    never = 1e300
    quartiles = np.percentile([never if time is None else time for time in times], (25, 50, 75))
    return tuple(float(time) if time < 1e-9 * never else None for time in quartiles)


def _restricted(costs: Sequence[float | None], spent: Sequence[float | None]) -> float | None:
    """Mean cost, where a trial that found none counts what it spent; ``None`` where that is not known of one."""
    values = [own if cost is None else cost for cost, own in zip(costs, spent)]
    return float(np.mean(values)) if None not in values else None  # type: ignore[arg-type]


def _mean_and_deviation(seconds: Sequence[float]) -> tuple[float | None, float | None]:
    """Mean and standard deviation; ``None`` each where nothing was solved."""
    if not seconds:
        return None, None
    return float(np.mean(seconds)), float(np.std(seconds, ddof=min(len(seconds) - 1, 1)))


def _nodes(trial: Trial) -> int:
    nodes = json.loads(trial.config).get("nodes", 1)
    return trial.num_robots if nodes is None else int(nodes)


class Metric(NamedTuple):
    """A number in the tables: its title, with its unit, and what writes it."""

    title: str
    text: Callable[[Measured], str]


def _number(name: str, digits: int, scale: float = 1.0) -> Callable[[Measured], str]:
    def text(row: Measured) -> str:
        value = getattr(row, name)
        return "-" if value is None else f"{value * scale:.{digits}f}"

    return text


NEVER = "∞"
"""Text for the time to the first solution of a trial that found none."""


def _success(row: Measured) -> str:
    return f"{row.successes} of {row.trials} ({row.lower:.0%} to {row.upper:.0%})"


def _spread(name: str, digits: int) -> Callable[[Measured], str]:
    def text(row: Measured) -> str:
        quartiles = [getattr(row, name + end) for end in ("_lower", "", "_upper")]
        lower, middle, upper = (NEVER if value is None else f"{value:.{digits}f}" for value in quartiles)
        return f"{middle} ({lower}-{upper})" if row.successes or quartiles[0] is not None else "-"

    return text


def _steps(row: Measured) -> str:
    if row.first_steps_restricted is not None:
        return _spread("first_steps", 0)(row)
    return f"{row.first_steps_loop} a loop" if row.first_steps_loop else "-"


def _time_share(row: Measured) -> str:
    share = row.denoising_time_share
    return "-" if share is None else f"{100 * share:.0f}{told_of(row.denoising_time_told, row.trials)}"


def _mean_runtime(row: Measured) -> str:
    return "-" if row.runtime_mean is None else f"{row.runtime_mean:.2f} ± {row.runtime_deviation:.3f}"


METRICS: Mapping[str, Metric] = MappingProxyType({
    "success": Metric("success", _success),
    "runtime": Metric("runtime, s", _spread("runtime", 2)),
    "runtime_restricted": Metric("runtime, restricted mean, s", _number("runtime_restricted", 2)),
    "mean_runtime": Metric("runtime, s", _mean_runtime),
    "first_steps": Metric("denoising steps", _steps),
    "first_steps_restricted": Metric("denoising steps, restricted mean", _number("first_steps_restricted", 0)),
    "denoising_time_share": Metric("denoising, % of time", _time_share),
    "iterations": Metric("iterations", _number("iterations", 1)),
    "iterations_restricted": Metric("iterations, restricted mean", _number("iterations_restricted", 1)),
    "reward": Metric("reward", _number("reward", 3)),
    "travel_time": Metric("travel time, s", _number("travel_time", 2)),
    "makespan": Metric("makespan, s", _number("makespan", 2)),
    "jerk": Metric("mean squared jerk", _number("jerk", 1)),
    "messages": Metric("messages", _number("messages", 0)),
    "message_bytes": Metric("messages, kB", _number("message_bytes", 1, 1e-3)),
    "waiting_share": Metric("waiting, %", _number("waiting_share", 0, 100)),
    "step_time": Metric("control loop, ms", _number("step_time", 0, 1000)),
})  # fmt: skip
"""Metrics that can be tabulated."""


def column(figure: Figure, row: Measured) -> str:
    """Return the column of the figure's tables that a row is in."""
    value = row.label if figure.across == "policy" else getattr(row, figure.across)
    return f"{value:g}" if isinstance(value, float) else str(value)
