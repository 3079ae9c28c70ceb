"""Index of a team's positions at every step, compiled with numba: near robots without looking at every pair.

Time is cut into blocks of a few steps, in which robots get not far. In every block the robots are chained in the
buckets of a hash table, by the cell of a grid that the middle of each one's path through the block is in. A robot that
comes near a path is in one of the few cells around it. Memory and time grow with the robots, not with the pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray, IntArray, Ints, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.threads import Threads, available_cores

BLOCK = 8
"""Steps in a block."""

_DOUBT, _ROUNDING = 1 / 750, 64 * 2.0**-23
"""Distance from the goal radius within which rounding may decide, as a share of it and as a share of the coordinates:
farther than :mod:`d4orm_env.verify.docking` has it."""

_NOBODY = np.int32(-1)
_WIDER = 1 + 2.0**-20
"""Factor by which distances up to which there may be a robot are stretched for rounding."""


class PathTable(NamedTuple):
    """The index as kernels read it. Steps are counted from the first after the start.

    Attributes:
        block: :data:`BLOCK`.
        places: ``(H+1, K, d)`` float32 [m].
        radius: ``(K,)`` float64 [m].
        margin: ``()`` float64 [m].
        reach: ``()`` float64 the largest distance at which two robots are near [m].
        scale: ``()`` float64 cells in a metre.
        middle: ``(B, K, 3)`` float64 where each robot is in each block, more or less [m],
        spread: ``(B, K)`` float64 and how far from there it gets [m].
        widest: ``(1,)`` float64 the largest spread there has been.
        moving: ``(1,)`` int64 the last block in which any robot has moved.
        first: ``(B, N)`` int32 the first robot in each bucket of each block.
        following: ``(B, K)`` int32 the robot after each in its bucket.
    """

    block: int
    places: FloatArray
    radius: NDArray[np.float64]
    margin: np.float64
    reach: np.float64
    scale: np.float64
    middle: NDArray[np.float64]
    spread: NDArray[np.float64]
    widest: NDArray[np.float64]
    moving: IntArray
    first: NDArray[np.int32]
    following: NDArray[np.int32]


class PathIndex:
    """The paths of a team, some of which may change.

    Args:
        positions: ``(H+1, K, d)`` [m], finite; copied. At the start none counts as near.
        radius: ``(K,)`` [m].
        margin: Gap that robots are to keep between them [m].

    Attributes:
        table: The index as kernels read it.
    """

    def __init__(self, positions: FloatArray, radius: ArrayLike, margin: float) -> None:
        places = np.array(positions, np.float32, order="C")
        num_robots, num_blocks = places.shape[1], -(-(len(places) - 1) // BLOCK)
        radii = np.array(radius, np.float64)
        reach = 2 * radii.max() + margin
        # Robots as near to each other as they may be are about one in a cell.
        scale = 1 / (2 * reach)
        self.table = PathTable(
            BLOCK, places, radii, np.float64(margin), np.float64(reach), np.float64(scale),
            np.zeros((num_blocks, num_robots, 3)), np.zeros((num_blocks, num_robots)),
            np.zeros(1), np.zeros(1, np.int64),
            np.full((num_blocks, 1 << (2 * num_robots - 1).bit_length()), _NOBODY),
            np.empty((num_blocks, num_robots), np.int32),
        )  # fmt: skip
        _link_all(self.table)
        self._threads = Threads(available_cores())

    @property
    def positions(self) -> FloatArray:
        """``(H+1, K, d)`` the paths as they are [m]; not to be written to."""
        return self.table.places

    def move(self, robots: ArrayLike, paths: FloatArray) -> None:
        """Put robots ``(R,)`` on other paths ``(H+1, R, d)`` [m]."""
        _move(self.table, np.asarray(robots, np.int64), np.ascontiguousarray(paths, np.float32))

    def pairs(self) -> IntArray:
        """``(P, 2)`` pairs of robots ever within the margin of each other: the lower number first, ascending."""
        num_blocks, num_robots = self.table.following.shape
        parts: dict[int, IntArray] = {}
        self._threads.over(num_blocks, lambda part: parts.update({int(part[0]): _pairs(self.table, part)}))
        met = np.unique(np.concatenate(list(parts.values())))
        return np.stack(np.divmod(met, num_robots), axis=1)

    def count_meetings(
        self, robots: ArrayLike, states: FloatArray, until: ArrayLike | None = None
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Count the others that robots would meet on each of some paths, if nobody else's changed.

        Args:
            robots: ``(R,)``.
            states: ``(R, V, H+1, n)`` states, or just places.
            until: ``(R,)`` the last step that counts, or ``None`` for the horizon.

        Returns:
            ``(R, V)``, and the first step at which each meets one, ``H+1`` if it meets none.
        """
        index, paths = np.asarray(robots, np.int64), np.ascontiguousarray(states, np.float32)
        last = np.full(len(index), paths.shape[2]) if until is None else np.asarray(until, np.int64)
        met, when = np.empty((2, *paths.shape[:2]), np.int32)
        self._threads.over(len(index), lambda part: _count_meetings(self.table, index, paths, last, part, met, when))
        return met, when


