"""Motions into and out of tight places, by way of poses in the open.

A search for the way into a gap hardly longer than the robot spends its nodes in front of it: costs to the goal are
those of coarse cells, which do not tell the poses that lead in. Out of the gap any way is good. So a search with short
moves and small cells spreads from the goal, backwards in time, and one from a start in such a place ahead; the usual
one joins what they come to in the open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.world import World
from d4orm_planners.manoeuvres.closing import ends_of
from d4orm_planners.manoeuvres.costs import unknown_costs
from d4orm_planners.manoeuvres.lattice import TURN, RobotBody
from d4orm_planners.manoeuvres.nodes import Nodes, Task
from d4orm_planners.manoeuvres.primitives import POSE_SIZE, primitives_of
from d4orm_planners.manoeuvres.robots import CERTAIN, ManoeuvreScene, Robot, make_robot
from d4orm_planners.manoeuvres.search import Motion
from d4orm_planners.manoeuvres.shortening import closed
from d4orm_planners.manoeuvres.snapping import NOWHERE, Goal
from d4orm_planners.manoeuvres.traffic import Traffic

MAX_NODES, WAYS = 50_000, 3
"""Nodes of a search, and poses in the open that are tried."""
FINER = (0.04, 0.025)
"""Sizes of the cells near to start and goal that are tried in turn, as shares of the usual one."""
EXACT = 0.02
"""Share of the goal's tolerances within which a robot comes to a pose from which there is a way in, so that this is one
from there too."""
ARRIVED = 0.9996 / CERTAIN
"""Share of the goal's tolerances within which a robot arrives: its motion ends at once, and no rounding adds up."""
PLACES, ASIDE = 8, 0.85
"""Places round the goal at which the robot has arrived as well, so great a share of the goal's radius from it."""
IN_LINE = np.zeros(POSE_SIZE)


class Way(NamedTuple):
    """A way between a pose in the open and a start or a goal."""

    pose: Floats  #: ``(6,)``
    controls: Floats  #: ``(T, m)``


def motion_by_the_open(
    scene: ManoeuvreScene, robot: Robot, nobody: Traffic, nodes: Nodes, find: Callable[[Robot, int], Motion | None]
) -> Motion | None:
    """A robot's motion if there were nobody else, by way of poses in the open; ``None`` if none is found.

    ``find`` looks for a robot's motion in ``nodes``, in so many of them.
    """
    for share in FINER:
        careful = make_robot(scene.with_finer_cells(share), robot.task.body.robot)
        if careful is None:
            return None
        for out, into in product(*_ways_out_and_in(scene, careful, nodes, find)):
            motion = _joined(scene, robot, out, into, nobody, nodes, find)
            if motion is not None and motion.steps <= scene.problem.horizon:
                return motion
    return None


def _ways_out_and_in(
    scene: ManoeuvreScene, robot: Robot, nodes: Nodes, find: Callable[[Robot, int], object]
) -> tuple[list[Way], list[Way | None]]:
    """Ways out of the start, one of no steps if it is in the open, and into the goal, ``None`` for the usual ones."""
    task, outs = robot.task, [Way(robot.start, np.zeros((0, robot.model.control_size)))]
    ins: list[Way | None] = [None]
    if not len(_in_the_open(scene, task.body, robot.start[None])):
        find(_towards(robot, task.goal.x, task.goal.y), MAX_NODES)
        outs = list(_ways(scene, task, nodes))
    if not (np.isnan(task.goal.heading) or scene.bent[task.body.robot] or np.nan_to_num(task.goal.hitches).any()):
        back = _backwards(robot, _roomiest(scene.problem.world, task.goal))
        find(back, MAX_NODES)
        ins = list(_ways(scene, back.task, nodes, out=False))
    return outs, ins


def _joined(
    scene: ManoeuvreScene, robot: Robot, out: Way, into: Way | None, nobody: Traffic, nodes: Nodes,
    find: Callable[[Robot, int], Motion | None],
) -> Motion | None:  # fmt: skip
    """The motion by a way out, one that is looked for in the open, and a way in, or else right to the goal."""
    problem, number, goal = scene.problem, robot.task.body.robot, robot.task.goal
    if into is not None:
        x, y, heading = into.pose[:3].tolist()
        goal = goal._replace(x=x, y=y, heading=heading, docks=False)
    ahead = make_robot(scene, number, goal)
    if ahead is None:
        return None
    if len(out.controls):
        ahead = replace(ahead, start=out.pose, mode=0)
    motion = find(replace(ahead, task=ahead.task._replace(in_line=True)) if into is not None else ahead, MAX_NODES)
    if motion is None:
        return None
    start, controls, first = problem.start[number], np.concatenate([out.controls, motion.controls]), len(out.controls)
    if into is None:
        ends = ends_of(problem, number, goal, motion.poses[-1])
        return closed(ahead, start, ends, controls, first, nobody, nodes)
    # Wheels have to be straight there too, and all this to a small part of the tolerance.
    ends = ends_of(problem, number, goal, IN_LINE)
    ends = ends._replace(tolerance=EXACT * np.where(np.isinf(ends.tolerance), goal.tolerance, ends.tolerance))
    if closed(ahead, start, ends, controls, first, nobody, nodes) is None:
        return None
    controls = np.concatenate([controls, into.controls])
    controls, anywhere = controls[: _until_arrival(robot, start, controls)], np.full_like(ends.goal, np.inf)
    return closed(ahead, start, ends._replace(tolerance=anywhere), controls, 0, nobody, nodes)


