"""Driving along motions by the clock under a robot's own dynamics, compiled with numba."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import make_stepper, models_key
from d4orm_env.paths.wavefront import Space, clearance_at
from d4orm_planners.baselines.mmd.clock import fill_clock
from d4orm_planners.baselines.mmd.path_frame import PathFrame, trace
from d4orm_planners.tracking.straight_drives import RobotSpec

GAIN = np.float32(1.5)
"""Share of its distance from the motion that a robot makes up for in a second [1/s]."""


class TrackedMotions(NamedTuple):
    """Rollouts along ``B`` motions.

    Attributes:
        controls: ``(B, H, m)`` float32, zero once docked.
        places: ``(B, H+1, 3)`` [m].
        arrivals: ``(B,)`` int64 the step of arrival; ``H + 1`` for none.
        clearances: ``(B,)`` least distance of the centre from obstacles and bounds [m].
    """

    controls: FloatArray
    places: Floats
    arrivals: IntArray
    clearances: Floats


@compiled
def _catch_up(
    points: Floats, times: Floats, i: int, time: float, dt: np.float32, place: Floats, wanted: FloatArray
) -> None:
    """Fill ``wanted`` ``(d,)`` with the velocity from a place to where the motion is a step later [m/s]."""
    for axis in range(wanted.shape[0]):
        pace = (points[i + 1, axis] - points[i, axis]) / (times[i + 1] - times[i])
        error = points[i, axis] + (time - times[i]) * pace - place[axis]
        # By the next step the motion has gone on as well.
        wanted[axis] = pace + GAIN * (error - pace * dt)


@cache
def tracking_kernel(
    name: str,
) -> Kernel[[RobotSpec, PathFrame, Floats, Floats, Space, Floats, FloatArray, TrackedMotions], None]:
    """The compiled drives of a robot of the model with this name; see :func:`drive_along`."""
    model = MODELS[name]
    move, dock = make_stepper(model)
    approach, track = inlined(model.functions.approach), inlined(model.functions.track)
    limit_control = inlined(model.functions.limit_control)
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive(
        robot: RobotSpec,
        frame: PathFrame,
        sines: Floats,
        deviation: Floats,
        space: Space,
        durations: Floats,
        motions: FloatArray,
        driven: TrackedMotions,
    ) -> None:
        dt, docks, docking = robot.time_step, robot.docks, (robot.docking[0], robot.docking[1], robot.docks)
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        own, goal = to_fixed_tuple(robot.limits, num_limits), to_fixed_tuple(robot.goal, d)
        last, horizon = sines.shape[0] - 1, driven.controls.shape[1]
        points, wanted = np.empty((last + 1, 3)), np.zeros(d, np.float32)
        paces, times, spot = np.empty(last + 1), np.empty(last + 1), np.empty((4, 3))
        for b in range(motions.shape[0]):
            trace(frame, frame.axes[b % frame.axes.shape[0]], sines, deviation, motions[b], spot, points)
            fill_clock(points, durations[b], frame.speed, frame.acceleration, paces, times)
            i = 0
            x, there, arrival, least = to_fixed_tuple(robot.start, n), False, horizon + 1, np.inf
            driven.places[b] = 0.0
            for axis in range(d):
                driven.places[b, 0, axis] = x[axis]
            for step in range(horizon):
                time = (step + 1) * dt[0]
                while i < last and times[i + 1] <= time:
                    i += 1
                standing = transition.stands(there, docks)
                if i < last:
                    _catch_up(points, times, i, time, dt[0], driven.places[b, step], wanted)
                    control = track(x, to_fixed_tuple(wanted, d), own, h, OPS)
                else:
                    control = track(x, approach(x, goal, own, h, OPS), own, h, OPS)
                control = limit_control(control, own, OPS)
                for axis in range(m):
                    driven.controls[b, step, axis] = ZERO if standing else control[axis]
                x, _, there = dock(standing, move(standing, x, control, own, h), control, own, goal, docking)
                for axis in range(d):
                    driven.places[b, step + 1, axis] = x[axis]
                place = driven.places[b, step + 1]
                least = min(least, clearance_at(space, place[0], place[1], place[2]))
                if not there:
                    arrival = horizon + 1
                elif arrival > horizon:
                    arrival = step + 1
            driven.arrivals[b], driven.clearances[b] = arrival, least

    return drive


def drive_along(
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
        space: The world, of :func:`~d4orm_planners.baselines.mmd.way_frame.world_space`.
        durations: ``(B,)`` how long the motions take [s].
        motions: ``(B, 2 MODES)`` float32 whitened modes.
    """
    count, horizon = len(motions), problem.horizon
    driven = TrackedMotions(
        np.zeros((count, horizon, problem.control_size), np.float32),
        np.empty((count, horizon + 1, 3)),
        np.empty(count, np.int64),
        np.empty(count),
    )
    kernel = tracking_kernel(problem.team.models[robot])
    kernel(RobotSpec.of(problem, robot), frame, sines, deviation, space, durations, motions, driven)
    return driven
