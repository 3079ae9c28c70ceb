"""Driving along a route by the clock under a robot's own dynamics, compiled with numba."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO, inlined, to_fixed_tuple
from d4orm_env.engine.stepping import make_stepper, models_key
from d4orm_planners.tracking import path_drives, pursuit
from d4orm_planners.tracking.path_drives import RESERVE
from d4orm_planners.tracking.pursuit import point_ahead, point_reached, square_to, steering
from d4orm_planners.tracking.routes import Corners, Route
from d4orm_planners.tracking.straight_drives import RobotSpec

HURRYING = 0.85
"""Share of its acceleration that a robot counts on that hurries: if it leaves its route so, it drives by the clock."""
NEAR, SHORT = 2 / 15, 2 / 3
"""Distance at which a robot has reached a corner or stop, and length of a path to a stop that it may drive [radii]."""


class Timed(NamedTuple):
    """A route and its clock.

    Attributes:
        points: ``(P, 3)`` float64 [m].
        arcs: ``(P,)`` float64 length of the route up to each [m].
        paces: ``(P,)`` float64 how fast each may be passed [m/s].
        bends: ``(P,)`` float64 radius of the bend at each [m].
        corners: ``(C,)`` float64 length of the route up to each corner [m].
        departs: ``(C,)`` float64 step at which it may set out for each corner from the one before.
        arrives: ``(C,)`` float64 step at which it should be there.
        lookahead: Least look-ahead of the robot [m].
        beyond: Distance beyond its goal that it may plan to drive, if that stops it [m].
        size: The radius of the largest robot [m].
    """

    points: Floats
    arcs: Floats
    paces: Floats
    bends: Floats
    corners: Floats
    departs: Floats
    arrives: Floats
    lookahead: float
    beyond: np.float32
    size: float


@inlined
def stop_before(route: Timed, step: int, at: int, corner: int, stride: float) -> float:
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
def timed_kernel(name: str) -> Kernel[[RobotSpec, Timed, bool, FloatArray, Floats], int]:
    """The compiled drive of a robot of the model with this name along a :class:`Timed` route.

    Args of the kernel: the :class:`~d4orm_planners.tracking.straight_drives.RobotSpec`, the route, whether the robot
    backs up, see :func:`~d4orm_planners.tracking.pursuit.gear_towards`, ``controls`` ``(T, m)`` and ``places`` ``(T +
    1, 3)``, output. It returns the step of arrival, ``T + 1`` for none.
    """
    model = MODELS[name]
    (move, dock), steer = make_stepper(model), steering(name)
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive(robot: RobotSpec, route: Timed, backs_up: bool, controls: FloatArray, places: Floats) -> int:
        dt, docks, rules = robot.time_step, robot.docks, (robot.docking[0], robot.docking[1], robot.docks)
        h, own = transition.TimeStep(dt[0], dt[1], dt[2], dt[3]), to_fixed_tuple(robot.limits, num_limits)
        goal, x = to_fixed_tuple(robot.goal, d), to_fixed_tuple(robot.start, n)
        last, last_corner, steps = route.arcs.shape[0] - 1, route.corners.shape[0] - 1, controls.shape[0]
        target_place, end = np.zeros(d, np.float32), route.corners[last_corner]
        at, corner, there, arrival, near = 0, min(1, last_corner), False, steps + 1, NEAR * route.size
        places[:] = 0.0
        for i in range(d):
            places[0, i] = x[i]
        for step in range(steps):
            here = places[step]
            at = point_reached(route.points, route.arcs, at, last, here, route.size)
            while corner < last_corner and route.arcs[at] >= route.corners[corner] - near:
                corner += 1
            stop = stop_before(route, step, at, corner, own[0] * dt[0])
            pace = pace_to(route, step, at, corner, stop, dt[0])
            target = point_ahead(route, route.paces, at, last, stop, (route.lookahead, dt[0]), here, route.size)
            if route.arcs[target] > stop + near:
                target = at
            room = RESERVE * max(stop - route.arcs[at], 0.0)
            if stop == end:
                room += route.beyond
            elif room < SHORT * route.size:
                room = np.sqrt(square_to(route.points, target, here))
            for i in range(d):
                target_place[i] = route.points[target, i]
            standing = transition.stands(there, docks)
            control = steer(x, to_fixed_tuple(target_place, d), np.float32(room), pace, backs_up, own, h)
            for i in range(m):
                controls[step, i] = ZERO if standing else control[i]
            control = to_fixed_tuple(controls[step], m)
            x, _, there = dock(standing, move(standing, x, control, own, h), control, own, goal, rules)
            for i in range(d):
                places[step + 1, i] = x[i]
            if not (there and (docks or at == last)):
                arrival = steps + 1
            elif arrival > steps:
                arrival = step + 1
        return arrival

    return drive


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
    """``(controls (T, m), places (T + 1, 3), arrival)`` of one robot along its route.

    Args:
        problem: The team.
        robot: The robot.
        route: Its route.
        stops: Its corners, the steps at which it may set out for each, and at which it should be there.
        steps: ``T``.
        hurrying: Whether it comes to each as soon as it can, and waits only where it would have waited.
        backs_up: Whether it backs up, if it drives in order to turn, where it could swing round.
    """
    departs, arrives = stops.departs, stops.arrives
    # Corners are rounded: the middle of those of its points that are passed at its time.
    at = (np.searchsorted(route.times, arrives) + np.searchsorted(route.times, arrives, side="right") - 1) // 2
    if hurrying:
        waits = np.append(False, departs[1:] > arrives[:-1] + 1)
        departs, arrives = np.where(waits, departs, 0.0), np.zeros(len(arrives))
    moves = np.diff(route.points, axis=0)
    arcs = np.append(0.0, np.cumsum(np.sqrt(moves[:, 0] ** 2 + moves[:, 1] ** 2 + moves[:, 2] ** 2)))
    share = HURRYING if hurrying else path_drives.BRAKING
    paces = path_drives.paces_along(problem, robot, arcs, route.bends, share)
    controls = np.zeros((steps, problem.control_size), np.float32)
    places = np.empty((steps + 1, 3))
    lookahead, beyond, size = (
        pursuit.lookaheads(problem)[robot],
        path_drives.beyond_goal(problem),
        problem.team.largest_radius,
    )
    timed = Timed(
        route.points, arcs, paces, route.bends, arcs[at], departs, arrives, lookahead, np.float32(beyond), size
    )
    drive = timed_kernel(problem.team.models[robot])
    arrival = drive(RobotSpec.of(problem, robot), timed, backs_up, controls, places)
    return controls, places, int(arrival)
