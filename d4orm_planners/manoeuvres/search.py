"""Search for one robot's motion among obstacles and the motions of others, in safe intervals of time.

A node is a pose, a mode and a time, and until when the robot may wait there (SIPP: M. Phillips and M. Likhachev, ICRA
2011). Primitives begin as soon as they can, and later ones count only if they lead into another safe interval. Poses in
the same cell are taken for one, as in db-A* (W. Hoenig, J. Ortiz-Haro and M. Toussaint, IROS 2022), but motions follow
each other without any gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.manoeuvres.costs import pop
from d4orm_planners.manoeuvres.curves import Curve, Curves, curve_controls, curve_of
from d4orm_planners.manoeuvres.lattice import cell_of, is_far_from_all, moved, pose_of
from d4orm_planners.manoeuvres.nodes import (
    AHEAD,
    BEHIND,
    Nodes,
    Task,
    add,
    arrives_after,
    cost_to_go,
    is_dominated,
    is_sweep_free,
    reaches,
    slot_of,
    stretch_steps,
    sweep,
)
from d4orm_planners.manoeuvres.primitives import POSE_SIZE
from d4orm_planners.manoeuvres.robots import Robot
from d4orm_planners.manoeuvres.snapping import CURVING, NOWHERE, SIDEWAYS, Goal, Limits, Snap, snap_controls, snap_of
from d4orm_planners.manoeuvres.traffic import NEVER, Traffic, meeting, safe_since, safe_until, visits_of

NOTHING, PAUSED = -1, -2
"""Results of a search that ends without a motion, and of one that is to go on if there is time."""
NODES_PER_CALL = 2000  #: Nodes that a call follows before it asks its caller whether there is time
SHORT, EVERY = 40, 8
"""Longest last stretch that every node tries [steps]; and of which nodes, every so-manyth, longer ones are tried."""


@compiled
def _has_traffic(traffic: Traffic, nodes: Nodes, count: int, since: int) -> bool:
    """Check whether another robot comes near to a move at this step or later."""
    seen = (-1, -1)
    for step in range(1, count + 1):
        begin, end = visits_of(traffic, nodes.swept[step, 0], nodes.swept[step, 1])
        if (begin, end) == seen:
            continue
        seen = (begin, end)
        for row in range(begin, end):
            if traffic.visits[row, 2] >= since:
                return True
    return False


@compiled
def _meeting(task: Task, nodes: Nodes, traffic: Traffic, count: int, depart: int, likely: int) -> tuple[int, int]:
    """The step of a move that departs then in which it meets another robot, zero for none, and the soonest departure by
    which that robot may be gone; the likely step is looked at first.
    """
    for first, last in ((likely, likely), (1, count)):
        if first > 0:
            step, until = meeting(task.body, traffic, nodes.swept, first, last, depart, nodes.buffer)
            if until > 0:
                return step, until - step
    return 0, depart


@compiled
def _first_use(task: Task, nodes: Nodes, node: int, move: int) -> int:
    """The first step at which beginning a primitive is of use: until then nodes at its end are as good as its own."""
    pose, first, end = nodes.pose[node], task.primitives.first[move], task.primitives.first[move + 1]
    depart, count = nodes.time[node], end - first
    if task.goal.docks:
        dx, dy = task.goal.x - pose[0], task.goal.y - pose[1]
        near = task.goal.radius + task.primitives.reach[move]
        if dx * dx + dy * dy <= near * near:
            return depart
    x, y, heading = moved(pose[0], pose[1], pose[2], task.primitives.poses[end - 1])
    cell = cell_of(task.lattice, x, y, heading, task.primitives.mode[move])
    if cell < 0:
        return NEVER
    slot, last = slot_of(nodes, cell, task.number), -1
    while depart > last and nodes.marks[slot] == task.number:
        last, other = depart, nodes.heads[slot]
        while other >= 0:
            if nodes.time[other] <= depart + count < nodes.until[other]:
                depart = nodes.until[other] - count
            other = nodes.next[other]
    return depart


@compiled
def _follow(task: Task, nodes: Nodes, traffic: Traffic, node: int, move: int) -> None:
    """Make a move from a node as soon as other robots let it pass, and later into each further safe interval."""
    depart, until = nodes.time[node], nodes.until[node]
    waits = task.primitives.rests[nodes.mode[node]]
    if move >= 0:
        soonest = _first_use(task, nodes, node, move)
        if soonest >= min(until, task.horizon) or (soonest > depart and not waits):
            return
        depart = soonest
    count, arrives = sweep(task, nodes, node, move), False
    if task.goal.docks:
        end = arrives_after(task, nodes, count)
        count, arrives = min(count, end), end <= count
    far = move >= 0 and is_far_from_all(task.body, nodes.swept[0, 0], nodes.swept[0, 1], task.primitives.reach[move])
    if count == 0 or not (far or is_sweep_free(task.body, nodes.swept, count, nodes.buffer)):
        return
    mode = task.primitives.mode[move] if move >= 0 and not arrives else -1
    busy, met = _has_traffic(traffic, nodes, count, depart), 0
    pose = pose_of(nodes.swept[count])
    while depart < until and depart + count <= task.horizon:
        if not busy:
            add(task, nodes, pose, mode, depart + count, NEVER, node, move, depart)
            return
        met, gone = _meeting(task, nodes, traffic, count, depart, met)
        if met == 0:
            end = safe_until(task.body, traffic, depart + count, nodes.swept[count], nodes.buffer)
            if mode >= 0 or end == NEVER:
                add(task, nodes, pose, mode, depart + count, end, node, move, depart)
            if end == NEVER:
                return
            depart = max(depart, end - count)
        if not waits:
            return
        depart += task.departure_interval * max(1, -((depart - gone) // task.departure_interval))


@compiled
def _snaps(task: Task, nodes: Nodes, traffic: Traffic, node: int) -> None:
    """Try the last stretch, where it takes about as few steps as the costs promise."""
    pose, mode = nodes.pose[node], nodes.mode[node]
    if task.limits.way == NOWHERE or not task.primitives.rests[mode] or (task.limits.way == CURVING and mode > 0):
        return
    remaining = cost_to_go(task, pose[0], pose[1], pose[2], mode)
    for move in range(AHEAD, BEHIND - 1 if task.limits.way != SIDEWAYS else BEHIND, -1):
        steps = stretch_steps(task, pose[0], pose[1], pose[2], move)
        # A long one is seldom free: nodes that are near to each other need not all try.
        if 0 < steps <= 1.25 * remaining + 20 and (steps <= SHORT or node % EVERY == 0):
            _follow(task, nodes, traffic, node, move)


@compiled
def _soonest(task: Task, traffic: Traffic, nodes: Nodes) -> int:
    """The step from which on the robot can stay at its goal; zero where its pose there is not known yet."""
    goal, pose = task.goal, nodes.swept[0]
    if np.isnan(goal.heading) or task.curves.last > 0:
        return 0
    for i in range(3, POSE_SIZE):
        pose[i] = 0.0
    pose[0], pose[1], pose[2] = goal.x, goal.y, goal.heading
    return safe_since(task.body, traffic, pose, nodes.buffer)


@compiled
def _begin(task: Task, traffic: Traffic, nodes: Nodes, start: Floats, mode: int) -> None:
    """Begin at a pose ``(6,)``, at rest; there is no node if the robot cannot stay there for a step."""
    nodes.filled[0], nodes.heap.filled[0] = 0, 0
    until = safe_until(task.body, traffic, 0, start, nodes.buffer)
    nodes.soonest[0] = _soonest(task, traffic, nodes)
    if until > 0 and nodes.soonest[0] <= task.horizon:
        add(task, nodes, pose_of(start), mode, 0, until, -1, -1, 0)


@cached_kernel(**OPTIONS)
def find_motion(task: Task, traffic: Traffic, nodes: Nodes, start: Floats, mode: int, goes_on: bool) -> int:
    """Look for a motion from a pose ``(6,)`` at rest to the goal, where the robot stays; or go on looking for it.

    Returns:
        The node at its end; :data:`NOTHING` if there is none or no more room for nodes; or :data:`PAUSED`.
    """
    if not goes_on:
        _begin(task, traffic, nodes, start, mode)
    for _ in range(NODES_PER_CALL):
        if nodes.heap.filled[0] == 0 or nodes.filled[0] >= nodes.mode.shape[0]:
            return NOTHING
        _, node = pop(nodes.heap)
        if nodes.mode[node] < 0:
            return node
        x, y, heading = nodes.pose[node, 0], nodes.pose[node, 1], nodes.pose[node, 2]
        cell = cell_of(task.lattice, x, y, heading, nodes.mode[node])
        if is_dominated(nodes, slot_of(nodes, cell, task.number), task.number, node, nodes.time[node] - 1):
            continue
        ends = task.primitives.rests[nodes.mode[node]] and (nodes.mode[node] == 0 or not task.in_line)
        if ends and nodes.until[node] == NEVER and reaches(task.goal, nodes.pose[node], 0.0, 1.0):
            return node
        _snaps(task, nodes, traffic, node)
        begin, end = task.primitives.begin[nodes.mode[node]], task.primitives.begin[nodes.mode[node] + 1]
        for move in range(begin, end):
            _follow(task, nodes, traffic, node, move)
    return PAUSED


@cached_kernel(**OPTIONS)
def trace(task: Task, nodes: Nodes, node: int, poses: FloatArray) -> None:
    """Fill in the poses ``(T + 1, 6)`` of the motion that ends in a node, at all ``T`` steps."""
    last = poses.shape[0] - 1
    while True:
        for step in range(nodes.time[node], last + 1):
            for i in range(POSE_SIZE):
                poses[step, i] = nodes.pose[node, i]
        last = nodes.time[node] - 1
        above = nodes.parent[node]
        if above < 0:
            return
        depart = nodes.depart[node]
        sweep(task, nodes, above, nodes.move[node])
        for step in range(depart + 1, last + 1):
            for i in range(POSE_SIZE):
                poses[step, i] = nodes.swept[step - depart, i]
        last = depart
        node = above


@cached_kernel(**OPTIONS)
def snap_from(limits: Limits, goal: Goal, x: float, y: float, heading: float, move: int) -> Snap:
    """The last stretch from a pose, as one of the moves."""
    return snap_of(limits, goal, x, y, heading, -1.0 if move == BEHIND else 1.0)


@cached_kernel(**OPTIONS)
def curve_from(curves: Curves, goal: Goal, x: float, y: float, heading: float, move: int) -> Curve:
    """The last stretch of a first-order car from a pose, as one of the moves."""
    return curve_of(curves, goal, x, y, heading, -1.0 if move == BEHIND else 1.0)


@dataclass(frozen=True, eq=False)
class Motion:
    """A robot's motion."""

    poses: FloatArray  #: ``(T + 1, 6)`` float32
    controls: FloatArray  #: ``(T, m)``
    stops: IntArray  #: Steps at which the robot may stand for longer, the first and the last one among them

    @property
    def steps(self) -> int:
        """Steps until it has arrived."""
        return len(self.controls)

    def later(self, steps: int) -> Motion:
        """The same motion of a robot that stays at its start, at rest, for so many steps before."""
        poses = np.concatenate([np.repeat(self.poses[:1], steps, axis=0), self.poses])
        return Motion(poses, np.pad(self.controls, ((steps, 0), (0, 0))), np.union1d([0], self.stops + steps))

    def followed_by(self, other: Motion, wait: int) -> Motion:
        """This motion, so many steps at its end at rest, and another one from there."""
        poses = np.concatenate([self.poses, np.repeat(self.poses[-1:], wait, axis=0), other.poses[1:]])
        controls = np.concatenate([np.pad(self.controls, ((0, wait), (0, 0))), other.controls])
        return Motion(poses, controls, np.concatenate([self.stops, other.stops + self.steps + wait]))


