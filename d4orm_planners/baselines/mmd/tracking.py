"""Driving along motions by the clock under a robot's own dynamics, compiled with numba."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import Row, models_key
from d4orm_env.paths.spaces import Space, clearance_at
from d4orm_planners.baselines.mmd.path_frame import PathFrame, segment_length, trace
from d4orm_planners.tracking.tracker import tracker

SHARE = 0.7
"""Share of its acceleration that a robot counts on, so that it can make up for what it is off."""


GAIN = np.float32(1.5)
"""Share of its distance from the motion that a robot makes up for in a second [1/s]."""


@compiled
def fill_clock(
    points: Floats, duration: float, speed: float, acceleration: float, paces: Floats, times: Floats
) -> None:
    """Fill ``times`` ``(N + 1,)`` with when a robot that starts from rest is at each point [s].

    Points follow each other at equal times, but for bends that are driven slower than that, and braking before them.

    Args:
        points: ``(N + 1, 3)`` [m].
        duration: Of the motion [s]; it takes no less.
        speed: Limit [m/s].
        acceleration: Limit [m/s^2].
        paces: ``(N + 1,)`` scratch [m/s].
        times: Output.
    """
    last, usable = points.shape[0] - 1, SHARE * acceleration
    paces[0], paces[last] = 0.0, speed
    for i in range(1, last):
        before, after = segment_length(points, i), segment_length(points, i + 1)
        square = 0.0
        for axis in range(3):
            turn = (points[i + 1, axis] - points[i, axis]) / after - (points[i, axis] - points[i - 1, axis]) / before
            square += turn * turn
        # A point that is waited at has no direction.
        bends = before > 0.0 and after > 0.0 and square > 0.0
        paces[i] = min(speed, np.sqrt(usable * (before + after) / (2 * np.sqrt(square)))) if bends else speed
    for i in range(last - 1, 0, -1):
        paces[i] = min(paces[i], np.sqrt(paces[i + 1] * paces[i + 1] + 2 * usable * segment_length(points, i + 1)))
    times[0] = 0.0
    for i in range(last):
        length = segment_length(points, i + 1)
        paces[i + 1] = min(paces[i + 1], np.sqrt(paces[i] * paces[i] + 2 * usable * length))
        pace = (paces[i] + paces[i + 1]) / 2
        times[i + 1] = times[i] + max(duration / last, length / pace if pace > 0.0 else 0.0)


class TrackedMotions(NamedTuple):
    """Rollouts along ``B`` motions."""

    controls: FloatArray  #: ``(B, H, m)`` float32, zero after arrival
    states: FloatArray  #: ``(B, H+1, n)`` float32, from the first step on
    positions: Floats  #: ``(B, H+1, 3)`` [m]
    arrivals: IntArray  #: ``(B,)`` int64 the step of arrival; ``H + 1`` for none
    clearances: Floats  #: ``(B,)`` least distance of the centre from obstacles and bounds [m]


def _motion_follower(model: Model) -> Callable[..., int]:
    """Function that drives a robot along a motion by its clock."""
    approach, d = inlined(model.functions.approach), model.dimension

    @inlined
    def by_motion(
        reference: tuple[Floats, Floats, np.float32, FloatArray],
        i: int,
        step: int,
        x: Row,
        goal: Row,
        limits: Row,
        h: TimeStep,
    ) -> tuple[Row, int, bool]:
        points, times, dt, wanted = reference
        time, last = (step + 1) * dt, times.shape[0] - 1
        while i < last and times[i + 1] <= time:
            i += 1
        if i == last:
            return approach(x, goal, limits, h, OPS), i, True
        for axis in range(d):
            pace = (points[i + 1, axis] - points[i, axis]) / (times[i + 1] - times[i])
            error = points[i, axis] + (time - times[i]) * pace - x[axis]
            # By the next step the motion has gone on as well.
            wanted[axis] = pace + GAIN * (error - pace * dt)
        return to_fixed_tuple(wanted, d), i, True

    return tracker(model, by_motion)


@cache
def motion_kernel(
    name: str,
) -> Kernel[[ProblemArrays, int, PathFrame, Floats, Floats, Space, Floats, FloatArray, TrackedMotions], None]:
    """The compiled drives of a robot of the model with this name; see :func:`drive_motions`."""
    model = MODELS[name]
    follow, n, d = _motion_follower(model), model.state_size, model.dimension

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive_motion(
        arrays: ProblemArrays, robot: int, frame: PathFrame, sines: Floats, deviation: Floats, space: Space,
        durations: Floats, motions: FloatArray, driven: TrackedMotions,
    ) -> None:  # fmt: skip
        num_points, start = sines.shape[0], to_fixed_tuple(arrays.start[robot], n)
        points, wanted, states = np.empty((num_points, 3)), np.zeros(d, np.float32), driven.states
        paces, times, spot = np.empty(num_points), np.empty(num_points), np.empty((4, 3))
        for b in range(motions.shape[0]):
            trace(frame, frame.axes[b % frame.axes.shape[0]], sines, deviation, motions[b], spot, points)
            fill_clock(points, durations[b], frame.speed, frame.acceleration, paces, times)
            reference = (points, times, arrays.time_step[0], wanted)
            driven.arrivals[b] = follow(arrays, robot, reference, 0, 0, start, False, driven.controls[b], states[b])
            positions, least = driven.positions[b], np.inf
            positions[:] = 0.0
            positions[0, :d] = arrays.start[robot, :d]
            for step in range(1, positions.shape[0]):
                positions[step, :d] = states[b, step, :d]
                least = min(least, clearance_at(space, positions[step, 0], positions[step, 1], positions[step, 2]))
            driven.clearances[b] = least

    return drive_motion


def drive_motions(
    problem: Problem,
    robot: int,
    frame: PathFrame,
    sines: Floats,
    deviation: Floats,
    space: Space,
    durations: Floats,
    motions: FloatArray,
) -> TrackedMotions:
    """Drive a robot along each of some motions, as if it were alone: by the clock, and then straight to its goal.

    Args:
        problem: The team.
        robot: The robot's number.
        frame: Its path.
        sines: ``(POINTS + 1, MODES)``.
        deviation: ``(2 MODES,)`` of the modes.
        space: The world, of :func:`~d4orm_planners.baselines.mmd.path_frame.world_space`.
        durations: ``(B,)`` how long the motions take [s].
        motions: ``(B, 2 MODES)`` float32 whitened modes.
    """
    count, horizon = len(motions), problem.horizon
    driven = TrackedMotions(
        np.zeros((count, horizon, problem.control_size), np.float32),
        np.empty((count, horizon + 1, problem.state_size), np.float32),
        np.empty((count, horizon + 1, 3)),
        np.empty(count, np.int64),
        np.empty(count),
    )
    kernel = motion_kernel(problem.team.models[robot])
    kernel(problem.arrays, robot, frame, sines, deviation, space, durations, motions, driven)
    return driven
