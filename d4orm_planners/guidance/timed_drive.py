"""Driving along a route by the clock under a robot's own dynamics, compiled with numba."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core import transition
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.dynamics import MODELS
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.tiles import OPTIONS, ZERO, make_stepper, models_key, to_fixed_tuple
from d4orm_planners.guidance import execution
from d4orm_planners.guidance.execution import BEYOND, LOOKAHEAD, REACHED, RESERVE, point_reached, square_to, steering
from d4orm_planners.guidance.routes import Route, Stops

SOURCES = execution.SOURCES + fingerprint((execution,))

HURRYING = 0.85
"""Share of its acceleration that a robot counts on that hurries: if it leaves its route so, it drives by the clock."""


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
    """

    points: Any
    arcs: Any
    paces: Any
    bends: Any
    corners: Any
    departs: Any
    arrives: Any


@cache
def timed_kernel(name: str) -> Any:
    """The compiled drive of a robot of the model with this name along a :class:`Timed` route.

    Args of the kernel: the time step, ``docking`` ``(2,)``, ``docks``, ``limits``, ``goal``, the route, how far the
    robot may plan to drive beyond its goal, ``state`` ``(n,)`` to begin with, ``controls`` ``(T, m)`` and ``places``
    ``(T + 1, 3)``, output. It returns the step of arrival, ``T + 1`` for none.
    """
    robot = MODELS[name]
    (move, dock), steer = make_stepper(robot), steering(name)
    n, m, d, num_limits = robot.state_size, robot.control_size, robot.dimension, len(robot.limit_names)

    @cached_kernel(models_key(SOURCES, (name,)), variant=name, **OPTIONS)
    def drive(
        dt: Any,
        docking: Any,
        docks: Any,
        limits: Any,
        goal: Any,
        route: Any,
        beyond: Any,
        state: Any,
        controls: Any,
        places: Any,
    ) -> Any:
        h, rules = transition.TimeStep(dt[0], dt[1], dt[2], dt[3]), (docking[0], docking[1], docks)
        own, goal_place, x = to_fixed_tuple(limits, num_limits), to_fixed_tuple(goal, d), to_fixed_tuple(state, n)
        points, arcs, last, last_corner = route.points, route.arcs, route.arcs.shape[0] - 1, route.corners.shape[0] - 1
        target_place = np.zeros(d, np.float32)
        at, corner, there, steps, arrival = 0, min(1, last_corner), False, controls.shape[0], controls.shape[0] + 1
        places[0] = 0.0
        for i in range(d):
            places[0, i] = x[i]
        for step in range(steps):
            here = places[step]
            at = point_reached(points, arcs, at, last, here)
            while corner < last_corner and arcs[at] >= route.corners[corner] - 0.02:
                corner += 1
            # It stays where it waits until it may set out, and stops there only if it has to.
            stop = route.corners[last_corner]
            if step < route.departs[corner]:
                stop = route.corners[corner - 1]
            elif corner < last_corner:
                soonest = step + (route.corners[corner] - arcs[at]) / (own[0] * dt[0])
                if soonest + 2 < route.departs[corner + 1]:
                    stop = route.corners[corner]
            pace = np.float32(route.paces[at])
            time = route.arrives[corner] - step
            if time > 1.0 and stop >= route.corners[corner]:
                pace = min(pace, np.float32((route.corners[corner] - arcs[at] + 0.02) / (time * dt[0])))
            target, slowest = min(at + 1, last), route.paces[at]
            while (
                target < last
                and arcs[target] < stop
                and (
                    (arcs[target] - arcs[at] < LOOKAHEAD + 1.5 * dt[0] * slowest and route.bends[target] > 0.0)
                    or square_to(points, target, here) < REACHED
                )
            ):
                target += 1
                slowest = min(slowest, route.paces[target])
            if arcs[target] > stop + 0.02:
                target = at
            room = RESERVE * max(stop - arcs[at], 0.0)
            if stop == route.corners[last_corner]:
                room += beyond
            elif room < 0.1:
                room = np.sqrt(square_to(points, target, here))
            for i in range(d):
                target_place[i] = points[target, i]
            standing = transition.stands(there, docks)
            control = steer(x, to_fixed_tuple(target_place, d), np.float32(room), pace, own, h)
            for i in range(m):
                controls[step, i] = ZERO if standing else control[i]
            control = to_fixed_tuple(controls[step], m)
            x, _, there = dock(standing, move(standing, x, control, own, h), control, own, goal_place, rules)
            places[step + 1] = 0.0
            for i in range(d):
                places[step + 1, i] = x[i]
            done = there and (docks or at == last)
            if not done:
                arrival = steps + 1
            elif arrival > steps:
                arrival = step + 1
        return arrival

    return drive


def drive_by_clock(
    problem: Problem, robot: int, route: Route, stops: Stops, steps: int, *, hurrying: bool = False
) -> tuple[FloatArray, Any, int]:
    """``(controls (T, m), places (T + 1, 3), arrival)`` of one robot along its route.

    Args:
        problem: The team.
        robot: The robot.
        route: Its route.
        stops: Its corners, the steps at which it may set out for each, and at which it should be there.
        steps: ``T``.
        hurrying: Whether it comes to each as soon as it can, and waits only where it would have waited.
    """
    departs, arrives = stops.departs, stops.arrives
    arrays, model = problem.arrays, problem.team.models[robot]
    # Corners are rounded: the middle of those of its points that are passed at its time.
    at = (np.searchsorted(route.times, arrives) + np.searchsorted(route.times, arrives, side="right") - 1) // 2
    if hurrying:
        waits = np.append(False, departs[1:] > arrives[:-1] + 1)
        departs, arrives = np.where(waits, departs, 0.0), np.zeros(len(arrives))
    moves = np.diff(route.points, axis=0)
    arcs = np.append(0.0, np.cumsum(np.sqrt(moves[:, 0] ** 2 + moves[:, 1] ** 2 + moves[:, 2] ** 2)))
    share = HURRYING if hurrying else execution.BRAKING
    paces = execution.paces_along(problem, robot, arcs, route.bends, share)
    controls = np.zeros((steps, problem.control_size), np.float32)
    places = np.empty((steps + 1, 3))
    arrival = timed_kernel(model)(
        arrays.time_step,
        np.array([arrays.squared_goal_radius, arrays.squared_goal_speed]),
        arrays.docks,
        arrays.limits[robot],
        problem.goal[robot],
        Timed(route.points, arcs, paces, route.bends, arcs[at], departs, arrives),
        np.float32(BEYOND if problem.docks and problem.goal_speed is None else 0.0),
        problem.start[robot],
        controls,
        places,
    )
    return controls, places, int(arrival)
