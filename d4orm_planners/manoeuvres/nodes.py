"""Nodes of a search for one robot's motion, which of them count, and the poses on a move from one to another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.engine.compiling import compiled
from d4orm_planners.manoeuvres.costs import Costs, Heap, push
from d4orm_planners.manoeuvres.curves import Curves, curve_of, sweep_curve
from d4orm_planners.manoeuvres.kinds import MAX_STEPS
from d4orm_planners.manoeuvres.lattice import (
    Pose,
    PoseLattice,
    RobotBody,
    cell_of,
    is_far_from_all,
    is_free,
    moved,
    pose_between,
    turned_by,
    write_pose,
)
from d4orm_planners.manoeuvres.primitives import POSE_SIZE, Primitives
from d4orm_planners.manoeuvres.snapping import CURVING, Goal, Limits, snap_of, snap_pose, snap_steps

AHEAD, BEHIND = -2, -3  #: Moves that are no primitives: the last stretch, forwards and backwards


class Nodes(NamedTuple):
    """Nodes of a search, ``N`` at most, and where to find those of a cell."""

    pose: Floats  #: ``(N, 6)``
    mode: IntArray  #: ``(N,)``, -1 for a node at which the robot stays at its goal
    time: IntArray  #: ``(N,)`` step of arrival
    until: IntArray  #: ``(N,)`` first step at which it must have gone
    parent: IntArray  #: ``(N,)``, -1 for the first
    move: IntArray  #: ``(N,)`` primitive, or one of :data:`AHEAD` and :data:`BEHIND`, ...
    depart: IntArray  #: ``(N,)`` ... and the step at which it begins
    next: IntArray  #: ``(N,)`` another one of the same cell, -1 for none
    filled: IntArray  #: ``(1,)`` number of nodes
    soonest: IntArray  #: ``(1,)`` step from which on the robot can stay at its goal
    cells: IntArray  #: ``(C,)`` numbers of cells, hashed
    heads: IntArray  #: ``(C,)`` first node of each
    marks: IntArray  #: ``(C,)`` number of the search that wrote each slot
    heap: Heap  #: Nodes to be followed
    swept: Floats  #: ``(., 7)`` poses and speeds on a move, from where it begins
    buffer: FloatArray  #: See :func:`~d4orm_planners.manoeuvres.lattice.buffer_size`

    @classmethod
    def of(cls, size: int, buffer: int) -> Nodes:
        """Room for ``size`` nodes, and for ``buffer`` numbers."""
        slots = 1 << int(2 * size - 1).bit_length()

        def numbers(count: int) -> IntArray:
            return np.zeros(count, np.int64)

        return cls(
            np.empty((size, POSE_SIZE)), numbers(size), numbers(size), numbers(size), numbers(size), numbers(size),
            numbers(size), numbers(size), numbers(1), numbers(1), numbers(slots), numbers(slots), numbers(slots),
            Heap.of(size + 1), np.empty((MAX_STEPS + 1, POSE_SIZE + 1)), np.zeros(buffer, np.float32),
        )  # fmt: skip


class Task(NamedTuple):
    """Query of a search."""

    body: RobotBody  #: The robot
    primitives: Primitives  #: What it can do
    limits: Limits  #: For the last stretch, ...
    curves: Curves  #: ... and those of a first-order car
    goal: Goal  #: Where to
    lattice: PoseLattice  #: Cells and sectors
    costs: Costs  #: Steps to the goal; none in a world without obstacles
    weight: float  #: Times that these count more than the steps behind
    departure_interval: int  #: Steps between departures that are tried
    horizon: int  #: Last step
    in_line: bool  #: Whether wheels have to be straight and trailers in line at the goal
    number: int  #: Of the search, different in each that writes to the same nodes


@compiled
def slot_of(nodes: Nodes, cell: int, number: int) -> int:
    """The slot of a cell, or the free one that it may take."""
    mask = nodes.cells.shape[0] - 1
    at = (cell * 0x9E3779B1 >> 4) & mask
    while nodes.marks[at] == number and nodes.cells[at] != cell:
        at = (at + 1) & mask
    return at


@compiled
def is_dominated(nodes: Nodes, slot: int, number: int, own: int, time: int) -> bool:
    """Check whether another node of the cell is there by ``time`` and may wait until then."""
    if nodes.marks[slot] != number:
        return False
    other = nodes.heads[slot]
    while other >= 0:
        if other != own and nodes.time[other] <= time < nodes.until[other]:
            return True
        other = nodes.next[other]
    return False


@compiled
def cost_to_go(task: Task, x: float, y: float, heading: float, mode: Whole) -> float:
    """Steps to the goal, or a lower bound of them; where there are no obstacles, those of the last stretch."""
    if task.costs.steps.shape[0] == 0:
        ahead = snap_steps(snap_of(task.limits, task.goal, x, y, heading, 1.0))
        return float(min(ahead, snap_steps(snap_of(task.limits, task.goal, x, y, heading, -1.0))))
    cell = cell_of(task.costs.lattice, x, y, heading, mode)
    cost = np.float64(task.costs.steps[cell]) if cell >= 0 else np.inf
    if cost < np.inf:
        return cost
    (start_x, start_y), pace = task.costs.start, task.costs.pace
    behind = pace * np.sqrt((x - start_x) ** 2 + (y - start_y) ** 2)
    return max(task.costs.far - behind, pace * np.sqrt((x - task.goal.x) ** 2 + (y - task.goal.y) ** 2))


@compiled
def add(
    task: Task, nodes: Nodes, pose: Pose, mode: int, time: int, until: int, parent: int, move: int, depart: int
) -> None:
    """Take in a node, unless another one is as good."""
    x, y, heading = pose[0], pose[1], pose[2]
    slot, remaining = -1, 0.0
    if mode >= 0:
        cell = cell_of(task.lattice, x, y, heading, mode)
        if cell < 0:
            return
        slot = slot_of(nodes, cell, task.number)
        if is_dominated(nodes, slot, task.number, -1, time):
            return
        remaining = cost_to_go(task, x, y, heading, mode)
    number = nodes.filled[0]
    if number >= nodes.mode.shape[0]:
        return
    nodes.filled[0] = number + 1
    for i in range(POSE_SIZE):
        nodes.pose[number, i] = pose[i] if i != 2 else turned_by(heading)
    nodes.mode[number], nodes.time[number], nodes.until[number] = mode, time, until
    nodes.parent[number], nodes.move[number], nodes.depart[number], nodes.next[number] = parent, move, depart, -1
    if mode >= 0:
        if nodes.marks[slot] == task.number:
            nodes.next[number] = nodes.heads[slot]
        nodes.marks[slot], nodes.cells[slot], nodes.heads[slot] = task.number, cell, number
    # A robot that is there too soon has to wait in any case: then the nearest is best.
    push(nodes.heap, max(time, nodes.soonest[0] - remaining) + task.weight * remaining, number)


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
