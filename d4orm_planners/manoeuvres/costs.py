"""Time to a robot's goal from all poses, spread backwards from there over what its primitives lead to."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.dynamics.robot_model import SPEED
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.manoeuvres.kinds import Kind
from d4orm_planners.manoeuvres.lattice import (
    Patch,
    PoseLattice,
    RobotBody,
    buffer_size,
    cell_of,
    is_far_from_all,
    is_free,
    moved_along,
    unit_vector,
)
from d4orm_planners.manoeuvres.primitives import Primitives, primitives_of
from d4orm_planners.manoeuvres.snapping import Goal

NEAR = 4  #: Cells of the usual size from a start or a goal as far as which finer ones are
LATER = 20  #: Steps by which a detour over a pose may be longer than the shortest path for its cost to be worked out
TEAM_CELLS, LEAST_CELLS, MOST_CELLS = 4_000_000, 150_000, 400_000
"""Cells of the costs of all robots together, and the least and the most of one: a larger world has larger cells."""


class Area(NamedTuple):
    """The part of the plane that robots may use, and the size of the cells of the search's lattices [m]."""

    low: Floats
    high: Floats
    cell: float

    def lattice(self, kind: Kind, heading: float, start: Floats, goal: Goal, modes: int) -> PoseLattice:
        """A robot's cells over all of it, finer ones near to its start and its goal."""
        reach, cell = (NEAR * self.cell, kind.finest) if kind.finest else (0.0, self.cell)
        first, last = (
            _patch(middle - reach, middle + reach, cell, kind.sectors)
            for middle in (start[:2], np.array([goal.x, goal.y]))
        )
        usual = _patch(self.low, self.high, kind.cell, kind.usual.sectors)
        return PoseLattice(usual, heading, modes, (first, last))


def _patch(low: Floats, high: Floats, cell: float, sectors: int) -> Patch:
    """Cells of this size from one corner to another."""
    size = np.ceil((high - low) / cell).astype(int).tolist()
    return Patch(low, 1 / cell, (size[0], size[1]), sectors)


class Costs(NamedTuple):
    """Steps to a goal."""

    lattice: PoseLattice  #: Cells
    steps: FloatArray  #: ``(cells,)``, infinite where they are not known: there they are at least
    far: float  #: this, ...
    pace: float  #: ... less so many for each metre from the start, ...
    start: tuple[float, float]  #: ... which is at ``(x, y)``


def unknown_costs(lattice: PoseLattice, pace: float = 0.0) -> Costs:
    """Costs of which none is known but how many steps a metre takes at least."""
    nowhere = lattice.usual._replace(size=(0, 0))
    empty = PoseLattice(nowhere, lattice.heading, lattice.modes, (nowhere, nowhere))
    return Costs(empty, np.zeros(1, np.float32), 0.0, pace, (0.0, 0.0))


def costs_of(kind: Kind, area: Area, body: RobotBody, start: Floats, goal: Goal, team_size: int, bent: bool) -> Costs:
    """Steps to a goal for a robot that starts at a pose ``(6,)``, in a team of so many; ``bent`` if its trailers end in
    a bend.
    """
    modes, cells = primitives_of(kind)[2], np.clip(TEAM_CELLS / team_size, LEAST_CELLS, MOST_CELLS)
    size = np.prod(area.high - area.low) * len(modes) * kind.sectors
    cell = max(area.cell, float(np.sqrt(size / cells)))
    wide = replace(kind, cell=cell)
    lattice = area.lattice(wide, 0.0 if np.isnan(goal.heading) else goal.heading, start, goal, len(modes))
    back, pace = primitives_of(wide)[1], 1 / (kind.limits[SPEED] * kind.dt)
    headings = [goal.heading] if not np.isnan(goal.heading) else (np.arange(kind.sectors) * kind.sector).tolist()
    ends = range(len(modes) if bent else 1)
    goals = np.array([[goal.x, goal.y, heading, mode] for mode in ends for heading in headings])
    count = lattice.cells
    steps = np.full(count, np.inf, np.float32)
    far = fill_costs(
        body, back, lattice, goals, start, pace, steps, np.empty((count, 4)), Heap.of(2 * count + 512),
        modes.index(kind.start), np.zeros(buffer_size(body.footprints), np.float32),
    )  # fmt: skip
    if far == np.inf:
        # Cells are coarse: even where no chain of them leads from the start to the goal, a path may do so.
        far, pace = float(steps[steps < np.inf].max(initial=0)), 0.0
    return Costs(lattice, steps, far, pace, (float(start[0]), float(start[1])))


class Heap(NamedTuple):
    """Numbers by their values, the least first."""

    value: Floats  #: ``(N,)``
    item: IntArray  #: ``(N,)``
    filled: IntArray  #: ``(1,)`` how many there are

    @classmethod
    def of(cls, size: int) -> Heap:
        """One with room for so many."""
        return cls(np.empty(size), np.empty(size, np.int64), np.zeros(1, np.int64))


@compiled
def push(heap: Heap, value: float, item: Whole) -> None:
    """Put a number in; there must be room."""
    at = heap.filled[0]
    heap.filled[0] = at + 1
    while at > 0:
        above = (at - 1) >> 1
        if heap.value[above] <= value:
            break
        heap.value[at], heap.item[at] = heap.value[above], heap.item[above]
        at = above
    heap.value[at], heap.item[at] = value, item