def check_alone(arrays: ProblemArrays, robots: ArrayLike, states: FloatArray) -> NDArray[np.int32]:
    """Check some robots' paths without looking at the others.

    Args:
        arrays: The problem.
        robots: ``(R,)``.
        states: ``(R, V, H+1, n)`` states, or just places.

    Returns:
        ``(3, R, V)`` steps: the first after the start within the margin of an obstacle or the bounds; the last that
        moves the robot; and the first at which rounding decides whether it is at its goal. ``H+1`` where there is none.
    """
    index, paths = np.asarray(robots, np.int64), np.ascontiguousarray(states, np.float32)
    steps = np.empty((3, *paths.shape[:2]), np.int32)
    Threads(available_cores()).over(len(index), lambda part: _check_alone(arrays, index, paths, part, steps))
    return steps


@inlined
def steps_of(table: PathTable, block: Whole) -> tuple[Whole, Whole]:
    """First step of a block and the one after the last."""
    first = 1 + block * BLOCK
    return first, min(first + BLOCK, table.places.shape[0])


@inlined
def _cell(table: PathTable, x: float) -> int:
    """Number of the cell that a coordinate is in, along its axis."""
    return int(np.floor(x * table.scale))


@inlined
def _bucket(table: PathTable, i: int, j: int, k: int) -> int:
    """The bucket of a cell (the hash of Teschner et al., 2003)."""
    return (i * 73856093 ^ j * 19349663 ^ k * 83492791) & (table.first.shape[1] - 1)


@inlined
def _own_bucket(table: PathTable, block: Whole, robot: Whole) -> int:
    x, y, z = table.middle[block, robot]
    return _bucket(table, _cell(table, x), _cell(table, y), _cell(table, z))


@compiled
def _enclose(path: FloatArray, dimension: int, first: Whole, last: Whole) -> tuple[tuple[float, float, float], float]:
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
def _link(table: PathTable, block: Whole, robot: Whole) -> None:
    first, last = steps_of(table, block)
    middle, spread = _enclose(table.places[:, robot], table.places.shape[2], first, last)
    table.middle[block, robot, 0], table.middle[block, robot, 1], table.middle[block, robot, 2] = middle
    table.spread[block, robot] = spread
    table.widest[0] = max(table.widest[0], spread)
    if spread > 0.0:
        table.moving[0] = max(table.moving[0], block)
    bucket = _own_bucket(table, block, robot)
    table.following[block, robot] = table.first[block, bucket]
    table.first[block, bucket] = robot


@inlined
def _unlink(table: PathTable, block: Whole, robot: Whole) -> None:
    bucket, following = _own_bucket(table, block, robot), table.following[block]
    other = table.first[block, bucket]
    if other == robot:
        table.first[block, bucket] = following[robot]
        return
    while following[other] != robot:
        other = following[other]
    following[other] = following[robot]


@cached_kernel(**OPTIONS)
def _link_all(table: PathTable) -> None:
    for block in range(table.first.shape[0]):
        for robot in range(table.places.shape[1]):
            _link(table, block, robot)


@cached_kernel(**OPTIONS)
def _move(table: PathTable, robots: IntArray, paths: FloatArray) -> None:
    for i in range(robots.shape[0]):
        for t in range(paths.shape[0]):
            for axis in range(paths.shape[2]):
                table.places[t, robots[i], axis] = paths[t, i, axis]
        for block in range(table.first.shape[0]):
            _unlink(table, block, robots[i])
            _link(table, block, robots[i])