def _until_arrival(robot: Robot, start: FloatArray, controls: Floats) -> int:
    """Steps of controls ``(T, m)`` from a state after which a robot that docks arrives, or all of them."""
    goal, model = robot.task.goal, robot.model
    states: Floats = np.array(robot.kind.states(tuple(start[: model.state_size].tolist()), controls))
    turn = states[1:, model.heading_index] - goal.heading
    far = np.linalg.norm(states[1:, :2] - (goal.x, goal.y), axis=1) / goal.radius
    far = np.maximum(far, np.abs(turn - TURN * np.rint(turn / TURN)) / goal.tolerance)
    slow = np.linalg.norm(states[1:, list(model.speed_indices)], axis=1) <= goal.speed
    arrived = np.flatnonzero((far <= ARRIVED) & slow)
    return int(arrived[0]) + 1 if goal.docks and len(arrived) else len(controls)


def _roomiest(world: World, goal: Goal) -> Goal:
    """The goal, or a place at which the robot has arrived as well, as far from everything as there is."""
    sine, cosine = portable.sin_cos(np.linspace(0, TURN, PLACES, endpoint=False))
    aside = ASIDE * goal.radius * np.concatenate([np.zeros((1, 2)), np.stack([cosine, sine], axis=1)])
    places = np.array([goal.x, goal.y]) + aside
    x, y = places[world.clearance(places).argmax()].tolist()
    return goal._replace(x=x, y=y)


def _towards(robot: Robot, x: float, y: float) -> Robot:
    """The robot as it spreads from where it starts, towards a place first, and does not end there."""
    task = robot.task
    goal = Goal(x, y, np.nan, (np.nan,) * 3, 0.0, np.inf, -1.0, docks=False)
    limits, costs = task.limits._replace(way=NOWHERE), unknown_costs(task.lattice, 1 / task.body.stride)
    return replace(robot, task=task._replace(limits=limits, goal=goal, costs=costs))


def _backwards(robot: Robot, place: Goal) -> Robot:
    """The robot backwards in time: it sets out from a place, towards its start."""
    begin = np.zeros(POSE_SIZE)
    begin[:3] = place.x, place.y, place.heading
    robot = _towards(robot, *robot.start[:2].tolist())
    task = robot.task._replace(primitives=primitives_of(robot.kind)[1])
    return replace(robot, start=begin, mode=0, task=task)


def _in_the_open(scene: ManoeuvreScene, body: RobotBody, poses: Floats) -> IntArray:
    """Numbers of the poses ``(N, 6)`` in which a robot can turn without touching anything."""
    distance = float(body.arrays.radius[body.robot]) + scene.extra
    return np.flatnonzero(scene.problem.world.is_clear(poses[:, :2], distance))


def _ways(scene: ManoeuvreScene, task: Task, nodes: Nodes, *, out: bool = True) -> Iterator[Way]:
    """Ways to poses in the open, at rest and in line, that a search has come to, or from there if it went backwards."""
    count, primitives, body = int(nodes.filled[0]), task.primitives, task.body
    pose, time = nodes.pose[:count].copy(), nodes.time[:count].copy()
    move, parent = nodes.move[:count].copy(), nodes.parent[:count].copy()
    in_line = np.flatnonzero(nodes.mode[1:count] == 0) + 1
    found = in_line[_in_the_open(scene, body, pose[in_line])]
    left = np.linalg.norm(pose[found, :2] - (task.goal.x, task.goal.y), axis=1) / body.stride
    order = found[np.argsort(time[found] + left, kind="stable")]
    for _ in range(WAYS):
        if not len(order):
            return
        at, node, controls = int(order[0]), int(order[0]), list[FloatArray]()
        while parent[at] >= 0:
            first, end = primitives.first[move[at] : move[at] + 2]
            controls.append(primitives.controls[first:end])
            at = int(parent[at])
        yield Way(pose[node], np.concatenate(controls[::-1] if out else controls).astype(np.float64))
        apart = np.linalg.norm(pose[order, :2] - pose[node, :2], axis=1)
        order = order[apart > body.arrays.radius[body.robot]]
