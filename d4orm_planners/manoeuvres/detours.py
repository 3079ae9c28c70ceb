"""Robots that are searched for another motion than the quickest: by a detour, or on a fixed path.

A robot that is planned first takes the quickest way, and is then in the way of others where one of them has to go into
a bay that is on nobody's way. By a detour it goes first to some other place, where it stands while others get by, and
then to its goal. Which place helps is not known: it is drawn from all that the robot can get to. Or it keeps to a
motion, and may only choose how long it stands at each stop.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from d4orm_planners.manoeuvres.costs import unknown_costs
from d4orm_planners.manoeuvres.nodes import Nodes
from d4orm_planners.manoeuvres.primitives import seen_from_first, table
from d4orm_planners.manoeuvres.robots import Robot
from d4orm_planners.manoeuvres.search import Motion, motion_to
from d4orm_planners.manoeuvres.snapping import NOWHERE
from d4orm_planners.manoeuvres.traffic import NEVER


def without_goal(robot: Robot) -> Robot:
    """The robot without a goal, so that a search spreads in all directions; one that docks stays at its goal."""
    goal, limits = robot.task.goal, robot.task.limits._replace(way=NOWHERE)
    nowhere = goal if goal.docks else goal._replace(speed=-1.0)
    return replace(robot, task=robot.task._replace(weight=0.0, goal=nowhere, limits=limits))


def anywhere(robot: Robot, nodes: Nodes, random: np.random.Generator) -> tuple[int, Motion] | None:
    """One of a search's nodes at which the robot may stand for ever, and its motion there; ``None`` without any."""
    count = int(nodes.filled[0])
    modes = nodes.mode[:count]
    free = np.flatnonzero((modes >= 0) & robot.task.primitives.rests[modes] & (nodes.until[:count] == NEVER))
    if not len(free):
        return None
    node = int(random.choice(free))
    return node, motion_to(robot, robot.task, nodes, node)


def starting_from(robot: Robot, nodes: Nodes, node: int, since: int) -> Robot:
    """The robot as it starts again from a node, so many steps later."""
    task = robot.task._replace(horizon=robot.task.horizon - since)
    return replace(robot, start=nodes.pose[node].copy(), mode=int(nodes.mode[node]), task=task)


def on_fixed_path(robot: Robot, motion: Motion) -> Robot:
    """A robot whose moves are those of a motion of it from stop to stop, one after the other."""
    stops = motion.stops.tolist()
    # Modes count down: in mode 0, and in no other, a car with trailers may be at its goal.
    modes, rows = len(stops), []
    for number, (first, end) in enumerate(pairwise(stops)):
        poses, controls = seen_from_first(motion.poses[first : end + 1].astype(float)), motion.controls[first:end]
        # Alone it was not at its goal any sooner than at the end of its motion.
        speed = np.append(np.full(end - first - 1, np.inf), 0.0)
        rows.append((modes - 1 - number, modes - 2 - number, poses, speed, controls))
    primitives, lattice = table(rows, np.ones(modes, bool)), robot.task.lattice._replace(modes=modes)
    # There are too few moves for the order to matter.
    task = robot.task._replace(primitives=primitives, lattice=lattice, costs=unknown_costs(lattice))
    return replace(robot, task=task, mode=modes - 1)
