"""Free poses of a footprint among the obstacles, and cells of poses that are taken for one."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.compiling import ZERO, compiled
from d4orm_env.engine.elementary import cosine, sine
from d4orm_env.engine.footprint_contacts import POSE, touches_static
from d4orm_env.engine.simd import TILE
from d4orm_planners.manoeuvres.primitives import POSE_SIZE

TURN = 2 * np.pi

Pose: TypeAlias = tuple[float, float, float, float, float, float]  #: Position, heading and hitch angles


def buffer_size(footprints: FootprintArrays) -> int:
    """Size of the workspace of contact checks: two cores, and a pose of each body."""
    return (2 + POSE * len(footprints.robot)) * TILE


class RobotBody(NamedTuple):
    """A robot's body among the obstacles."""

    footprints: FootprintArrays  #: Of all robots
    arrays: ProblemArrays  #: The problem, without goal headings and footprints, so that all have one type
    robot: int  #: Its number
    extra: np.float32  #: Distance that it keeps from everything [m]
    stride: float  #: What the fastest robot drives in a step [m]
    parts: int  #: Poses that are looked at in a step


Placed: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32]
"""A body's heading as a unit vector, and its position."""


class Patch(NamedTuple):
    """Cells of positions and sectors of headings."""

    low: Floats  #: ``(2,)`` lowest corner [m]
    scale: float  #: One over the size of a cell [1/m]
    size: tuple[int, int]  #: ``(2,)`` cells along x and y
    sectors: int  #: Number of sectors; one for a robot without a heading

    @property
    def cells(self) -> int:
        """Number of cells in a mode."""
        return self.sectors * self.size[0] * self.size[1]


class PoseLattice(NamedTuple):
    """Cells of positions and sectors of headings: poses in the same are taken for one."""

    usual: Patch  #: All over the area
    heading: float  #: Middle of the first sector [rad]
    modes: int  #: Number of modes
    near: tuple[Patch, Patch]  #: Finer ones in its place near to the robot's start and to its goal

    @property
    def cells(self) -> int:
        """Number of cells in all modes."""
        return self.modes * (self.usual.cells + sum(patch.cells for patch in self.near))


@compiled
def turned_by(angle: float) -> float:
    """The same angle, at most half a turn."""
    return angle - TURN * np.rint(angle / TURN)


@compiled
def is_far_from_all(body: RobotBody, x: float, y: float, wider: float) -> bool:
    """Check quickly whether the robot's disc, and so much round it, is clear of obstacles and bounds at a position.

    It is if this says so, and may be if not.
    """
    arrays = body.arrays
    distance = arrays.radius[body.robot] + body.extra + np.float32(wider)
    px, py, low, high = np.float32(x), np.float32(y), arrays.bounds[0], arrays.bounds[1]
    if not (px - distance > low[0] and py - distance > low[1] and px + distance < high[0] and py + distance < high[1]):
        return False
    grid = arrays.grid
    if grid.clearance.shape[0] == 0:
        return True
    i, j = np.int64((px - grid.low[0]) * grid.scale), np.int64((py - grid.low[1]) * grid.scale)
    if px <= grid.low[0] or py <= grid.low[1] or i >= grid.size[0] or j >= grid.size[1]:
        return False
    return bool(grid.clearance[i * grid.size[1] + j] - grid.slack > distance)


@compiled
def is_free(body: RobotBody, pose: Pose, buffer: FloatArray) -> bool:
    """Check whether the robot is clear of obstacles and bounds in a pose."""
    if is_far_from_all(body, pose[0], pose[1], 0.0):
        return True
    position, poses = (np.float32(pose[0]), np.float32(pose[1]), np.float32(0)), buffer[2 * TILE :]
    i, trailer, placed = np.int64(body.robot), 0, placed_first(body, body.robot, pose[2], ZERO, ZERO)
    while i >= 0:
        for row in range(POSE):
            poses[(i * POSE + row) * TILE] = placed[row]
        placed = placed_next(body, i, placed, hitch_of(pose, trailer))
        i, trailer = np.int64(body.footprints.following[i]), trailer + 1
    k, stride = body.robot, POSE * TILE
    return not touches_static(body.footprints, body.arrays, k, position, poses, stride, 0, body.extra, buffer)


@compiled
def hitch_of(pose: Pose, trailer: int) -> float:
    """Hitch angle of a trailer, by its number."""
    return pose[3] if trailer == 0 else pose[4] if trailer == 1 else pose[5]


