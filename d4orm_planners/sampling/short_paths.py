"""Sampling where robots have to pass each other on short paths.

A robot that evades another makes a detour. On a path that is long next to the robots it costs next to nothing; on a
short one nearly as much as driving through the other, by a reward that counts distances relative to the path and most
of whose steps come after the arrival. There samples look no farther ahead than driving and evading take, and distances
count relative to a path on which evading is cheap.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.problem import Problem
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import SamplingTask

SHORT = 5.0
"""Times the distance that two robots keep between their centres: paths of less are short."""
SLACK, SLACK_GROWTH = 2.0, 0.2
"""Times the drive that samples look ahead at first, and how much more with every iteration: it may take longer."""


def on_short_paths(task: SamplingTask, search: SolveRun) -> SamplingTask:
    """The task itself, unless all robots' paths are short: then one of fewer steps, with rewards for such paths.

    Where robots do not stay at their goals by themselves all steps count, and it is the task itself too.
    """
    problem = task.problem
    reference = SHORT * (2 * float(np.max(problem.team.radius)) + problem.margin)
    lengths = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1).astype(np.float64)
    if problem.num_robots == 1 or not problem.docks or lengths.max() >= reference:
        return task
    if problem.world.num_obstacles:
        with search.watch.paused():  # it may compile
            lengths = np.asarray(problem.shortest_paths.length, np.float64)
        if lengths.max() >= reference:
            return task
    slack = SLACK + SLACK_GROWTH * search.iteration
    horizon = min(problem.horizon, math.ceil(slack * float(drive_times(problem, lengths).max()) / problem.dt))
    part = problem.with_state(problem.start, problem.goal, horizon=horizon)
    base, factor = np.ascontiguousarray(task.base[:horizon]), task.first_factor[:horizon]
    return replace(task, problem=part, base=base, noise_factor=factor, reference_distance=reference)


def drive_times(problem: Problem, lengths: Floats) -> Floats:
    """``(K,)`` times from rest to rest along paths of these lengths ``(K,)`` [s], a quarter turn included."""
    team = problem.team
    speed, acceleration = np.float64(team.max_speed), np.float64(team.max_acceleration)
    inert = np.array([not model.first_order for model in team.robot_models])
    peak = np.where(inert, np.minimum(speed, np.sqrt(acceleration * lengths)), speed)
    rates = np.array([model.turn_rate(limits) for model, limits in zip(team.robot_models, team.limits)])
    turn = np.where(rates > 0, math.pi / 2 / np.where(rates > 0, rates, 1.0), 0.0)
    # It turns while it gains speed. A robot that starts at its goal has no peak.
    return lengths / np.where(peak > 0, peak, 1.0) + np.maximum(np.where(inert, peak / acceleration, 0.0), turn)
