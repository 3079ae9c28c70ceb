"""Detours: a robot goes first to some other place, where it stands while others get by, and then to its goal.

A robot that is planned first takes the quickest way, and is then in the way of others where one of them has to go into
a bay that is on nobody's way. Which place helps is not known: it is drawn from all that the robot can get to.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from d4orm_planners.manoeuvres.nodes import Nodes
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
