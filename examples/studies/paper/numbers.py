"""Numbers of a reproduced figure: each policy on each problem, and how the tables write it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from examples.studies.paper.figure import TIMES, Figure, Group

from d4orm_planners.evaluation.comparison import steps_to_solution
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import Compared


@dataclass(frozen=True, kw_only=True)
class Measured(Compared):
    """One policy on one problem. All but counts, quartiles and reward is over the successes, see
    :func:`first_solution`.

    Attributes:
        section: Title of the section.
        runtime: Median seconds to the first solution over all trials, of which those that failed count as never, which
            ``None`` is.
        runtime_lower: Lower quartile, likewise.
        runtime_upper: Upper quartile, likewise.
        runtime_mean: Mean over the successes; ``None`` without any, as all below.
        runtime_deviation: Standard deviation; 0 for one success.
        first_steps: Median denoising steps to the first solution over all trials, likewise.
        first_steps_lower: Lower quartile.
        first_steps_upper: Upper quartile.
        iterations: Mean over the successes; ``None`` for policies that execute no plan.
        reward: Mean over all trials of the last best plan's reward per step of the horizon and robot; ``None`` without
            plans.
        travel_time: Mean arrival time [s].
        makespan: Mean of the latest arrival time [s].
        jerk: Mean squared jerk [m^2/s^6].
        nodes: Nodes that plan; 1 unless the planner is a distributed one.
        messages: Mean number of candidates that nodes sent, each to all others; ``None`` for other planners, as below.
        message_bytes: Mean of their length together.
        waiting_share: Mean share of the nodes' time that they waited for each other.
        step_time: Mean seconds of a control loop; ``None`` for policies that execute a plan.
    """

    section: str
    runtime: float | None
    runtime_lower: float | None
    runtime_upper: float | None
    runtime_mean: float | None
    runtime_deviation: float | None
    first_steps: float | None
    first_steps_lower: float | None
    first_steps_upper: float | None
    iterations: float | None
    reward: float | None
    travel_time: float | None
    makespan: float | None
    jerk: float | None
    nodes: int
    messages: float | None
    message_bytes: float | None
    waiting_share: float | None
    step_time: float | None


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
    """Sum a group up."""
    trials = group.trials
    times = [first_solution(trial) for trial in trials]
    solved = [(trial, seconds) for trial, seconds in zip(trials, times) if seconds is not None]
    rewards = [progress[-1].reward for trial in trials if (progress := trial.progress)]
    lower, runtime, upper = _quartiles(times)
    fewer, steps, more = _quartiles([steps_to_solution(trial) for trial in trials])
    average, deviation = _mean_and_deviation([seconds for _, seconds in solved])

    def mean(name: str) -> float | None:
        values = [value for trial, _ in solved if (value := getattr(trial, name)) is not None]
        return float(np.mean(values)) if values else None

    return Measured(
        **vars(Compared.of(trials, len(solved), group.label)),
        section=group.section,
        runtime=runtime,
        runtime_lower=lower,
        runtime_upper=upper,
        runtime_mean=average,
        runtime_deviation=deviation,
        first_steps=steps,
        first_steps_lower=fewer,
        first_steps_upper=more,
        iterations=mean("iterations"),
        reward=float(np.mean(rewards)) if rewards else None,
        travel_time=mean("travel_time"),
        makespan=mean("makespan"),
        jerk=mean("mean_squared_jerk"),
        nodes=_nodes(trials[0]),
        messages=mean("messages"),
        message_bytes=mean("message_bytes"),
        waiting_share=mean("waiting_share"),
        step_time=_step_time([trial for trial, _ in solved]),
    )


def _quartiles(times: Sequence[float | None]) -> tuple[float | None, ...]:
    """Return the quartiles of the times of all trials; ``None`` is never."""
    # Not infinite: percentiles multiply the distance to the next trial by zero where they fall on one.
    never = 1e300
    quartiles = np.percentile([never if time is None else time for time in times], (25, 50, 75))
    return tuple(float(time) if time < 1e-9 * never else None for time in quartiles)


def _mean_and_deviation(seconds: Sequence[float]) -> tuple[float | None, float | None]:
    """Mean and standard deviation; ``None`` each where nothing was solved."""
    if not seconds:
        return None, None
    return float(np.mean(seconds)), float(np.std(seconds, ddof=min(len(seconds) - 1, 1)))


def _step_time(trials: Sequence[Trial]) -> float | None:
    values = [
        (trial.wall_time - trial.preparation) / trial.steps
        for trial in trials
        if not trial.status and trial.wall_time is not None and trial.preparation is not None and trial.steps
    ]
    return float(np.mean(values)) if values else None


def _nodes(trial: Trial) -> int:
    nodes = json.loads(trial.config).get("nodes", 1)
    return trial.num_robots if nodes is None else int(nodes)


@dataclass(frozen=True)
class Metric:
    """A number in the tables.

    Attributes:
        title: With its unit.
        text: Writes it.
    """

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


def _runtime(row: Measured) -> str:
    quartiles = (row.runtime_lower, row.runtime, row.runtime_upper)
    lower, middle, upper = (NEVER if seconds is None else f"{seconds:.2f}" for seconds in quartiles)
    return "-" if not row.successes else f"{middle} ({lower}-{upper})"


def _steps(row: Measured) -> str:
    quartiles = (row.first_steps_lower, row.first_steps, row.first_steps_upper)
    lower, middle, upper = (NEVER if steps is None else f"{steps:.0f}" for steps in quartiles)
    return "-" if not row.successes else f"{middle} ({lower}-{upper})"


def _mean_runtime(row: Measured) -> str:
    return "-" if row.runtime_mean is None else f"{row.runtime_mean:.2f} ± {row.runtime_deviation:.3f}"


METRICS: Mapping[str, Metric] = MappingProxyType({
    "success": Metric("success", _success),
    "runtime": Metric("runtime, s", _runtime),
    "mean_runtime": Metric("runtime, s", _mean_runtime),
    "first_steps": Metric("denoising steps", _steps),
    "iterations": Metric("iterations", _number("iterations", 1)),
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
