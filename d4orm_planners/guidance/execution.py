"""Driving along routes under the robots' own dynamics, compiled with numba.

Nobody enters a stretch before all whom it has to let pass have passed, and nobody is ever faster than it can stop
before the next such stretch. Corners are rounded as far as the slack allows, and taken no faster than that.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core import robot_model, transition
from d4orm_env.core.arrays import LARGEST, FloatArray
from d4orm_env.core.dynamics import MODELS
from d4orm_env.core.problem import Problem
from d4orm_env.core.robot_model import ACCELERATION, SPEED, TURN_RATE
from d4orm_env.engine import lanes, tiles
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.tiles import ONE, OPS, OPTIONS, ZERO, compiled, inlined, make_stepper, models_key, to_fixed_tuple
from d4orm_planners.guidance.routes import Routes

SOURCES = fingerprint((robot_model, transition, lanes, tiles))

LOOKAHEAD = 0.05
"""Of the point of its route that a robot heads for, beyond what it drives in a step and a half [m]."""
BRAKING = 0.5
"""Share of its acceleration that a robot counts on before corners and in them."""
FACING, CREEP = np.float32(0.8), np.float32(0.01)
"""Cosine of the angle between heading and way from which on a robot drives, and share of its speed before that."""
REACHED = 4e-4
"""Square of the distance from which on a robot has come to a point [m^2]."""
RESERVE = 0.8
"""Share of the way to where it must stop that a robot plans to stop in."""
BEYOND = 2.0
"""How far beyond its goal a robot plans to drive that is stopped by arriving [m]."""
SLOWEST = 0.1
"""Share of its speed at which a robot creeps round the sharpest corner."""


class Progress(NamedTuple):
    """How far robots are, and what they are to do next.

    Attributes:
        at: ``(K,)`` int64 the point of its route that each is at, counted from its first.
        waits: ``(K,)`` int64 the wait of each that is not over, or where its waits end.
        targets: ``(K, 3)`` float32 where each heads [m].
        room: ``(K,)`` float32 how far it may drive on [m].
        pace: ``(K,)`` float32 how fast [m/s].
    """

    at: Any
    waits: Any
    targets: Any
    room: Any
    pace: Any


@compiled
def square_to(points: Any, i: Any, place: Any) -> Any:
    """Squared distance of a point from a place."""
    dx, dy, dz = points[i, 0] - place[0], points[i, 1] - place[1], points[i, 2] - place[2]
    return dx * dx + dy * dy + dz * dz


@compiled
def point_reached(points: Any, arcs: Any, at: Any, last: Any, place: Any) -> Any:
    """The point that a robot has come to that was at ``at``: as far on as each next one is nearer, or reached."""
    following = at
    while following < last:
        following += 1
        # Where two arcs join, points coincide but for rounding.
        if arcs[following] - arcs[at] > 0.01 or following == last:
            gap = square_to(points, following, place)
            if gap > square_to(points, at, place) and gap > REACHED:
                break
            at = following
    return at


@cached_kernel(SOURCES, variant="direct", **OPTIONS)
def direct(routes: Any, paces: Any, dt: Any, beyond: Any, positions: Any, standing: Any, progress: Any) -> None:
    """Say where everybody is to drive next.

    Args:
        routes: The routes.
        paces: ``(T,)`` how fast each point may be passed [m/s].
        dt: Time step [s].
        beyond: How far robots may plan to drive beyond their goals, which stop them [m].
        positions: ``(K, 3)`` float64 where they are [m].
        standing: ``(K,)`` bool who has docked, and so is at the end of its route.
        progress: Changed in place.
    """
    points, arcs, num_robots = routes.points, routes.arcs, routes.first.shape[0] - 1
    for k in range(num_robots):
        first, last = routes.first[k], routes.first[k + 1] - 1
        i = point_reached(points, arcs, first + progress.at[k], last, positions[k])
        progress.at[k] = (last if standing[k] else i) - first
    for k in range(num_robots):
        first, last = routes.first[k], routes.first[k + 1] - 1
        wait, end = progress.waits[k], routes.wait_first[k + 1]
        while wait < end and progress.at[routes.wait_for[wait]] >= routes.wait_until[wait]:
            wait += 1
        progress.waits[k] = wait
        i, here = first + progress.at[k], positions[k]
        limit = last if wait == end else max(first + routes.wait_at[wait] - 1, i)
        # The slower it must be there, the less far ahead it looks. A sharp corner is driven to before it is turned, and
        # left as soon as it is as good as reached.
        target, slowest = min(i + 1, limit), paces[i]
        while target < limit and (
            (arcs[target] - arcs[i] < LOOKAHEAD + 1.5 * dt * slowest and routes.bends[target] > 0.0)
            or square_to(points, target, here) < REACHED
        ):
            target += 1
            slowest = min(slowest, paces[target])
        progress.targets[k, 0], progress.targets[k, 1] = points[target, 0], points[target, 1]
        progress.targets[k, 2] = points[target, 2]
        room = RESERVE * (arcs[limit] - arcs[i])
        if limit - i <= 1:
            room = np.sqrt(square_to(points, limit, here))
        progress.room[k] = room + (beyond if limit == last else 0.0)
        progress.pace[k] = paces[i]


@cached_kernel(SOURCES, variant="paces", **OPTIONS)
def fill_paces(arcs: Any, dt: Any, corner: Any, speed: Any, braking: Any, paces: Any) -> None:
    """How fast every point of a route may be passed.

    Args:
        arcs: ``(P,)`` length of the route up to each [m].
        dt: Time step, in which a robot should not drive past a corner [s].
        corner: ``(P,)`` how fast each could be by itself [m/s].
        speed: How fast the robot can be [m/s].
        braking: How fast it brakes [m/s^2].
        paces: ``(P,)`` output.
    """
    after = before = speed
    for i in range(arcs.shape[0] - 1, -1, -1):
        if i + 1 < arcs.shape[0]:
            way = arcs[i + 1] - arcs[i]
            after = min(np.sqrt(after * after + 2 * braking * way), before + way / (2 * dt))
        after = before = min(min(after, corner[i]), speed)
        paces[i] = max(after, SLOWEST * speed)


@cache
def steering(name: str) -> Any:
    """Compiled control of a robot of the model with this name towards a target.

    ``(state, target, room, pace, limits, h) -> control`` drives as fast as ``pace`` allows, and so as to be able to
    stop within ``room``.
    """
    robot = MODELS[name]
    approach, track = inlined(robot.functions.approach), inlined(robot.functions.track)
    limit_control = inlined(robot.functions.limit_control)
    d, heading = robot.dimension, -1 if robot.heading_index is None else robot.heading_index
    if d == 2:

        @inlined
        def scaled(origin: Any, step: Any, factor: Any) -> Any:
            return (origin[0] + step[0] * factor, origin[1] + step[1] * factor)

        @inlined
        def length(step: Any) -> Any:
            return np.sqrt(step[0] * step[0] + step[1] * step[1])

        @inlined
        def between(state: Any, target: Any) -> Any:
            return (target[0] - state[0], target[1] - state[1])
    else:

        @inlined
        def scaled(origin: Any, step: Any, factor: Any) -> Any:
            return (origin[0] + step[0] * factor, origin[1] + step[1] * factor, origin[2] + step[2] * factor)

        @inlined
        def length(step: Any) -> Any:
            return np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])

        @inlined
        def between(state: Any, target: Any) -> Any:
            return (target[0] - state[0], target[1] - state[1], target[2] - state[2])

    @inlined
    def steer(state: Any, target: Any, room: Any, pace: Any, limits: Any, h: Any) -> Any:
        gap = between(state, target)
        distance = length(gap)
        # As fast as it could drive to a point straight ahead that is as far off as its room goes, towards its target.
        factor = room / distance if distance > ZERO else ZERO
        wanted = approach(state, scaled(state, gap, factor), limits, h, OPS)
        if heading >= 0 and distance > ZERO:
            # It turns before it drives.
            facing = (OPS.cos(state[heading]) * gap[0] + OPS.sin(state[heading]) * gap[1]) / distance
            pace *= min(max((facing - FACING) / (ONE - FACING), CREEP), ONE)
        speed = length(wanted)
        if speed > pace:
            factor = pace / speed
            wanted = scaled(between(wanted, wanted), wanted, factor)
        return limit_control(track(state, wanted, limits, h, OPS), limits, OPS)

    return steer


@cache
def drive_kernel(name: str) -> Any:
    """One compiled step of the robots of the model with this name that drive to where they are directed.

    Args of the kernel: the time step, ``docking`` ``(2,)``, ``docks``, ``robots`` ``(B,)``, ``limits`` and ``goals`` of
    these, the whole team's :class:`Progress`, ``states`` ``(K, n)`` and ``docked`` ``(K,)`` changed in place, and
    ``controls`` ``(K, m)`` output.
    """
    robot = MODELS[name]
    (move, dock), steer = make_stepper(robot), steering(name)
    n, m, d, num_limits = robot.state_size, robot.control_size, robot.dimension, len(robot.limit_names)

    @cached_kernel(models_key(SOURCES, (name,)), variant=name, **OPTIONS)
    def drive(
        dt: Any,
        docking: Any,
        docks: Any,
        robots: Any,
        limits: Any,
        goals: Any,
        progress: Any,
        states: Any,
        docked: Any,
        controls: Any,
    ) -> None:
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        rules = (docking[0], docking[1], docks)
        for b in range(robots.shape[0]):
            k = robots[b]
            own, goal = to_fixed_tuple(limits[b], num_limits), to_fixed_tuple(goals[b], d)
            state, target = to_fixed_tuple(states[k], n), to_fixed_tuple(progress.targets[k], d)
            standing = transition.stands(docked[k], docks)
            control = steer(state, target, progress.room[k], progress.pace[k], own, h)
            for i in range(m):
                controls[k, i] = ZERO if standing else control[i]
            control = to_fixed_tuple(controls[k], m)
            state, _, docked[k] = dock(standing, move(standing, state, control, own, h), control, own, goal, rules)
            for i in range(n):
                states[k, i] = state[i]

    return drive


def drive_along(problem: Problem, routes: Routes, most_steps: int) -> tuple[FloatArray, Any, Any]:
    """Drive the team along its routes until everybody has arrived, or for ``most_steps``.

    Args:
        problem: The team.
        routes: Its routes.
        most_steps: ``T``, if it does not end sooner.

    Returns:
        Controls ``(T, K, m)``, places ``(T + 1, K, 3)`` float64 [m] and ``(K,)`` the step of each arrival; ``T + 1``
        for who has not arrived.
    """
    team, arrays, d, num_robots = problem.team, problem.arrays, problem.dimension, problem.num_robots
    paces = np.concatenate(
        [paces_along(problem, robot, routes.arcs[own], routes.bends[own]) for robot, own in enumerate(routes.each())]
    )
    controls = np.zeros((most_steps, num_robots, problem.control_size), np.float32)
    states, docked = problem.start.copy(), np.zeros(num_robots, bool)
    progress = Progress(
        at=np.zeros(num_robots, np.int64),
        waits=routes.wait_first[:-1].copy(),
        targets=np.zeros((num_robots, 3), np.float32),
        room=np.zeros(num_robots, np.float32),
        pace=np.zeros(num_robots, np.float32),
    )
    places = np.zeros((most_steps + 1, num_robots, 3))
    arrivals = np.full(num_robots, most_steps + 1, np.int64)
    docking = np.array([arrays.squared_goal_radius, arrays.squared_goal_speed])
    parts = []
    for name in dict.fromkeys(team.models):
        robots = np.array([k for k, model in enumerate(team.models) if model == name], np.int64)
        parts.append((drive_kernel(name), robots, arrays.limits[robots], problem.goal[robots]))
    beyond = BEYOND if problem.docks and problem.goal_speed is None else 0.0
    ends, steps = np.diff(routes.first) - 1, 0
    while True:
        places[steps, :, :d] = states[:, :d]
        direct(routes, paces, problem.dt, beyond, places[steps], docked & problem.docks, progress)
        # Without docking a robot may come through its goal before it has made way for others.
        there = docked & (problem.docks | (progress.at == ends))
        arrivals[:] = np.where(there, np.minimum(arrivals, steps), most_steps + 1)
        if steps == most_steps or there.all():
            return controls[:steps], places[: steps + 1], arrivals
        for drive, *rows in parts:
            drive(arrays.time_step, docking, arrays.docks, *rows, progress, states, docked, controls[steps])
        steps += 1


def paces_along(problem: Problem, robot: int, arcs: Any, bends: Any, share: float = BRAKING) -> Any:
    """``(P,)`` how fast a robot may pass each point of its route [m/s], from their places along it and their bends.

    It counts on that share of its acceleration.
    """
    model, limits = problem.team.robot_models[robot], np.asarray(problem.team.limits[robot], np.float64)
    corner = np.sqrt(share * limits[ACCELERATION] * bends)
    if model.heading_index is not None:
        corner = np.minimum(corner, share * limits[TURN_RATE] * bends)
    braking = share * limits[ACCELERATION] if ACCELERATION in model.control_limits else LARGEST
    paces = np.empty(len(arcs))
    fill_paces(arcs, problem.dt, corner, limits[SPEED], braking, paces)
    return paces