def motion_to(robot: Robot, task: Task, nodes: Nodes, node: int) -> Motion:
    """The motion that ends in a node."""
    chain = [node]
    while nodes.parent[chain[-1]] >= 0:
        chain.append(int(nodes.parent[chain[-1]]))
    steps = int(nodes.time[node])
    controls = np.zeros((steps, robot.model.control_size), np.float32)
    for last in chain[:-1]:
        since, until = int(nodes.depart[last]), int(nodes.time[last])
        pose = nodes.pose[nodes.parent[last]].tolist()
        controls[since:until] = _controls(robot, int(nodes.move[last]), pose)[: until - since]
    poses = np.empty((steps + 1, POSE_SIZE), np.float32)
    trace(task, nodes, node, poses)
    ends = np.array(chain[::-1])
    stands = (nodes.mode[ends] < 0) | task.primitives.rests[nodes.mode[ends]]
    return Motion(poses, controls, nodes.time[ends[stands]])


def _controls(robot: Robot, move: int, pose: list[float]) -> FloatArray:
    """``(n, m)`` controls of a move from a pose."""
    task, (x, y, heading) = robot.task, pose[:3]
    if move >= 0:
        first, end = task.primitives.first[move : move + 2]
        return task.primitives.controls[first:end]
    if task.limits.way == CURVING:
        curve = curve_from(task.curves, task.goal, x, y, heading, move)
        return curve_controls(task.curves, curve, task.limits.dt)
    controls = snap_controls(task.limits, snap_from(task.limits, task.goal, x, y, heading, move))
    return controls[:, ::-1] if robot.model.name == "differential_drive" else controls
