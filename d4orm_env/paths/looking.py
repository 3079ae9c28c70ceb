"""The wavefronts of a team in one struct, and a look at them: where to go from anywhere, and how far it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import Floats, IntArray, Ints
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.lattice import Lattice, corner_below
from d4orm_env.paths.spaces import Position, Space, clearance_at, distance, position_of, sees
from d4orm_env.paths.wavefront import NO_ANCHOR, Front


class Fields(NamedTuple):
    """The wavefronts of a team, one behind the other, and the lattices that they are on."""

    safety_distance: Floats  #: ``(K,)`` the distance that each robot keeps [m]
    goal_clearance: Floats  #: ``(K,)`` clearance at its goal [m]
    lattice: IntArray  #: ``(K,)`` int64 number of its lattice
    low: Floats  #: ``(L, 3)`` the first nodes of the lattices [m]
    step: Floats  #: ``(L,)`` between neighbours along an axis [m]
    size: IntArray  #: ``(L, 3)`` int64 points along each axis
    first_node: IntArray  #: ``(L + 1,)`` int64 where the part of ``nodes`` of each lattice begins, and the end
    nodes: Ints  #: int32 the node of each point; -1 where it is not free
    first_position: IntArray  #: ``(L + 1,)`` int64 where the part of ``positions`` of each lattice begins, and the end
    positions: Floats  #: ``(., 3)`` where the nodes are [m]
    first_anchor: IntArray  #: ``(K + 1,)`` int64 where the part of ``anchor`` of each robot begins, and the end
    anchor: Ints  #: int32, see :class:`Front`
    #: ``(K + 1,)`` int64 where those of ``points``, ``values`` and ``parents`` begin, and the end
    first_point: IntArray
    points: Floats  #: ``(., 3)`` [m]
    values: Floats  #: [m]
    parents: Ints  #: int32, counted from the first one of the robot


def gather(safety_distance: Floats, lattices: Sequence[Lattice], number: IntArray, fronts: Sequence[Front]) -> Fields:
    """The wavefronts of robots that keep ``safety_distance`` ``(K,)``, on the lattices of these numbers ``(K,)``."""
    return Fields(
        safety_distance=safety_distance,
        goal_clearance=np.array([front.goal_clearance for front in fronts]),
        lattice=number,
        low=np.stack([lattice.low for lattice in lattices]),
        step=np.array([lattice.step for lattice in lattices]),
        size=np.stack([lattice.size for lattice in lattices]),
        first_node=_beginnings([lattice.nodes for lattice in lattices]),
        nodes=_joined([lattice.nodes for lattice in lattices]),
        first_position=_beginnings([lattice.positions for lattice in lattices]),
        positions=_joined([lattice.positions for lattice in lattices]),
        first_anchor=_beginnings([front.anchor for front in fronts]),
        anchor=_joined([front.anchor for front in fronts]),
        first_point=_beginnings([front.points for front in fronts]),
        points=_joined([front.points for front in fronts]),
        values=_joined([front.values for front in fronts]),
        parents=_joined([front.parents for front in fronts]),
    )


def _beginnings(arrays: list[np.ndarray]) -> IntArray:
    """Return the offset of each when they lie one behind the other, and the end of the last one."""
    return np.cumsum([0, *map(len, arrays)])


def _joined(arrays: list[np.ndarray]) -> Any:
    """The arrays, one behind the other; a single one is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


@compiled
def _look_from(space: Space, fields: Fields, robot: int, q: Position) -> tuple[Position, float, np.int32]:
    """Return the next position for a robot at ``q``, the length of the whole path, and the anchor."""
    safety_distance, lattice, first = fields.safety_distance[robot], fields.lattice[robot], fields.first_point[robot]
    step, size, first_position = fields.step[lattice], fields.size[lattice], fields.first_position[lattice]
    first_node, first_anchor = fields.first_node[lattice], fields.first_anchor[robot]
    goal, goal_clearance = position_of(fields.points, first), fields.goal_clearance[robot]
    clearance = clearance_at(space, q[0], q[1], q[2])
    if sees(space, safety_distance, goal, goal_clearance, q, clearance):
        return goal, distance(goal, q), np.int32(0)
    i, j, k = corner_below(fields.low[lattice], step, size, q)
    # From deep inside an obstacle there may be none.
    rings = 2 + np.int64(2 * min(max(0.0, safety_distance - clearance), 2 * safety_distance) / step)
    ring, target, length, anchor = 0, q, np.inf, NO_ANCHOR
    while ring < rings and anchor < 0:
        last = NO_ANCHOR
        for ni in range(max(0, i - ring), min(size[0], i + ring + 2)):
            for nj in range(max(0, j - ring), min(size[1], j + ring + 2)):
                for nk in range(max(0, k - ring), min(size[2], k + ring + 2)):
                    n = np.int64(fields.nodes[first_node + (ni * size[1] + nj) * size[2] + nk])
                    if n < 0:
                        continue
                    a = fields.anchor[first_anchor + n]
                    if a < 0:
                        continue
                    at, value = position_of(fields.points, first + a), fields.values[first + a]
                    straight = value + distance(at, q)
                    if straight < length and a != last:
                        last = a
                        kept = goal_clearance if a == 0 else safety_distance
                        if sees(space, safety_distance, at, kept, q, clearance):
                            target, length, anchor = at, straight, a
                            continue
                    position = position_of(fields.positions, first_position + n)
                    bent = value + distance(at, position) + distance(position, q)
                    if bent < length and sees(space, safety_distance, position, safety_distance, q, clearance):
                        target, length, anchor = position, bent, a
        ring += 1
    return target, length, anchor


@cached_kernel(variant="look", **OPTIONS)
def look(
    space: Space, fields: Fields, first: int, positions: Floats, target: Floats, length: Floats, anchor: Ints
) -> None:
    """Fill the paths of robots from number ``first`` on from positions ``(R, Q, 3)``.

    ``target`` ``(R, Q, 3)`` is where to go first, the position itself where there is no path; ``length`` ``(R, Q)``
    that of the whole path, infinite where there is none; ``anchor`` ``(R, Q)`` the anchor that is the target or comes
    next, else -1.
    """
    for r in range(positions.shape[0]):
        for b in range(positions.shape[1]):
            q = (positions[r, b, 0], positions[r, b, 1], positions[r, b, 2])
            to, length[r, b], anchor[r, b] = _look_from(space, fields, first + r, q)
            target[r, b, 0], target[r, b, 1], target[r, b, 2] = to
