"""Checks of robots' paths: against those of others (see :mod:`~d4orm_planners.engine.path_table`), and alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Ints, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.team import Team
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, WITHOUT_ARRAYS, inlined
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_planners.engine.path_table import (
    BLOCK,
    NOBODY,
    PathTable,
    bucket_of,
    cells_around,
    enclose,
    first_near,
    link,
    steps_of,
    unlink,
)


class PathIndex:
    """The paths ``(H+1, K, d)`` of a team, finite [m], some of which may change; at the start none counts as near.

    Robots of ``radius`` ``(K,)`` [m] are to keep a gap of ``margin`` [m]; ``flattening`` is the factor for heights by
    which balls of these radii stand for them.
    """

    def __init__(self, positions: FloatArray, radius: ArrayLike, margin: float, flattening: float = 1.0) -> None:
        positions = np.array(positions, np.float32, order="C")
        num_robots, num_blocks = positions.shape[1], -(-(len(positions) - 1) // BLOCK)
        radii = np.array(radius, np.float64)
        safety_distance = (2 * radii.max() + margin) / flattening
        # Robots as near to each other as they may be are about one in a cell.
        scale = 1 / (2 * safety_distance)
        #: The index as kernels read it
        self.table = PathTable(
            positions, np.zeros((num_blocks, num_robots, BLOCK, positions.shape[2]), np.float32), radii,
            np.float64(margin), np.float64(safety_distance), np.float64(scale), np.float64(flattening),
            np.zeros((num_blocks, num_robots, 3)), np.zeros((num_blocks, num_robots)),
            np.zeros(1), np.zeros(1, np.int64),
            np.full((num_blocks, 1 << (2 * num_robots - 1).bit_length()), NOBODY),
            np.empty((num_blocks, num_robots), np.int32),
        )  # fmt: skip
        _link_all(self.table)
        self._threads = Threads(available_cores())

    @property
    def positions(self) -> FloatArray:
        """``(H+1, K, d)`` the paths as they are [m]; not to be written to."""
        return self.table.positions

    def move(self, robots: ArrayLike, paths: FloatArray) -> None:
        """Put robots ``(R,)`` on other paths ``(H+1, R, d)`` [m]."""
        _move(self.table, np.asarray(robots, np.int64), np.ascontiguousarray(paths, np.float32))

    def pairs(self) -> IntArray:
        """``(P, 2)`` pairs of robots ever within the margin of each other: the lower number first, ascending."""
        num_robots = self.table.following.shape[1]
        parts: dict[int, IntArray] = {}
        self._threads.over(num_robots, lambda part: parts.update({int(part[0]): _pairs(self.table, part)}))
        met = np.sort(np.concatenate(list(parts.values())))
        return np.stack(np.divmod(met, num_robots), axis=1)

    def count_meetings(self, robots: ArrayLike, states: FloatArray) -> tuple[Ints, Ints]:
        """Count the others that robots ``(R,)`` would meet on each of ``V`` paths, if only that one changed.

        ``states`` are ``(R, V, H+1, n)``, or just positions. Numbers are ``(R, V)``, and so are the first steps at
        which each meets one, ``H+1`` if it meets none.
        """
        index, paths = np.asarray(robots, np.int64), np.ascontiguousarray(states, np.float32)
        counts, when = np.empty((2, *paths.shape[:2]), np.int32)

        def count(part: IntArray) -> None:
            met = np.empty((paths.shape[1], self.table.positions.shape[1]), np.bool_)
            apart = np.empty(paths.shape[1], np.int64)
            _count_meetings(self.table, index, paths, part, met, apart, counts, when)

        self._threads.over(len(index), count)
        return counts, when


def team_index(team: Team, positions: FloatArray, margin: float) -> PathIndex:
    """The index of a team's paths ``(H+1, K, d)``; see :meth:`Team.flattening`."""
    return PathIndex(positions, team.girth, margin, team.flattening(margin))


