"""Routes: one robot's path as a row of points, and a whole team's with its precedence."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

from d4orm_env.core.arrays import Floats, IntArray


class Route(NamedTuple):
    """One robot's path as a row of points.

    Attributes:
        points: ``(P, 3)`` float64 [m].
        times: ``(P,)`` float64 when each is passed, of which only the order counts.
        bends: ``(P,)`` float64 radius of the bend at each point [m]; infinite on straight stretches, zero at sharp
            corners.
    """

    points: Floats
    times: Floats
    bends: Floats


class Routes(NamedTuple):
    """Every robot's route, and the robots that it waits for.

    Attributes:
        points: ``(T, 3)`` float64 points of all routes, one robot's after another's [m].
        times: ``(T,)`` float64, see :class:`Route`.
        bends: ``(T,)`` float64.
        first: ``(K + 1,)`` int64 where each robot's begin.
        arcs: ``(T,)`` float64 length of the route up to each point [m].
        wait_first: ``(K + 1,)`` int64 where each robot's waits begin.
        wait_at: int64 points, counted from the robot's first, that it may not come to ...
        wait_for: ... before this robot ...
        wait_until: ... has come to this point of its own.
    """

    points: Floats
    times: Floats
    bends: Floats
    first: IntArray
    arcs: Floats
    wait_first: IntArray
    wait_at: IntArray
    wait_for: IntArray
    wait_until: IntArray

    def each(self) -> list[slice]:
        """The rows of every robot."""
        return [slice(low, high) for low, high in pairwise(self.first)]


class Corners(NamedTuple):
    """Corners of paths, one robot's after another's, each from its start on.

    Attributes:
        places: ``(C, 3)`` float64 [m].
        begin: ``(K + 1,)`` int64 where each robot's begin.
        departs: ``(C,)`` float64 when it sets out for each from the one before.
        arrives: ``(C,)`` float64 when it gets there.
    """

    places: Floats
    begin: IntArray
    departs: Floats
    arrives: Floats
