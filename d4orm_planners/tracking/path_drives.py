"""Driving along routes under the robots' own dynamics, compiled with numba.

No robot enters a stretch before all that it has to let pass have passed, or is ever faster than it can stop before the
next such stretch. Corners are rounded as far as the slack allows, and taken no faster than that.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import LARGEST, BoolArray, FloatArray, Floats, IntArray, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, TURN_RATE, TimeStep
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, inlined, to_fixed_tuple
from d4orm_env.engine.stepping import Row, models_key
from d4orm_planners.tracking.pursuit import lookaheads, point_ahead, point_reached, square_to, steering
from d4orm_planners.tracking.steering import by_model
from d4orm_planners.tracking.tracker import tracker


class Route(NamedTuple):
    """One robot's path as a row of points."""

    points: Floats  #: ``(P, 3)`` float64 [m]
    times: Floats  #: ``(P,)`` float64 when each is passed, of which only the order counts
    bends: Floats  #: ``(P,)`` float64 radius of the bend at each point [m]; infinite if straight, zero if sharp


class Routes(NamedTuple):
    """Every robot's route, and the robots that it waits for."""

    points: Floats  #: ``(T, 3)`` float64 points of all routes, one robot's after another's [m]
    times: Floats  #: ``(T,)`` float64, see :class:`Route`
    bends: Floats  #: ``(T,)`` float64
    first: IntArray  #: ``(K + 1,)`` int64 where each robot's begin
    arcs: Floats  #: ``(T,)`` float64 length of the route up to each point [m]
    wait_first: IntArray  #: ``(K + 1,)`` int64 where each robot's waits begin
    wait_at: IntArray  #: int64 points, counted from the robot's first, that it may not come to ...
    wait_for: IntArray  #: ... before this robot ...
    wait_until: IntArray  #: ... has come to this point of its own.

    def each(self) -> list[slice]:
        """The rows of every robot."""
        return [slice(low, high) for low, high in pairwise(self.first)]


class Corners(NamedTuple):
    """Corners of paths, one robot's after another's, each from its start on."""

    positions: Floats  #: ``(C, 3)`` float64 [m]
    begin: IntArray  #: ``(K + 1,)`` int64 where each robot's begin
    departs: Floats  #: ``(C,)`` float64 when it sets out for each from the one before
    arrives: Floats  #: ``(C,)`` float64 when it gets there


BRAKING = 0.5  #: Share of its acceleration that a robot counts on before corners and in them
RESERVE = 0.8  #: Share of the path to where it must stop that a robot plans to stop in
BEYOND = 4.0  #: Distance beyond its goal that a robot plans to drive if arriving stops it, in stops from full speed
SLOWEST = 0.1  #: Share of its speed at which a robot creeps round the sharpest corner


class Progress(NamedTuple):
    """Progress of robots along their routes."""

    at: IntArray  #: ``(K,)`` int64 the point of its route that each is at, counted from its first
    waits: IntArray  #: ``(K,)`` int64 the wait of each that is not over, or where its waits end
    targets: FloatArray  #: ``(K, 3)`` float32 where each heads [m]
    room: FloatArray  #: ``(K,)`` float32 how far it may drive on [m]
    pace: FloatArray  #: ``(K,)`` float32 how fast [m/s]

    @classmethod
    def of(cls, routes: Routes) -> Progress:
        """Return that of robots that are about to set out."""
        waits, size = routes.wait_first[:-1].copy(), len(routes.first) - 1
        targets = np.zeros((size, 3), np.float32)
        return cls(np.zeros(size, np.int64), waits, targets, np.zeros(size, np.float32), np.zeros(size, np.float32))


RouteStep: TypeAlias = Kernel[[ProblemArrays, IntArray, Progress, BoolArray, FloatArray, FloatArray], None]
"""A kernel of :func:`route_kernel`."""


@cached_kernel(variant="direct", **OPTIONS)
def direct(
    routes: Routes,
    paces: Floats,
    lookahead: Floats,
    dt: float,
    beyond: float,
    size: float,
    positions: Floats,
    at_rest: BoolArray,
    progress: Progress,
) -> None:
    """Set the next target of all robots.

    Args:
        routes: The routes.
        paces: ``(T,)`` how fast each point may be passed [m/s].
        lookahead: ``(K,)`` least distance ahead at which robots look [m].
        dt: Time step [s].
        beyond: Distance beyond their goals that robots may plan to drive, if these stop them [m].
        size: The radius of the largest robot [m].
        positions: ``(K, 3)`` float64 where they are [m].
        at_rest: ``(K,)`` bool: arrived, and so at the end of its route.
        progress: Changed in place.
    """
    points, arcs, num_robots = routes.points, routes.arcs, routes.first.shape[0] - 1
    for k in range(num_robots):
        first, last = routes.first[k], routes.first[k + 1] - 1
        i = point_reached(points, arcs, first + progress.at[k], last, positions[k], size)
        progress.at[k] = (last if at_rest[k] else i) - first
    for k in range(num_robots):
        first, last = routes.first[k], routes.first[k + 1] - 1
        wait, end = progress.waits[k], routes.wait_first[k + 1]
        while wait < end and progress.at[routes.wait_for[wait]] >= routes.wait_until[wait]:
            wait += 1
        progress.waits[k] = wait
        i, here = first + progress.at[k], positions[k]
        limit = last if wait == end else max(first + routes.wait_at[wait] - 1, i)
        target = point_ahead(routes, paces, i, limit, np.inf, (lookahead[k], dt), here, size)
        progress.targets[k, 0], progress.targets[k, 1] = points[target, 0], points[target, 1]
        progress.targets[k, 2] = points[target, 2]
        room = RESERVE * (arcs[limit] - arcs[i])
        if limit - i <= 1:
            room = np.sqrt(square_to(points, limit, here))
        progress.room[k] = room + (beyond if limit == last else 0.0)
        progress.pace[k] = paces[i]


