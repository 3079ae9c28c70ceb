"""Table of a team's positions at every step, as compiled code reads it, to find near robots without all pairs.

Time is cut into blocks of a few steps, in which robots move little. In every block the robots are chained in the
buckets of a hash table, by the grid cell that holds the middle of each one's path through the block. Robots near a path
are in the few cells around it. Memory and time grow with the robots, not with the pairs.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Ints, Whole
from d4orm_env.engine.compiling import compiled, inlined

BLOCK = 8  #: Steps in a block
NOBODY = np.int32(-1)
_WIDER = 1 + 2.0**-20  #: Factor by which distances up to which there may be a robot are stretched for rounding


class PathTable(NamedTuple):
    """The index as kernels read it. Steps are counted from the first after the start."""

    positions: FloatArray  #: ``(H+1, K, d)`` float32 [m]
    blocks: FloatArray  #: ``(B, K, BLOCK, d)`` the same, those of a robot in a block side by side
    radius: Floats  #: ``(K,)`` float64 [m]
    margin: np.float64  #: ``()`` float64 [m]
    safety_distance: np.float64  #: ``()`` float64 the largest distance at which two robots are near [m]
    scale: np.float64  #: ``()`` float64 cells in a metre
    flattening: np.float64  #: ``()`` float64 factor for heights by which robots are near where balls are
    middle: Floats  #: ``(B, K, 3)`` float64 where each robot is in each block, more or less [m],
    spread: Floats  #: ``(B, K)`` float64 and how far from there it gets [m]
    widest: Floats  #: ``(1,)`` float64 the largest spread there has been
    moving: IntArray  #: ``(1,)`` int64 the last block in which any robot has moved
    first: Ints  #: ``(B, N)`` int32 the first robot in each bucket of each block
    following: Ints  #: ``(B, K)`` int32 the robot after each in its bucket


@inlined
def steps_of(table: PathTable, block: Whole) -> tuple[Whole, Whole]:
    """First step of a block and the one after the last."""
    first = 1 + block * BLOCK
    return first, min(first + BLOCK, table.positions.shape[0])


@inlined
def _cell(table: PathTable, x: float) -> int:
    """Number of the cell that a coordinate is in, along its axis."""
    return int(np.floor(x * table.scale))


@inlined
def bucket_of(table: PathTable, i: int, j: int, k: int) -> int:
    """The bucket of a cell (the hash of Teschner et al., 2003)."""
    return (i * 73856093 ^ j * 19349663 ^ k * 83492791) & (table.first.shape[1] - 1)


@inlined
def _own_bucket(table: PathTable, block: Whole, robot: Whole) -> int:
    x, y, z = table.middle[block, robot]
    return bucket_of(table, _cell(table, x), _cell(table, y), _cell(table, z))


@compiled
def enclose(path: FloatArray, dimension: int, first: Whole, last: Whole) -> tuple[tuple[float, float, float], float]:
    """The middle of the box round some steps of a path in so many dimensions, and the largest distance from there."""
    x_low, x_high, y_low, y_high, z_low, z_high = np.inf, -np.inf, np.inf, -np.inf, 0.0, 0.0
    for t in range(first, last):
        x, y = np.float64(path[t, 0]), np.float64(path[t, 1])
        x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
    if dimension == 3:
        z_low, z_high = np.inf, -np.inf
        for t in range(first, last):
            z = np.float64(path[t, 2])
            z_low, z_high = min(z_low, z), max(z_high, z)
    middle = (0.5 * (x_low + x_high), 0.5 * (y_low + y_high), 0.5 * (z_low + z_high))
    dx, dy, dz = x_high - x_low, y_high - y_low, z_high - z_low
    # Half of the diagonal, and a little for rounding.
    return middle, 0.500001 * np.sqrt(dx * dx + dy * dy + dz * dz)


@inlined
def link(table: PathTable, block: Whole, robot: Whole) -> None:
    first, last = steps_of(table, block)
    for t in range(first, last):
        for axis in range(table.positions.shape[2]):
            table.blocks[block, robot, t - first, axis] = table.positions[t, robot, axis]
    middle, spread = enclose(table.blocks[block, robot], table.positions.shape[2], first - first, last - first)
    table.middle[block, robot, 0], table.middle[block, robot, 1], table.middle[block, robot, 2] = middle
    table.spread[block, robot] = spread
    table.widest[0] = max(table.widest[0], spread)
    if spread > 0.0:
        table.moving[0] = max(table.moving[0], block)
    bucket = _own_bucket(table, block, robot)
    table.following[block, robot] = table.first[block, bucket]
    table.first[block, bucket] = robot


@inlined
def unlink(table: PathTable, block: Whole, robot: Whole) -> None:
    bucket, following = _own_bucket(table, block, robot), table.following[block]
    other = table.first[block, bucket]
    if other == robot:
        table.first[block, bucket] = following[robot]
        return
    while following[other] != robot:
        other = following[other]
    following[other] = following[robot]


@inlined
def first_near(
    table: PathTable,
    robot: Whole,
    path: FloatArray,
    begin: Whole,
    middle: tuple[float, float, float],
    spread: float,
    block: Whole,
    other: Whole,
) -> int:
    """The first step of a block at which a robot is within the margin of another, in float64; 0 if at none.

    Its path begins with its position at step ``begin``.
    """
    safety_distance = table.radius[robot] + table.radius[other] + table.margin
    x, y, z = table.middle[block, other]
    x, y, z = x - middle[0], y - middle[1], z - middle[2]
    far = _WIDER * (safety_distance / table.flattening + spread + table.spread[block, other])
    if x * x + y * y + z * z > far * far:
        return 0
    return _first_step(table, safety_distance, path, begin, block, other)


@inlined
def _first_step(
    table: PathTable, safety_distance: float, path: FloatArray, begin: Whole, block: Whole, other: Whole
) -> int:
    """See :func:`first_near`."""
    first, last = steps_of(table, block)
    for t in range(first, last):
        gap2 = 0.0
        for axis in range(table.blocks.shape[3]):
            gap = np.float64(path[t - begin, axis]) - np.float64(table.blocks[block, other, t - first, axis])
            gap *= table.flattening if axis == 2 else 1.0
            gap2 += gap * gap
        if gap2 <= safety_distance * safety_distance:
            return t
    return 0


@inlined
def cells_around(
    table: PathTable, middle: tuple[float, float, float], spread: float
) -> tuple[int, int, int, int, int, int]:
    """Lowest and highest numbers of the cells around a path through a block, along three axes."""
    x, y, z = middle
    far = _WIDER * (table.safety_distance + spread + table.widest[0])
    flat = table.positions.shape[2] == 2
    return (
        _cell(table, x - far), _cell(table, x + far), _cell(table, y - far), _cell(table, y + far),
        0 if flat else _cell(table, z - far), 0 if flat else _cell(table, z + far),
    )  # fmt: skip


@inlined
def _is_among(robot: Whole, robots: IntArray) -> bool:
    found = False
    for other in robots:
        found |= other == robot
    return found


@compiled
def count_near(table: PathTable, robot: Whole, exclude: IntArray, path: FloatArray, begin: Whole, block: Whole) -> int:
    """Count the robots that one meets in a block, on a path that begins with its position at step ``begin``.

    Those in ``exclude`` ``(N,)`` do not count; it has to be one of them.
    """
    first, last = steps_of(table, block)
    middle, spread = enclose(path, table.positions.shape[2], first - begin, last - begin)
    low_i, high_i, low_j, high_j, low_k, high_k = cells_around(table, middle, spread)
    count = 0
    for i in range(low_i, high_i + 1):
        for j in range(low_j, high_j + 1):
            for k in range(low_k, high_k + 1):
                other = table.first[block, bucket_of(table, i, j, k)]
                while other != NOBODY:
                    if not _is_among(other, exclude):
                        count += first_near(table, robot, path, begin, middle, spread, block, other) > 0
                    other = table.following[block, other]
    return count


Box: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float]]  #: Lowest and highest corner [m]


class Nearby(NamedTuple):
    """Robots that may be near to paths in a box in a block, found once for all of these paths."""

    robots: IntArray  #: ``(K + 1,)`` their numbers
    buckets: IntArray  #: ``(K,)`` and buckets
    middle: Floats  #: ``(K, 3)`` float64 where each is, more or less [m],
    reach: Floats  #: ``(K,)`` float64 and how near to there a path meets it, from a point as large as nothing [m]
    found: IntArray  #: ``(1,)`` how many there are


def make_nearby(num_robots: int) -> Nearby:
    """Room for so many."""
    return Nearby(
        np.empty(num_robots + 1, np.int64),
        np.empty(num_robots, np.int64),
        np.empty((num_robots, 3)),
        np.empty(num_robots),
        np.zeros(1, np.int64),
    )


@compiled
def find_nearby(table: PathTable, robot: Whole, exclude: IntArray, box: Box, block: Whole, nearby: Nearby) -> None:
    """Find those that a robot may meet in a box in a block, but for those in ``exclude`` ``(N,)``."""
    (low_x, low_y, low_z), (high_x, high_y, high_z) = box
    own, count = table.radius[robot] + table.margin, np.int64(0)
    # All in a row: that takes less time than a few buckets.
    for other in range(table.middle.shape[1]):
        x, y, z = table.middle[block, other]
        far = _WIDER * ((own + table.radius[other]) / table.flattening + table.spread[block, other])
        nearby.robots[count] = other
        count += (
            (x >= low_x - far)
            & (x <= high_x + far)
            & (y >= low_y - far)
            & (y <= high_y + far)
            & (z >= low_z - far)
            & (z <= high_z + far)
        )
    nearby.found[0] = 0
    for number in range(count):
        other = nearby.robots[number]
        if not _is_among(other, exclude):
            kept = nearby.found[0]
            nearby.robots[kept], nearby.buckets[kept] = other, _own_bucket(table, block, other)
            nearby.reach[kept] = (own + table.radius[other]) / table.flattening + table.spread[block, other]
            for axis in range(3):
                nearby.middle[kept, axis] = table.middle[block, other, axis]
            nearby.found[0] = kept + 1


@compiled
def count_among(table: PathTable, robot: Whole, nearby: Nearby, path: FloatArray, block: Whole) -> int:
    """See :func:`count_near`, of a path in the box in which some are :class:`Nearby`."""
    first, last = steps_of(table, block)
    middle, spread = enclose(path, table.positions.shape[2], first - first, last - first)
    count = 0
    for number in range(nearby.found[0]):
        x, y, z = nearby.middle[number]
        x, y, z, far = x - middle[0], y - middle[1], z - middle[2], _WIDER * (nearby.reach[number] + spread)
        if x * x + y * y + z * z <= far * far:
            other = nearby.robots[number]
            safety_distance = table.radius[robot] + table.radius[other] + table.margin
            if _first_step(table, safety_distance, path, first, block, other) > 0:
                count += _times_looked_at(table, middle, spread, nearby.buckets[number])
    return count


@inlined
def _times_looked_at(table: PathTable, middle: tuple[float, float, float], spread: float, bucket: Whole) -> int:
    """Number of cells around a path that share a bucket: so often :func:`count_near` counts a robot in it."""
    low_i, high_i, low_j, high_j, low_k, high_k = cells_around(table, middle, spread)
    count = 0
    for i in range(low_i, high_i + 1):
        for j in range(low_j, high_j + 1):
            for k in range(low_k, high_k + 1):
                count += bucket_of(table, i, j, k) == bucket
    return count
