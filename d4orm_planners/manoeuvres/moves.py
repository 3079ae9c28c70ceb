"""Poses of a robot in every step of a move, and the check that obstacles let it pass."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.engine.compiling import compiled
from d4orm_planners.manoeuvres.lattice import RobotBody, is_far_from_all, is_free, moved, turned_by
from d4orm_planners.manoeuvres.nodes import MAX_STEPS, Nodes, Task
from d4orm_planners.manoeuvres.snapping import Goal, snap_of, snap_pose, snap_steps

AHEAD, BEHIND = -2, -3
"""Moves that are no primitives: the last stretch, forwards and backwards."""


@compiled
def reaches(goal: Goal, x: float, y: float, heading: float, speed: float, wider: float) -> bool:
    """Check whether a robot is at its goal."""
    dx, dy, radius = goal.x - x, goal.y - y, goal.radius * wider
    if dx * dx + dy * dy > radius * radius or speed > goal.speed:
        return False
    return np.isnan(goal.heading) or abs(turned_by(goal.heading - heading)) <= goal.tolerance * wider


@compiled
def sweep(task: Task, nodes: Nodes, node: int, move: int) -> int:
    """Fill in where a move leads, step by step, from the node on; return how many steps."""
    pose, limits, swept = nodes.pose[node], task.limits, nodes.swept
    swept[0, 0], swept[0, 1], swept[0, 2], swept[0, 3] = pose[0], pose[1], pose[2], 0.0
    if move >= 0:
        first, end = task.primitives.first[move], task.primitives.first[move + 1]
        for step in range(end - first):
            x, y, heading = moved(pose[0], pose[1], pose[2], task.primitives.poses[first + step])
            swept[step + 1, 0], swept[step + 1, 1], swept[step + 1, 2] = x, y, heading
            swept[step + 1, 3] = task.primitives.speed[first + step]
        return end - first
    snap = snap_of(limits, task.goal, pose[0], pose[1], pose[2], -1.0 if move == BEHIND else 1.0)
    count = snap_steps(snap)
    if count >= MAX_STEPS:
        return 0
    for step in range(1, count + 1):
        x, y, heading, speed = snap_pose(limits, snap, pose[0], pose[1], pose[2], step)
        swept[step, 0], swept[step, 1], swept[step, 2], swept[step, 3] = x, y, turned_by(heading), speed
    return count


@compiled
def docks_after(task: Task, nodes: Nodes, count: int) -> int:
    """Steps of a move after which the robot docks: more than it has for none, zero where rounding decides."""
    for step in range(1, count + 1):
        x, y, heading, speed = nodes.swept[step]
        if reaches(task.goal, x, y, heading, speed, 1.02):
            return step if reaches(task.goal, x, y, heading, speed, 1.0) else 0
    return count + 1


@compiled
def is_sweep_free(body: RobotBody, swept: Floats, count: int, buffer: FloatArray) -> bool:
    """Check whether a move is clear of obstacles and bounds, in all parts of all steps."""
    for step in range(count, 0, -1):
        before, after = swept[step - 1], swept[step]
        if is_far_from_all(body, after[0], after[1], body.stride):
            continue
        turn = turned_by(after[2] - before[2])
        for part in range(body.parts):
            back = part / body.parts
            x, y = after[0] - back * (after[0] - before[0]), after[1] - back * (after[1] - before[1])
            if not is_free(body, x, y, after[2] - back * turn, buffer):
                return False
    return True