@compiled
def placed_first(body: RobotBody, robot: Whole, heading: float, x: np.float32, y: np.float32) -> Placed:
    """Pose of a robot's own body."""
    c, s = direction(body, robot, heading)
    return c, s, x, y


@compiled
def placed_next(body: RobotBody, i: Whole, before: Placed, hitch: float) -> Placed:
    """Pose of the trailer that follows body ``i``; the same if there is none."""
    j = body.footprints.following[i]
    if j < 0:
        return before
    c, s, length = cosine(np.float32(hitch)), sine(np.float32(hitch)), body.footprints.hitch[j]
    cos, sin = before[0] * c + before[1] * s, before[1] * c - before[0] * s
    return cos, sin, before[2] - length * cos, before[3] - length * sin


@compiled
def direction(body: RobotBody, robot: Whole, heading: float) -> tuple[np.float32, np.float32]:
    """Return what a robot's footprint is turned by at a heading, as a unit vector."""
    if body.footprints.heading[robot] < 0:
        return np.float32(1), np.float32(0)
    return cosine(np.float32(heading)), sine(np.float32(heading))


@compiled
def unit_vector(heading: float) -> tuple[float, float]:
    """Cosine and sine."""
    return np.float64(cosine(np.float32(heading))), np.float64(sine(np.float32(heading)))


@compiled
def moved_along(
    x: float, y: float, heading: float, facing: tuple[float, float], step: Floats
) -> tuple[float, float, float]:
    """Position and heading after a step ``(6,)`` seen from a pose that faces along a unit vector."""
    c, s = facing
    return x + (c * step[0] - s * step[1]), y + (s * step[0] + c * step[1]), turned_by(heading + step[2])


@compiled
def moved(x: float, y: float, heading: float, step: Floats) -> tuple[float, float, float]:
    """Position and heading after a step ``(6,)`` seen from a pose; the heading is not wound up."""
    return moved_along(x, y, heading, unit_vector(heading), step)


@compiled
def pose_of(row: Floats) -> Pose:
    """The pose in a row of an array."""
    return row[0], row[1], row[2], row[3], row[4], row[5]


@compiled
def write_pose(rows: Floats, at: int, x: float, y: float, heading: float, hitches: Floats) -> None:
    """Write a pose into a row, its hitch angles as in another row."""
    rows[at, 0], rows[at, 1], rows[at, 2] = x, y, heading
    for i in range(3, POSE_SIZE):
        rows[at, i] = hitches[i]


@compiled
def pose_between(before: Floats, after: Floats, back: float) -> Pose:
    """The pose that so large a share of a step lies before its end."""
    x, y = after[0] - back * (after[0] - before[0]), after[1] - back * (after[1] - before[1])
    heading = after[2] - back * turned_by(after[2] - before[2])
    first, second = after[3] - back * (after[3] - before[3]), after[4] - back * (after[4] - before[4])
    return x, y, heading, first, second, after[5] - back * (after[5] - before[5])


@compiled
def _cell_in(patch: Patch, heading: float, x: float, y: float) -> int:
    """Number of a pose's cell in a patch, its heading from the middle of the first sector on; -1 outside."""
    i = int(np.floor((x - patch.low[0]) * patch.scale))
    j = int(np.floor((y - patch.low[1]) * patch.scale))
    if i < 0 or j < 0 or i >= patch.size[0] or j >= patch.size[1]:
        return -1
    sector = 0
    if patch.sectors > 1:
        sector = int(np.rint(heading / (TURN / patch.sectors))) % patch.sectors
    return (sector * patch.size[0] + i) * patch.size[1] + j


@compiled
def cell_of(lattice: PoseLattice, x: float, y: float, heading: float, mode: Whole) -> int:
    """Number of the cell of a pose in a mode, -1 outside."""
    before, turn = 0, heading - lattice.heading
    for patch in lattice.near:
        cell = _cell_in(patch, turn, x, y)
        size = patch.sectors * patch.size[0] * patch.size[1]
        if cell >= 0:
            return before + int(mode) * size + cell
        before += lattice.modes * size
    cell = _cell_in(lattice.usual, turn, x, y)
    size = lattice.usual.sectors * lattice.usual.size[0] * lattice.usual.size[1]
    return before + int(mode) * size + cell if cell >= 0 else -1
