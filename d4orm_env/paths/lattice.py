"""Grids for paths: their points, those where a body fits, and how far apart they are laid."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import Floats, IntArray, Ints, Whole
from d4orm_env.core.portable import root
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined
from d4orm_env.paths.spaces import Position, Space, about_to_obstacles, clearance_at, to_bounds

MAX_POINTS = 2**24
"""Most points of a grid, blocked ones included."""
STRETCH = 1.05
"""Least factor by which the next grid is coarser where one has too many points."""
_PUSHES, _SLACK = 4, 0.03
"""Number of times a node is pushed away from an obstacle, and the excess of a push, as a share of the safety
distance; a third of it each time, so as to end in the middle of narrow gaps."""


class Lattice(NamedTuple):
    """A grid whose free points are the nodes of a wavefront, both numbered with the last axis fastest."""

    low: Floats  #: ``(3,)`` the first point [m]
    step: float  #: Between neighbours along an axis [m]
    size: IntArray  #: ``(3,)`` int64 points along each axis
    moves: IntArray  #: ``(M, 3)`` int64 to the neighbours of a point
    nodes: Ints  #: ``(G,)`` int32 the node of each point; -1 where it is not free
    points: Ints  #: ``(N,)`` int32 the point of each node
    positions: Floats  #: ``(N, 3)`` where each node is [m]


@inlined
def indices_of(size: IntArray, n: Whole) -> tuple[int, int, int]:
    """Steps to a point along each axis."""
    return n // (size[2] * size[1]), n // size[2] % size[1], n % size[2]


@inlined
def corner_below(low: Floats, step: float, size: IntArray, q: Position) -> tuple[int, int, int]:
    """Steps along each axis to the point below a position, or to the outermost one."""
    i = min(max(np.int64((q[0] - low[0]) / step), 0), size[0] - 1)
    j = min(max(np.int64((q[1] - low[1]) / step), 0), size[1] - 1)
    return i, j, min(max(np.int64((q[2] - low[2]) / step), 0), size[2] - 1)


@inlined
def neighbour(lattice: Lattice, move: int, i: int, j: int, k: int) -> np.int64:
    """The node next to a point; -1 where none is."""
    ni, nj, nk = i + lattice.moves[move, 0], j + lattice.moves[move, 1], k + lattice.moves[move, 2]
    size = lattice.size
    if ni < 0 or nj < 0 or nk < 0 or ni >= size[0] or nj >= size[1] or nk >= size[2]:
        return np.int64(-1)
    return np.int64(lattice.nodes[(ni * size[1] + nj) * size[2] + nk])


@compiled
def settled(space: Space, lattice: Lattice, safety_distance: float, position: Position) -> tuple[Position, bool]:
    """A position, or where it is not clear by ``safety_distance`` one within half a step; and whether that is clear."""
    half, probe, slack = lattice.step / 2, lattice.step / 64, safety_distance * _SLACK
    x, y, z = position
    clearance = clearance_at(space, x, y, z)
    for _ in range(_PUSHES):
        if clearance > safety_distance or clearance < safety_distance - lattice.step:
            break
        gx = clearance_at(space, x + probe, y, z) - clearance_at(space, x - probe, y, z)
        gy = clearance_at(space, x, y + probe, z) - clearance_at(space, x, y - probe, z)
        gz = clearance_at(space, x, y, z + probe) - clearance_at(space, x, y, z - probe)
        norm = np.sqrt(gx * gx + gy * gy + gz * gz)
        if norm == 0.0:
            break
        push = (safety_distance + slack - clearance) / norm
        slack /= 3
        x = min(max(x + push * gx, position[0] - half), position[0] + half)
        y = min(max(y + push * gy, position[1] - half), position[1] + half)
        z = min(max(z + push * gz, position[2] - half), position[2] + half)
        clearance = clearance_at(space, x, y, z)
    return (x, y, z), clearance > safety_distance


@cached_kernel(variant="settle", **OPTIONS)
def settle_nodes(space: Space, lattice: Lattice, safety_distance: float) -> int:
    """Find the points of a lattice that are clear by ``safety_distance`` [m], or less than half a step away from it.

    Returned is their number; as many as there is room for are written as nodes.
    """
    low, step, count = lattice.low, lattice.step, 0
    for n in range(lattice.nodes.shape[0]):
        i, j, k = indices_of(lattice.size, n)
        position = (low[0] + i * step, low[1] + j * step, low[2] + k * step)
        fits = (
            about_to_obstacles(space, position[0], position[1], position[2])
            > safety_distance
            < to_bounds(space, position[0], position[1], position[2])
        )
        if not fits:
            position, fits = settled(space, lattice, safety_distance, position)
        lattice.nodes[n] = count if fits else -1
        if fits:
            if count < lattice.points.shape[0]:
                lattice.points[count] = n
                lattice.positions[count, 0], lattice.positions[count, 1], lattice.positions[count, 2] = position
            count += 1
    return count


def lay_lattice(
    problem: Problem,
    space: Space | None,
    safety_distance: float,
    step: float,
    most: int,
    most_points: int = MAX_POINTS,
    pad: float = 0.0,
) -> Lattice:
    """Nodes wherever paths of a problem may lead and ``safety_distance`` [m] is clear, ``step`` [m] apart.

    They are farther apart where there would be more than ``most`` nodes or ``most_points`` points, blocked ones
    included. ``space`` is the problem's obstacles, ``None`` where there are none. Paths may lead ``pad`` beyond starts,
    goals and obstacles, or twice the safety distance where that is more [m].
    """
    low, high = _extent(problem, space, max(pad, 2 * safety_distance))
    most_points = most if space is None else most_points
    while True:
        while np.floor((high - low) / step + 1).prod() > most_points:
            step *= STRETCH
        lattice = _empty_lattice(low, high, step, most)
        count = _fill(lattice, problem.world, space, safety_distance)
        if count <= most:
            return lattice._replace(points=lattice.points[:count].copy(), positions=lattice.positions[:count].copy())
        step *= STRETCH * root(count / most, problem.dimension)


def _extent(problem: Problem, space: Space | None, pad: float) -> tuple[Floats, Floats]:
    """Lowest and highest corner of where paths may lead [m]."""
    d, bounds = problem.dimension, problem.world.bounds.astype(np.float64)
    positions = np.concatenate([problem.start[:, :d], problem.goal]).astype(np.float64)
    if space is not None:
        obstacles = space.extent[:, :d]
        positions = np.concatenate([positions, np.where(np.isinf(obstacles), problem.goal[0], obstacles)])
    return np.maximum(positions.min(axis=0) - pad, bounds[0]), np.minimum(positions.max(axis=0) + pad, bounds[1])


def _empty_lattice(low: Floats, high: Floats, step: float, most: int) -> Lattice:
    """The points of a lattice in the middle between two corners, and room for so many nodes."""
    d = len(low)
    size, flat = np.floor((high - low) / step).astype(np.int64) + 1, [0] * (3 - d)
    count = min(int(size.prod()), most)
    return Lattice(
        low=np.append((low + high - (size - 1) * step) / 2, flat).astype(np.float64),
        step=step,
        size=np.append(size, [1] * (3 - d)).astype(np.int64),
        moves=np.array([(*move, *flat) for move in product((-1, 0, 1), repeat=d) if any(move)]),
        nodes=np.empty(size.prod(), np.int32),
        points=np.empty(count, np.int32),
        positions=np.empty((count, 3)),
    )


def _fill(lattice: Lattice, world: World, space: Space | None, safety_distance: float) -> int:
    """Find the nodes of a lattice, and write as many as there is room for; how many there are."""
    if space is not None:
        return settle_nodes(space, lattice, safety_distance)
    bounds, d = world.bounds.astype(np.float64), world.dimension
    lattice.positions[:] = lattice.low + np.indices(tuple(lattice.size)).reshape(3, -1).T * lattice.step
    free = (
        (lattice.positions[:, :d] >= bounds[0] + safety_distance)
        & (lattice.positions[:, :d] <= bounds[1] - safety_distance)
    ).all(axis=1)
    inside = np.flatnonzero(free)
    count = len(inside)
    lattice.nodes[:] = -1
    lattice.nodes[inside] = np.arange(count)
    lattice.points[:count], lattice.positions[:count] = inside, lattice.positions[inside]
    return count
