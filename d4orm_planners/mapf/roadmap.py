"""Roadmap of the free space: a lattice fitted to the walls, and all starts and goals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Ints
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS
from d4orm_env.paths.lattice import lay_lattice
from d4orm_env.paths.shortest_paths import in_space
from d4orm_env.paths.spaces import Space, free_lines, make_space
from d4orm_planners.mapf import near_neighbours
from d4orm_planners.mapf.near_neighbours import find_near, sort_into_cells

PAIR_SLACK = 0.4
"""Distance that robots keep from each other beyond radii and margin, in radii: what they stray from their paths."""
WALL_SLACK = 0.15
"""The same for obstacles, as a share of radius and margin."""
REPLACED = 0.35
"""Share of the step within which a start or goal takes the place of a node of the lattice."""
MAX_NODES, MAX_COSTS = 200_000, 2**25
"""Most nodes, and most of them times robots; lattices are coarser where there would be more."""
PAD = 3
"""Steps beyond starts, goals and obstacles that nodes reach."""


class Roadmap(NamedTuple):
    """Places and the straight lines between them on which a robot keeps clear of obstacles.

    Attributes:
        nodes: ``(N, 3)`` float64 places [m].
        first: ``(N + 1,)`` int64 where the edges from each begin.
        heads: ``(E,)`` int32 where each edge leads.
        lengths: ``(E,)`` float64 [m].
        room: ``(E,)`` float64 the largest radius and margin that passes [m].
        near_first: ``(E + 1,)`` int64 where the nodes near each edge begin, those it joins included.
        near: int32 nodes near edges.
        gaps: float64 how near they are [m].
        starts: ``(K,)`` int64 nodes.
        goals: ``(K,)`` int64 nodes.
    """

    nodes: Floats
    first: IntArray
    heads: Ints
    lengths: Floats
    room: Floats
    near_first: IntArray
    near: Ints
    gaps: Floats
    starts: IntArray
    goals: IntArray


def lay_roadmap(problem: Problem, fineness: float = 1.0) -> Roadmap:
    """The roadmap of a team's world.

    Nodes of the lattice are so far apart that a robot at one leaves room on the diagonals around it.

    Args:
        problem: The team, its starts and goals, and the world.
        fineness: By how much nearer to each other nodes are than that, at most: in large worlds they are farther apart.
    """
    d, radius = problem.dimension, np.asarray(problem.team.radius, np.float64)
    spread = 2 * radius.max() + problem.margin + PAIR_SLACK * problem.team.largest_radius
    reaches = np.unique(radius + problem.margin)
    space = make_space(problem) if problem.world.num_obstacles else None
    ends = np.unique(in_space(np.concatenate([problem.start[:, :d], problem.goal]).astype(np.float64)), axis=0)
    asked, most = float(np.sqrt(2.0) * spread / fineness), min(MAX_NODES, MAX_COSTS // problem.num_robots)
    lattice = lay_lattice(problem, space, float(reaches[-1]) * (1 + WALL_SLACK), asked, most, pad=PAD * asked)
    places, step = lattice.places, lattice.step
    near_end = np.diff(find_near(sort_into_cells(ends, step), places, places, REPLACED * step)[0]) > 0
    nodes = np.concatenate([places[~near_end], ends])
    far = step * (1.5 if d == 2 else 1.8)
    line_first, others = find_near(sort_into_cells(nodes, far), nodes, nodes, far, after=True)
    one, other = np.repeat(np.arange(len(nodes)), np.diff(line_first)), others.astype(np.int64)
    room = _room(problem, space, reaches, nodes[one], nodes[other])
    one, other, room = one[room > 0], other[room > 0], room[room > 0]
    return _assembled(problem, nodes, one, other, room, spread + problem.goal_radius)


def _assembled(problem: Problem, nodes: Floats, one: IntArray, other: IntArray, room: Floats, reach: float) -> Roadmap:
    """The roadmap of nodes and undirected edges."""
    tails, heads = np.concatenate([one, other]), np.concatenate([other, one])
    order = np.lexsort((heads, tails))
    tails, heads, room = tails[order], heads[order], np.concatenate([room, room])[order]
    first = np.searchsorted(tails, np.arange(len(nodes) + 1)).astype(np.int64)
    near_first, near = find_near(sort_into_cells(nodes, reach), nodes[tails], nodes[heads], reach)
    gaps = np.empty(len(near))
    measure_gaps(nodes, tails, heads, near_first, near, gaps)
    d = problem.dimension
    return Roadmap(
        nodes=nodes,
        first=first,
        heads=heads.astype(np.int32),
        lengths=np.sqrt(((nodes[heads] - nodes[tails]) ** 2).sum(axis=1)),
        room=room,
        near_first=near_first,
        near=near,
        gaps=gaps,
        starts=_numbers(nodes, problem.start[:, :d]),
        goals=_numbers(nodes, problem.goal),
    )


def _numbers(nodes: Floats, places: FloatArray) -> IntArray:
    """``(K,)`` the nodes that are at places ``(K, d)``."""
    wanted = in_space(places.astype(np.float64))
    return np.array([int(np.flatnonzero((nodes == place).all(axis=1))[-1]) for place in wanted], np.int64)


def _room(problem: Problem, space: Space | None, reaches: Floats, tails: Floats, heads: Floats) -> Floats:
    """``(Q,)`` the largest of the ``reaches`` that passes on lines; zero where none does."""
    room = np.zeros(len(tails))
    for reach in reaches:
        free = np.ones(len(tails), bool)
        if space is not None:
            # Where there is room, a little more is kept, because nobody drives exactly on the line.
            free_lines(space, float(reach) * (1 + WALL_SLACK * 2 / 3), tails, heads, free)
        room[free] = reach
    return room


@cached_kernel(variant="gaps", **OPTIONS)
def measure_gaps(
    nodes: Floats, tails: IntArray, heads: IntArray, near_first: IntArray, near: Ints, gaps: Floats
) -> None:
    """Measure the distances of nodes from edges: ``gaps`` is output, all others as in :class:`Roadmap`."""
    for e in range(tails.shape[0]):
        for number in range(near_first[e], near_first[e + 1]):
            gaps[number] = np.sqrt(near_neighbours.squared_gap(nodes, near[number], nodes, tails[e], nodes, heads[e]))