@cached_kernel(**WITHOUT_ARRAYS)
def _link_all(table: PathTable) -> None:
    table = borrow(table)
    for block in range(table.first.shape[0]):
        for robot in range(table.positions.shape[1]):
            link(table, block, robot)


@cached_kernel(**WITHOUT_ARRAYS)
def _move(table: PathTable, robots: IntArray, paths: FloatArray) -> None:
    table = borrow(table)
    for i in range(robots.shape[0]):
        for t in range(paths.shape[0]):
            for axis in range(paths.shape[2]):
                table.positions[t, robots[i], axis] = paths[t, i, axis]
        for block in range(table.first.shape[0]):
            unlink(table, block, robots[i])
            link(table, block, robots[i])


@inlined
def _mark_near(
    table: PathTable, robot: Whole, path: FloatArray, middle: tuple[float, float, float], spread: float, block: Whole,
    met: BoolArray,
) -> tuple[int, int]:  # fmt: skip
    """Enter in ``met`` ``(K,)`` who is near in a block; return how many are new there and the first step of these."""
    begin = np.int64(0)  # a literal would compile what it is passed to once more
    count, soonest = 0, table.positions.shape[0]
    low_i, high_i, low_j, high_j, low_k, high_k = cells_around(table, middle, spread)
    for i in range(low_i, high_i + 1):
        for j in range(low_j, high_j + 1):
            for k in range(low_k, high_k + 1):
                other = table.first[block, bucket_of(table, i, j, k)]
                while other != NOBODY:
                    if not met[other]:
                        t = first_near(table, robot, path, begin, middle, spread, block, other)
                        if t > 0:
                            met[other], count, soonest = True, count + 1, min(soonest, t)
                    other = table.following[block, other]
    return count, soonest


@cached_kernel(**OPTIONS)
def _pairs(table: PathTable, robot_range: IntArray) -> IntArray:
    """Pairs in which a robot of a range has the lower number and they are ever near, each as one number."""
    table = borrow(table)
    num_blocks, num_robots = table.following.shape
    found, count, met = np.empty(64, np.int64), 0, np.empty(num_robots, np.bool_)
    for robot in range(robot_range[0], robot_range[1]):
        met[: robot + 1], met[robot + 1 :] = True, False
        for block in range(num_blocks):
            x, y, z = table.middle[block, robot]
            _mark_near(table, robot, table.positions[:, robot], (x, y, z), table.spread[block, robot], block, met)
        for other in range(robot + 1, num_robots):
            if met[other]:
                if count == found.shape[0]:
                    found = np.concatenate((found, np.empty(count, np.int64)))
                found[count], count = robot * num_robots + other, count + 1
    return found[:count]


@cached_kernel(**WITHOUT_ARRAYS)
def _count_meetings(
    table: PathTable, robots: IntArray, paths: FloatArray, robot_range: IntArray, met: BoolArray, apart: IntArray,
    counts: Ints, when: Ints,
) -> None:  # fmt: skip
    """See :meth:`PathIndex.count_meetings`; ``met`` ``(V, K)`` and ``apart`` ``(V,)`` are overwritten.

    Mostly paths are the same up to some step: what they meet until there is found for the first one only.
    """
    table = borrow(table)
    for r in range(robot_range[0], robot_range[1]):
        robot = robots[r]
        met[0, :], met[0, robot] = False, True
        counts[r, 0], when[r, 0], apart[0] = 0, paths.shape[2], 0
        for v in range(1, paths.shape[1]):
            apart[v] = _first_difference(paths[r, 0], paths[r, v])
        # Time in the outer loop: paths of one robot look into the same cells.
        for block in range(table.first.shape[0]):
            first, last = steps_of(table, block)
            for v in range(paths.shape[1] - 1, -1, -1):
                if last <= apart[v]:
                    continue
                if first <= apart[v]:
                    counts[r, v], when[r, v] = counts[r, 0], when[r, 0]
                    for other in range(met.shape[1]):
                        met[v, other] = met[0, other]
                middle, spread = enclose(paths[r, v], table.positions.shape[2], first, last)
                if spread == 0.0 and block > table.moving[0] + 1:
                    continue  # Nothing has moved since the block before.
                count, soonest = _mark_near(table, robot, paths[r, v], middle, spread, block, met[v])
                counts[r, v], when[r, v] = counts[r, v] + count, min(when[r, v], soonest)
        end = steps_of(table, table.first.shape[0] - 1)[1]
        for v in range(paths.shape[1]):
            if end <= apart[v]:
                counts[r, v], when[r, v] = counts[r, 0], when[r, 0]