@cached_kernel(variant="paces", **OPTIONS)
def fill_paces(arcs: Floats, dt: float, corner: Floats, speed: float, braking: float, paces: Floats) -> None:
    """Fill in the speed at which every point of a route may be passed.

    Args:
        arcs: ``(P,)`` length of the route up to each [m].
        dt: Time step, in which a robot should not drive past a corner [s].
        corner: ``(P,)`` how fast each could be by itself [m/s].
        speed: Largest speed of the robot [m/s].
        braking: Its deceleration [m/s^2].
        paces: ``(P,)`` output.
    """
    after = before = speed
    for i in range(arcs.shape[0] - 1, -1, -1):
        if i + 1 < arcs.shape[0]:
            distance = arcs[i + 1] - arcs[i]
            after = min(np.sqrt(after * after + 2 * braking * distance), before + distance / (2 * dt))
        after = before = min(min(after, corner[i]), speed)
        paces[i] = max(after, SLOWEST * speed)


@cache
def route_kernel(name: str) -> RouteStep:
    """One compiled step of the robots of the model with this name that drive to where they are directed.

    Args of the kernel: the team, the numbers ``(B,)`` of these robots, the whole team's :class:`Progress`, ``arrived``
    ``(K,)`` and ``states`` ``(2, K, n)`` before the step and after it, changed in place, and ``controls`` ``(1, K,
    m)``, output.
    """
    model = MODELS[name]
    steer, n, d = steering(name), model.state_size, model.dimension

    @inlined
    def as_directed(
        progress: Progress, k: Whole, step: int, x: Row, goal: Row, limits: Row, h: TimeStep
    ) -> tuple[Row, Whole, bool]:
        target = to_fixed_tuple(progress.targets[k], d)
        return steer(x, target, progress.room[k], progress.pace[k], True, limits, h), k, True

    drive = tracker(model, as_directed)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive_step(
        arrays: ProblemArrays, robots: IntArray, progress: Progress, arrived: BoolArray, states: FloatArray,
        controls: FloatArray,
    ) -> None:  # fmt: skip
        for k in robots:
            state = to_fixed_tuple(states[0, k], n)
            arrived[k] = drive(arrays, k, progress, k, 0, state, arrived[k], controls[:, k], states[:, k]) <= 1

    return drive_step


def drive_routes(problem: Problem, routes: Routes, most_steps: int) -> tuple[FloatArray, Floats, IntArray]:
    """Drive the team along its routes until all have arrived, or for ``most_steps``.

    Controls ``(T, K, m)``, positions ``(T + 1, K, 3)`` float64 [m] and ``(K,)`` the step of each arrival; ``T + 1`` for
    one that has not arrived.
    """
    d, num_robots = problem.dimension, problem.num_robots
    paces = np.concatenate(
        [paces_along(problem, robot, routes.arcs[own], routes.bends[own]) for robot, own in enumerate(routes.each())]
    )
    controls = np.zeros((most_steps, num_robots, problem.control_size), np.float32)
    states, arrived = np.stack([problem.start, problem.start]), np.zeros(num_robots, bool)
    positions, progress = np.zeros((most_steps + 1, num_robots, 3)), Progress.of(routes)
    arrivals = np.full(num_robots, most_steps + 1, np.int64)
    lookahead, beyond, size = lookaheads(problem), beyond_goal(problem), problem.team.largest_radius
    parts = [(route_kernel(model.name), np.array(robots)) for model, robots in by_model(problem)]
    ends, steps = np.diff(routes.first) - 1, 0
    while True:
        positions[steps, :, :d] = states[0, :, :d]
        direct(routes, paces, lookahead, problem.dt, beyond, size, positions[steps], arrived & problem.docks, progress)
        # Without absorbing goals a robot may pass its goal before it has yielded to others.
        done = arrived & (problem.docks | (progress.at == ends))
        arrivals[:] = np.where(done, np.minimum(arrivals, steps), most_steps + 1)
        if steps == most_steps or done.all():
            return controls[:steps], positions[: steps + 1], arrivals
        for drive, robots in parts:
            drive(problem.arrays, robots, progress, arrived, states, controls[steps : steps + 1])
        states[0] = states[1]
        steps += 1


def beyond_goal(problem: Problem) -> float:
    """Return the distance beyond their goals that robots plan to drive, if these stop them [m]."""
    if not problem.docks or np.isfinite(problem.goal_speed).any():
        return 0.0
    speed, acceleration = (problem.team.limits[:, column].astype(np.float64) for column in (SPEED, ACCELERATION))
    return float((BEYOND * speed**2 / (2 * acceleration)).max())


def paces_along(problem: Problem, robot: int, arcs: Floats, bends: Floats, share: float = BRAKING) -> Floats:
    """``(P,)`` speeds at which a robot may pass the points of its route, with a share of its acceleration [m/s].

    ``arcs`` and ``bends`` are as in :class:`Routes`.
    """
    model, limits = problem.team.robot_models[robot], np.asarray(problem.team.limits[robot], np.float64)
    corner = np.sqrt(share * limits[ACCELERATION] * bends)
    if model.heading_index is not None:
        corner = np.minimum(corner, share * limits[TURN_RATE] * bends)
    limited = {*model.control_limits, *(column for _, column in model.state_limits)}
    braking = share * limits[ACCELERATION] if ACCELERATION in limited else LARGEST
    paces = np.empty(len(arcs))
    fill_paces(arcs, problem.dt, corner, limits[SPEED], braking, paces)
    return paces