@compiled
def pop(heap: Heap) -> tuple[float, int]:
    """Take the first one out, and its value; there must be one."""
    least, first = heap.value[0], heap.item[0]
    count = heap.filled[0] - 1
    heap.filled[0] = count
    value, item, at = heap.value[count], heap.item[count], 0
    while 2 * at + 1 < count:
        below = 2 * at + 1
        if below + 1 < count and heap.value[below + 1] < heap.value[below]:
            below += 1
        if heap.value[below] >= value:
            break
        heap.value[at], heap.item[at] = heap.value[below], heap.item[below]
        at = below
    heap.value[at], heap.item[at] = value, item
    return least, first


@compiled
def _is_way_free(
    body: RobotBody, primitives: Primitives, number: Whole, x: float, y: float, heading: float,
    facing: tuple[float, float], stride: int, buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether the robot is clear of obstacles and bounds on a primitive, after every so many steps."""
    if is_far_from_all(body, x, y, primitives.reach[number]):
        return True
    # From the end on: what is not free is found there soonest.
    for i in range(primitives.first[number + 1] - 1, primitives.first[number] - 1, -stride):
        step = primitives.poses[i]
        px, py, turned = moved_along(x, y, heading, facing, step)
        if not is_free(body, (px, py, turned, step[3], step[4], step[5]), buffer):
            return False
    return True


@compiled
def _spread(
    body: RobotBody, primitives: Primitives, lattice: PoseLattice, start: Floats, pace: float, cell: int,
    costs: FloatArray, poses: Floats, heap: Heap, buffer: FloatArray,
) -> None:  # fmt: skip
    """Spread costs from a cell to those that primitives lead to."""
    x, y, heading = poses[cell, 0], poses[cell, 1], poses[cell, 2]
    # Nothing that is as wide as the robot fits in between the poses that are looked at.
    stride = max(1, int(2 * body.footprints.inner[body.robot] * pace))
    facing = unit_vector(heading)
    mode = int(poses[cell, 3])
    for number in range(primitives.begin[mode], primitives.begin[mode + 1]):
        first, end = primitives.first[number], primitives.first[number + 1]
        px, py, turned = moved_along(x, y, heading, facing, primitives.poses[end - 1])
        other, cost = cell_of(lattice, px, py, turned, primitives.mode[number]), costs[cell] + np.float32(end - first)
        if other < 0 or costs[other] <= cost:
            continue
        if not _is_way_free(body, primitives, number, x, y, heading, facing, stride, buffer):
            continue
        costs[other] = cost
        poses[other, 0], poses[other, 1], poses[other, 2] = px, py, turned
        poses[other, 3] = primitives.mode[number]
        push(heap, cost + pace * np.sqrt((px - start[0]) ** 2 + (py - start[1]) ** 2), other)


@cached_kernel(**OPTIONS)
def fill_costs(
    body: RobotBody, primitives: Primitives, lattice: PoseLattice, goals: Floats, start: Floats,
    pace: float, costs: FloatArray, poses: Floats, heap: Heap, mode: int, buffer: FloatArray,
) -> float:  # fmt: skip
    """Spread costs backwards from the goals over all poses that a robot may pass on its way there, detours included.

    Args:
        body: The robot.
        primitives: What it can do, backwards in time.
        lattice: Cells and sectors.
        goals: ``(., 4)`` poses and modes.
        start: ``(3,)`` pose, towards which costs are spread first.
        pace: Steps that a metre takes at least.
        costs: ``(cells,)`` steps to the goal, filled; infinite to begin with, and beyond what was reached.
        poses: ``(cells, 4)`` and modes, to overwrite.
        heap: To overwrite.
        mode: That the robot starts in.
        buffer: To overwrite, see :func:`buffer_size`.

    Returns:
        The sum, of a cost and the steps that it takes at least from the start, up to which all are known; infinite if
        there are no others.
    """
    begin = cell_of(lattice, start[0], start[1], start[2], mode)
    heap.filled[0] = 0
    for number in range(goals.shape[0]):
        cell = cell_of(lattice, goals[number, 0], goals[number, 1], goals[number, 2], int(goals[number, 3]))
        if cell >= 0 and costs[cell] > 0:
            costs[cell] = 0
            for i in range(poses.shape[1]):  # numba takes a second to compile assignments of slices
                poses[cell, i] = goals[number, i]
            push(heap, 0.0, cell)
    most, last = np.inf, 0.0
    while 0 < heap.filled[0] < heap.value.shape[0] - 256 and last <= most:
        value, cell = pop(heap)
        last = max(last, value)
        x, y, cost = poses[cell, 0], poses[cell, 1], costs[cell]
        if value > cost + pace * np.sqrt((x - start[0]) ** 2 + (y - start[1]) ** 2) + 1e-3:
            continue
        if cell == begin:
            most = min(most, cost + LATER)
        _spread(body, primitives, lattice, start, pace, cell, costs, poses, heap, buffer)
    return last if heap.filled[0] > 0 else np.inf