@inlined
def _first_difference(path: FloatArray, other: FloatArray) -> Whole:
    """The first step after the start at which two paths are not at the same position, ``H+1`` if there is none."""
    for t in range(1, path.shape[0]):
        for axis in range(path.shape[1]):
            if path[t, axis] != other[t, axis]:
                return t
    return path.shape[0]


_DOUBT, _ROUNDING = 1 / 750, 64 * 2.0**-23
"""Distance from the goal radius within which rounding may decide, as a share of it and as a share of the coordinates:
farther than :mod:`d4orm_env.verify.docking` has it."""


def check_alone(arrays: ProblemArrays, robots: ArrayLike, states: FloatArray) -> Ints:
    """Check paths ``(R, V, H+1, n)`` of robots ``(R,)``, states or just positions, without looking at the others.

    ``(3, R, V)`` steps, ``H+1`` where there is none: the first after the start within the margin of an obstacle or the
    bounds; the last that moves the robot; and the first at which rounding decides whether it is at its goal.
    """
    index, paths = np.asarray(robots, np.int64), np.ascontiguousarray(states, np.float32)
    steps = np.empty((3, *paths.shape[:2]), np.int32)
    Threads(available_cores()).over(len(index), lambda part: _check_alone(arrays, index, paths, part, steps))
    return steps


@cached_kernel(**WITHOUT_ARRAYS)
def _check_alone(
    arrays: ProblemArrays, robots: IntArray, paths: FloatArray, robot_range: IntArray, steps: Ints
) -> None:
    arrays = borrow(arrays)
    dimension, closed, never = arrays.goal.shape[1], is_closed(arrays), paths.shape[2]
    for r in range(robot_range[0], robot_range[1]):
        safety_distance, goal = arrays.wall_radius[robots[r]] + arrays.margin, arrays.goal[robots[r]]
        for v in range(paths.shape[1]):
            path, last, touching, unsure = paths[r, v], never - 1, never, never
            while last > 0 and _is_same_position(path, dimension, last):
                last -= 1
            # From then on it is at rest, and no nearer to anything.
            for t in range(max(last, 1), 0, -1):
                if closed and touches_static(arrays, safety_distance, path[t, :dimension]):
                    touching = t
                if is_unsure(arrays, path[t], goal):
                    unsure = t
            steps[0, r, v], steps[1, r, v], steps[2, r, v] = touching, last, unsure


@inlined
def _is_same_position(path: FloatArray, dimension: int, t: int) -> bool:
    same = True
    for axis in range(dimension):
        same &= path[t, axis] == path[t - 1, axis]
    return same


@inlined
def is_unsure(arrays: ProblemArrays, position: FloatArray, goal: FloatArray) -> bool:
    """Check whether rounding may decide, here or in the verification, if a robot at this position is at its goal."""
    gap2, extent = 0.0, 0.0
    for axis in range(goal.shape[0]):
        gap = np.float64(position[axis]) - np.float64(goal[axis])
        gap2 += gap * gap
        extent = max(extent, abs(np.float64(position[axis])))
    if gap2 > 8 * np.float64(arrays.squared_goal_radius) + extent * extent * 2.0**-18:
        return False  # Mostly it is much farther away than that.
    goal_radius = np.sqrt(np.float64(arrays.squared_goal_radius))
    return abs(np.sqrt(gap2) - goal_radius) < _DOUBT * goal_radius + _ROUNDING * extent
