"""Poses of a robot in every step of a move, and the check that obstacles let it pass."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem_checks import MOST_TRAILERS
from d4orm_env.engine.compiling import compiled
from d4orm_planners.manoeuvres.curves import curve_of, sweep_curve
from d4orm_planners.manoeuvres.kinds import MAX_STEPS
from d4orm_planners.manoeuvres.lattice import (
    RobotBody,
    is_far_from_all,
    is_free,
    moved,
    pose_between,
    turned_by,
    write_pose,
)
from d4orm_planners.manoeuvres.nodes import Nodes, Task
from d4orm_planners.manoeuvres.primitives import POSE_SIZE
from d4orm_planners.manoeuvres.snapping import CURVING, Goal, snap_of, snap_pose, snap_steps

AHEAD, BEHIND = -2, -3
"""Moves that are no primitives: the last stretch, forwards and backwards."""


@compiled
def reaches(goal: Goal, pose: Floats, speed: float, wider: float) -> bool:
    """Check whether a robot is at its goal in a pose ``(6,)``, radius and heading tolerance so many times as wide."""
    dx, dy, radius, tolerance = goal.x - pose[0], goal.y - pose[1], goal.radius * wider, goal.tolerance * wider
    if dx * dx + dy * dy > radius * radius or speed > goal.speed:
        return False
    for i in range(MOST_TRAILERS):
        if abs(goal.hitches[i] - pose[3 + i]) > tolerance:  # not if it is NaN
            return False
    return np.isnan(goal.heading) or abs(turned_by(goal.heading - pose[2])) <= tolerance


@compiled
def sweep(task: Task, nodes: Nodes, node: int, move: int) -> int:
    """Fill in where a move leads, step by step, from the node on; return how many steps."""
    pose, limits, swept = nodes.pose[node], task.limits, nodes.swept
    write_pose(swept, 0, pose[0], pose[1], pose[2], pose)
    swept[0, POSE_SIZE] = 0.0
    if move >= 0:
        first, end = task.primitives.first[move], task.primitives.first[move + 1]
        for step in range(end - first):
            x, y, heading = moved(pose[0], pose[1], pose[2], task.primitives.poses[first + step])
            write_pose(swept, step + 1, x, y, heading, task.primitives.poses[first + step])
            swept[step + 1, POSE_SIZE] = task.primitives.speed[first + step]
        return end - first
    way = -1.0 if move == BEHIND else 1.0
    if limits.way == CURVING:
        curve = curve_of(task.curves, task.goal, pose[0], pose[1], pose[2], way)
        if curve[0] == 0 or curve[0] >= MAX_STEPS:
            return 0
        count = sweep_curve(task.curves, curve, swept)
        for step in range(1, count + 1):
            swept[step, POSE_SIZE] = limits.speed if move == AHEAD else limits.reverse
        return count
    snap = snap_of(limits, task.goal, pose[0], pose[1], pose[2], way)
    count = snap_steps(snap)
    if count >= MAX_STEPS:
        return 0
    for step in range(1, count + 1):
        x, y, heading, speed = snap_pose(limits, snap, pose[0], pose[1], pose[2], step)
        write_pose(swept, step, x, y, turned_by(heading), pose)
        swept[step, POSE_SIZE] = speed
    return count


@compiled
def stretch_steps(task: Task, x: float, y: float, heading: float, move: int) -> int:
    """Steps of the last stretch, forwards or backwards; zero for none."""
    way = -1.0 if move == BEHIND else 1.0
    if task.limits.way == CURVING:
        return curve_of(task.curves, task.goal, x, y, heading, way)[0]
    return snap_steps(snap_of(task.limits, task.goal, x, y, heading, way))


@compiled
def arrives_after(task: Task, nodes: Nodes, count: int) -> int:
    """Steps of a move after which the robot has arrived: more than it has for none, zero where rounding decides."""
    for step in range(1, count + 1):
        pose, speed = nodes.swept[step], nodes.swept[step, POSE_SIZE]
        if reaches(task.goal, pose, speed, 1.02):
            return step if reaches(task.goal, pose, speed, 1.0) else 0
    return count + 1


@compiled
def is_sweep_free(body: RobotBody, swept: Floats, count: int, buffer: FloatArray) -> bool:
    """Check whether a move is clear of obstacles and bounds, in all parts of all steps."""
    for step in range(count, 0, -1):
        before, after = swept[step - 1], swept[step]
        if is_far_from_all(body, after[0], after[1], body.stride):
            continue
        for part in range(body.parts):
            if not is_free(body, pose_between(before, after, part / body.parts), buffer):
                return False
    return True