@inlined
def _first_near(
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

    Its path begins with its place at step ``begin``.
    """
    reach = table.radius[robot] + table.radius[other] + table.margin
    x, y, z = table.middle[block, other]
    x, y, z, far = x - middle[0], y - middle[1], z - middle[2], _WIDER * (reach + spread + table.spread[block, other])
    if x * x + y * y + z * z > far * far:
        return 0
    first, last = steps_of(table, block)
    for t in range(first, last):
        gap2 = 0.0
        for axis in range(table.places.shape[2]):
            gap = np.float64(path[t - begin, axis]) - np.float64(table.places[t, other, axis])
            gap2 += gap * gap
        if gap2 <= reach * reach:
            return t
    return 0


@inlined
def _cells_around(
    table: PathTable, middle: tuple[float, float, float], spread: float
) -> tuple[int, int, int, int, int, int]:
    """Lowest and highest numbers of the cells around a path through a block, along three axes."""
    x, y, z = middle
    far = _WIDER * (table.reach + spread + table.widest[0])
    flat = table.places.shape[2] == 2
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
def count_near(table: PathTable, robot: Whole, without: IntArray, path: FloatArray, begin: Whole, block: Whole) -> int:
    """Count the robots that one meets in a block, on a path that begins with its position at step ``begin``.

    Those in ``without`` ``(N,)`` do not count; it has to be one of them.
    """
    first, last = steps_of(table, block)
    middle, spread = _enclose(path, table.places.shape[2], first - begin, last - begin)
    low_i, high_i, low_j, high_j, low_k, high_k = _cells_around(table, middle, spread)
    count = 0
    for i in range(low_i, high_i + 1):
        for j in range(low_j, high_j + 1):
            for k in range(low_k, high_k + 1):
                other = table.first[block, _bucket(table, i, j, k)]
                while other != _NOBODY:
                    if not _is_among(other, without):
                        count += _first_near(table, robot, path, begin, middle, spread, block, other) > 0
                    other = table.following[block, other]
    return count


@cached_kernel(**OPTIONS)
def _pairs(table: PathTable, block_range: IntArray) -> IntArray:
    """Pairs that are near in a range of blocks, each as one number; some of them more than once."""
    num_robots = table.places.shape[1]
    found, count = np.empty(64, np.int64), 0
    for block in range(block_range[0], block_range[1]):
        for robot in range(num_robots):
            path, spread = table.places[:, robot], table.spread[block, robot]
            x, y, z = table.middle[block, robot]
            low_i, high_i, low_j, high_j, low_k, high_k = _cells_around(table, (x, y, z), spread)
            for i in range(low_i, high_i + 1):
                for j in range(low_j, high_j + 1):
                    for k in range(low_k, high_k + 1):
                        other = table.first[block, _bucket(table, i, j, k)]
                        while other != _NOBODY:
                            if (
                                other > robot
                                and _first_near(table, robot, path, 0, (x, y, z), spread, block, other) > 0
                            ):
                                if count == found.shape[0]:
                                    found = np.concatenate((found, np.empty(count, np.int64)))
                                found[count] = robot * num_robots + other
                                count += 1
                            other = table.following[block, other]
    return found[:count]


@cached_kernel(**OPTIONS)
def _count_meetings(
    table: PathTable,
    robots: IntArray,
    paths: FloatArray,
    until: IntArray,
    robot_range: IntArray,
    counts: Ints,
    when: Ints,
) -> None:
    """See :meth:`PathIndex.count_meetings`."""
    num_paths, num_blocks = paths.shape[1], table.first.shape[0]
    met = np.empty((num_paths, table.places.shape[1]), np.bool_)
    for r in range(robot_range[0], robot_range[1]):
        robot = robots[r]
        met[:] = False
        met[:, robot] = True
        counts[r], when[r] = 0, paths.shape[2]
        # Time in the outer loop: paths of one robot look into the same cells.
        for block in range(min(num_blocks, until[r] // BLOCK + 1)):
            first, last = steps_of(table, block)
            for v in range(num_paths):
                path = paths[r, v]
                middle, spread = _enclose(path, table.places.shape[2], first, last)
                if spread == 0.0 and block > table.moving[0] + 1:
                    continue  # Nothing is other than it was in the block before.
                low_i, high_i, low_j, high_j, low_k, high_k = _cells_around(table, middle, spread)
                for i in range(low_i, high_i + 1):
                    for j in range(low_j, high_j + 1):
                        for k in range(low_k, high_k + 1):
                            other = table.first[block, _bucket(table, i, j, k)]
                            while other != _NOBODY:
                                if not met[v, other]:
                                    t = _first_near(table, robot, path, 0, middle, spread, block, other)
                                    if t > 0:
                                        met[v, other] = True
                                        counts[r, v] += 1
                                        when[r, v] = min(when[r, v], t)
                                other = table.following[block, other]


@cached_kernel(**OPTIONS)
def _check_alone(
    arrays: ProblemArrays, robots: IntArray, paths: FloatArray, robot_range: IntArray, steps: Ints
) -> None:
    """See :func:`check_alone`."""
    dimension, closed, never = arrays.goal.shape[1], is_closed(arrays), paths.shape[2]
    for r in range(robot_range[0], robot_range[1]):
        reach, goal = arrays.radius[robots[r]] + arrays.margin, arrays.goal[robots[r]]
        for v in range(paths.shape[1]):
            path, last, touching, unsure = paths[r, v], never - 1, never, never
            while last > 0 and _is_same_place(path, dimension, last):
                last -= 1
            # Where it stands from then on it is no nearer to anything.
            for t in range(max(last, 1), 0, -1):
                if closed and touches_static(arrays, reach, path[t, :dimension]):
                    touching = t
                if is_unsure(arrays, path[t], goal):
                    unsure = t
            steps[0, r, v], steps[1, r, v], steps[2, r, v] = touching, last, unsure


@inlined
def _is_same_place(path: FloatArray, dimension: int, t: int) -> bool:
    same = True
    for axis in range(dimension):
        same &= path[t, axis] == path[t - 1, axis]
    return same


@inlined
def is_unsure(arrays: ProblemArrays, place: FloatArray, goal: FloatArray) -> bool:
    """Check whether rounding may decide, here or where the plan is judged, if a robot at this place is at its goal."""
    gap2, extent = 0.0, 0.0
    for axis in range(goal.shape[0]):
        gap = np.float64(place[axis]) - np.float64(goal[axis])
        gap2 += gap * gap
        extent = max(extent, abs(np.float64(place[axis])))
    goal_radius = np.sqrt(np.float64(arrays.squared_goal_radius))
    return abs(np.sqrt(gap2) - goal_radius) < _DOUBT * goal_radius + _ROUNDING * extent
