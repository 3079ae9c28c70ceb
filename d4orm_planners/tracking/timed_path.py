"""Driving along a route by the clock under a robot's own dynamics, compiled with numba."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, inlined, to_fixed_tuple
from d4orm_env.engine.stepping import Row, models_key
from d4orm_planners.tracking.path_drives import BRAKING, RESERVE, Corners, Route, beyond_goal, paces_along
from d4orm_planners.tracking.pursuit import lookaheads, point_ahead, point_reached, square_to, steering
from d4orm_planners.tracking.tracker import tracker

HURRYING = 0.85  #: Share of its acceleration that a robot in a hurry counts on; off its route it goes by the clock
NEAR, SHORT = 2 / 15, 2 / 3  #: Distance at which corners and stops are reached; length of a drive to a stop [radii]


class Timed(NamedTuple):
    """A route and its clock."""

    points: Floats  #: ``(P, d)`` float64 [m]
    targets: FloatArray  #: ``(P, d)`` the same in float32
    arcs: Floats  #: ``(P,)`` float64 length of the route up to each [m]
    paces: Floats  #: ``(P,)`` float64 how fast each may be passed [m/s]
    bends: Floats  #: ``(P,)`` float64 radius of the bend at each [m]
    corners: Floats  #: ``(C,)`` float64 length of the route up to each corner [m]
    departs: Floats  #: ``(C,)`` float64 step at which it may set out for each corner from the one before
    arrives: Floats  #: ``(C,)`` float64 step at which it should be there
    lookahead: float  #: Least look-ahead of the robot [m]
    beyond: np.float32  #: Distance beyond its goal that it may plan to drive, if that stops it [m]
    size: float  #: The radius of the largest robot [m]
    dt: np.float32  #: Time step [s]
    backs_up: bool  #: Whether the robot does, see :func:`~d4orm_planners.tracking.pursuit.gear_towards`


@inlined
def stop_before(route: Timed, step: int, at: int, corner: int, stride: np.float32) -> float:
    """Length of the route up to where a robot at point ``at`` has to be able to stop [m]; ``stride`` in a step [m].

    It stays where it waits until it may set out, and stops there only if it has to.
    """
    last = route.corners.shape[0] - 1
    if step < route.departs[corner]:
        return route.corners[corner - 1]
    if corner < last:
        soonest = step + (route.corners[corner] - route.arcs[at]) / stride
        if soonest + 2 < route.departs[corner + 1]:
            return route.corners[corner]
    return route.corners[last]


@inlined
def pace_to(route: Timed, step: int, at: int, corner: int, stop: float, dt: np.float32) -> np.float32:
    """Return the speed at which to come to the next corner at its time [m/s]."""
    pace, time = np.float32(route.paces[at]), route.arrives[corner] - step
    if time > 1.0 and stop >= route.corners[corner]:
        pace = min(pace, np.float32((route.corners[corner] - route.arcs[at] + NEAR * route.size) / (time * dt)))
    return pace


@cache
def timed_kernel(name: str) -> Kernel[[ProblemArrays, int, Timed, FloatArray, FloatArray], int]:
    """The compiled drive of a robot of the model with this name along a :class:`Timed` route.

    The kernel fills ``controls`` ``(T, m)`` and ``states`` ``(T + 1, n)`` from the first on, and returns the step of
    arrival, ``T + 1`` for none.
    """
    model = MODELS[name]
    steer, n, d = steering(name), model.state_size, model.dimension

    @inlined
    def by_clock(
        route: Timed, memory: tuple[int, int], step: int, x: Row, goal: Row, limits: Row, h: TimeStep
    ) -> tuple[Row, tuple[int, int], bool]:
        (at, corner), near = memory, NEAR * route.size
        last, last_corner = route.arcs.shape[0] - 1, route.corners.shape[0] - 1
        at = point_reached(route.points, route.arcs, at, last, x, route.size)
        while corner < last_corner and route.arcs[at] >= route.corners[corner] - near:
            corner += 1
        stop = stop_before(route, step, at, corner, limits[0] * route.dt)
        target = point_ahead(route, route.paces, at, last, stop, (route.lookahead, route.dt), x, route.size)
        if route.arcs[target] > stop + near:
            target = at
        room = RESERVE * max(stop - route.arcs[at], 0.0)
        if stop == route.corners[last_corner]:
            room += route.beyond
        elif room < SHORT * route.size:
            room = np.sqrt(square_to(route.points, target, x))
        pace = pace_to(route, step, at, corner, stop, route.dt)
        aim = to_fixed_tuple(route.targets[target], d)
        return steer(x, aim, np.float32(room), pace, route.backs_up, limits, h), (at, corner), at == last

    drive = tracker(model, by_clock)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive_timed(arrays: ProblemArrays, robot: int, route: Timed, controls: FloatArray, states: FloatArray) -> int:
        memory = (np.int64(0), np.int64(min(1, route.corners.shape[0] - 1)))
        return drive(arrays, robot, route, memory, 0, to_fixed_tuple(states[0], n), False, controls, states)

    return drive_timed


def drive_by_clock(
    problem: Problem,
    robot: int,
    route: Route,
    stops: Corners,
    steps: int,
    *,
    hurrying: bool = False,
    backs_up: bool = False,
) -> tuple[FloatArray, Floats, int]:
    """``(controls (T, m), positions (T + 1, 3), arrival)`` of one robot along its route.

    Args:
        problem: The team.
        robot: The robot.
        route: Its route.
        stops: Its corners, the steps at which it may set out for each, and at which it should be there.
        steps: ``T``.
        hurrying: Whether it comes to each as soon as it can, and waits only where it would have waited.
        backs_up: Whether it backs up, if it drives in order to turn, where it could swing round.
    """
    departs, arrives, d = stops.departs, stops.arrives, problem.dimension
    # Corners are rounded: the middle of those of its points that are passed at its time.
    at = (np.searchsorted(route.times, arrives) + np.searchsorted(route.times, arrives, side="right") - 1) // 2
    if hurrying:
        waits = np.append(False, departs[1:] > arrives[:-1] + 1)
        departs, arrives = np.where(waits, departs, 0.0), np.zeros(len(arrives))
    moves = np.diff(route.points, axis=0)
    arcs = np.append(0.0, np.cumsum(np.sqrt(moves[:, 0] ** 2 + moves[:, 1] ** 2 + moves[:, 2] ** 2)))
    paces = paces_along(problem, robot, arcs, route.bends, HURRYING if hurrying else BRAKING)
    points = np.ascontiguousarray(route.points[:, :d])
    timed = Timed(
        points, points.astype(np.float32), arcs, paces, route.bends, arcs[at],
        departs, arrives, lookaheads(problem)[robot], np.float32(beyond_goal(problem)), problem.team.largest_radius,
        problem.arrays.time_step[0], backs_up,
    )  # fmt: skip
    controls = np.zeros((steps, problem.control_size), np.float32)
    states, positions = np.empty((steps + 1, problem.state_size), np.float32), np.zeros((steps + 1, 3))
    states[0] = problem.start[robot]
    arrival = timed_kernel(problem.team.models[robot])(problem.arrays, robot, timed, controls, states)
    positions[:, :d] = states[:, :d]
    return controls, positions, int(arrival)
