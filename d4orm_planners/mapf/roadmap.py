"""Roadmap of the free space, a lattice fitted to the walls with all starts and goals, and shortest paths on it."""

from __future__ import annotations

import heapq
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Ints, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.lattice import lay_lattice
from d4orm_env.paths.shortest_paths import in_space
from d4orm_env.paths.spaces import Space, free_lines, make_space
from d4orm_planners.mapf.near_neighbours import find_near, sort_into_cells, squared_gap

PAIR_SLACK = 0.4  #: Distance that robots keep beyond radii and margin, in radii: what they stray from their paths
WALL_SLACK = 0.15  #: The same for obstacles, as a share of radius and margin
REPLACED = 0.35  #: Share of the step within which a start or goal takes the place of a node of the lattice
MAX_NODES, MAX_COSTS = 200_000, 2**25  #: Most nodes, and most of them times robots; beyond, lattices are coarser
NARROW_SLACK = 0.03  #: The same as ``WALL_SLACK`` in gaps that are too narrow for it
PUSHES, DAMPING = 12, 0.8  #: Times that a position is pushed from obstacles, each so much less, to the middle
FINEST_IN_SPACE = 2.2  #: Most of the fineness in space: nodes near edges become as many as its sixth power
PAD = 3  #: Steps beyond starts, goals and obstacles that nodes reach


class Roadmap(NamedTuple):
    """Positions and the straight lines between them on which a robot keeps clear of obstacles."""

    nodes: Floats  #: ``(N, 3)`` float64 positions [m]
    flat: Floats  #: The same as others see them; see :meth:`Team.flattened`
    first: IntArray  #: ``(N + 1,)`` int64 where the edges from each begin
    heads: Ints  #: ``(E,)`` int32 where each edge leads
    lengths: Floats  #: ``(E,)`` float64 [m]
    room: Floats  #: ``(E,)`` float64 largest safety distance of a robot that passes [m]
    near_first: IntArray  #: ``(E + 1,)`` int64 where the nodes near each edge begin, those it joins included
    near: Ints  #: int32 nodes near edges
    gaps: Floats  #: float64 how near they are [m]
    starts: IntArray  #: ``(K,)`` int64 nodes
    goals: IntArray  #: ``(K,)`` int64 nodes


def lay_roadmap(problem: Problem, fineness: float = 1.0, *, narrow: bool = False) -> Roadmap:
    """The roadmap of a team's world.

    Nodes of the lattice are so far apart that a robot at one leaves room on the diagonals around it, or by ``fineness``
    nearer at most: in large worlds they are farther apart. If ``narrow``, robots' own shortest paths are part of it,
    however narrow the gaps that they lead through.
    """
    d, team = problem.dimension, problem.team
    spread = 2 * float(team.girth.max()) + problem.margin + PAIR_SLACK * team.largest_radius
    safety_distances = np.unique(np.asarray(team.wall_radius, np.float64) + problem.margin)
    space = make_space(problem) if problem.world.num_obstacles else None
    ends = np.unique(in_space(np.concatenate([problem.start[:, :d], problem.goal]).astype(np.float64)), axis=0)
    fineness = min(fineness, FINEST_IN_SPACE) if d == 3 else fineness
    asked, most = float(np.sqrt(2.0) * spread / fineness), min(MAX_NODES, MAX_COSTS // problem.num_robots)
    lattice = lay_lattice(problem, space, float(safety_distances[-1]) * (1 + WALL_SLACK), asked, most, pad=PAD * asked)
    positions, step = lattice.positions, lattice.step
    near_end = np.diff(find_near(sort_into_cells(ends, step), positions, positions, REPLACED * step)[0]) > 0
    nodes = np.concatenate([positions[~near_end], _along_paths(problem, lattice.step) if narrow else ends[:0], ends])
    far = step * (1.5 if d == 2 else 1.8)
    line_first, others = find_near(sort_into_cells(nodes, far), nodes, nodes, far, after=True)
    one, other = np.repeat(np.arange(len(nodes)), np.diff(line_first)), others.astype(np.int64)
    slack = NARROW_SLACK if narrow else WALL_SLACK
    room = _room(space, safety_distances * (1 + slack * 2 / 3), safety_distances, nodes[one], nodes[other])
    one, other, room = one[room > 0], other[room > 0], room[room > 0]
    return _assembled(problem, nodes, one, other, room, spread + problem.goal_radius)


def _assembled(
    problem: Problem, nodes: Floats, one: IntArray, other: IntArray, room: Floats, distance: float
) -> Roadmap:
    """The roadmap of nodes and undirected edges, and of nodes within ``distance`` of these [m]."""
    tails, heads = np.concatenate([one, other]), np.concatenate([other, one])
    order = np.lexsort((heads, tails))
    tails, heads, room = tails[order], heads[order], np.concatenate([room, room])[order]
    first = np.searchsorted(tails, np.arange(len(nodes) + 1)).astype(np.int64)
    flat = problem.team.flattened(nodes, problem.margin)
    near_first, near = find_near(sort_into_cells(flat, distance), flat[tails], flat[heads], distance)
    gaps = np.empty(len(near))
    measure_gaps(flat, tails, heads, near_first, near, gaps)
    d = problem.dimension
    return Roadmap(
        nodes=nodes,
        flat=flat,
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


def _numbers(nodes: Floats, positions: FloatArray) -> IntArray:
    """``(K,)`` the nodes that are at positions ``(K, d)``."""
    wanted = in_space(positions.astype(np.float64))
    return np.array([int(np.flatnonzero((nodes == position).all(axis=1))[-1]) for position in wanted], np.int64)


def _room(space: Space | None, wanted: Floats, safety_distances: Floats, tails: Floats, heads: Floats) -> Floats:
    """``(Q,)`` the largest of the ``safety_distances`` that passes on lines; zero where none does.

    Where there is room, a little more is ``wanted``, because nobody drives exactly on the line.
    """
    room = np.zeros(len(tails))
    for distance, safety_distance in zip(wanted, safety_distances, strict=True):
        free = np.ones(len(tails), bool)
        if space is not None:
            free_lines(space, float(distance), tails, heads, free)
        room[free] = safety_distance
    return room


def _along_paths(problem: Problem, step: float) -> Floats:
    """``(Q, 3)`` positions on the robots' own shortest paths, pushed to the middle of narrow gaps [m]."""
    d, world, lines = problem.dimension, problem.world, []
    for robot in range(problem.num_robots):
        corners = problem.shortest_paths.path(robot)
        for tail, head in pairwise(corners):
            shares = np.linspace(0, 1, 2 + int(2 * np.sqrt(((head - tail) ** 2).sum()) / step))
            lines.append(tail + shares[:, None] * (head - tail))
    points = np.concatenate(lines)
    wanted = float(np.asarray(problem.team.wall_radius).max() + problem.margin) * (1 + WALL_SLACK)
    for push in np.cumprod(np.full(PUSHES, DAMPING)):
        near = (world.clearance(points + probe) - world.clearance(points - probe) for probe in np.eye(d) * step / 64)
        gradient = np.stack(list(near), axis=1)
        norm = np.maximum(np.sqrt((gradient**2).sum(axis=1, keepdims=True)), np.finfo(float).tiny)
        points += push * np.clip(wanted - world.clearance(points), 0, step / 4)[:, None] * gradient / norm
    return in_space(points)


@cached_kernel(variant="gaps", **OPTIONS)
def measure_gaps(
    nodes: Floats, tails: IntArray, heads: IntArray, near_first: IntArray, near: Ints, gaps: Floats
) -> None:
    """Measure the distances of nodes from edges: ``gaps`` is output, all others as in :class:`Roadmap`."""
    for e in range(tails.shape[0]):
        for number in range(near_first[e], near_first[e + 1]):
            # Of the type that numbers have elsewhere, or it would be compiled once more.
            node, tail, head = np.int64(near[number]), np.int64(tails[e]), np.int64(heads[e])
            gaps[number] = np.sqrt(squared_gap(nodes, node, nodes, tail, nodes, head))


ROUNDING = 2.0**-27  #: Share of the radius of the largest robot that is rounding


class RobotArrays(NamedTuple):
    """Robots as discs, and their paths to their goals, as the kernels of path finding read them."""

    radius: Floats  #: ``(K,)`` [m]
    size: float  #: The largest of them [m]
    safety_distance: Floats  #: ``(K,)`` radius and margin to obstacles [m]
    margin: float  #: Between robots [m]
    slack: float  #: Distance beyond it that they keep where they can [m]
    goal_radius: float  #: Distance from its goal at which a robot may stop [m]
    docks: bool  #: Whether a robot that has arrived stays there for good
    starts: IntArray  #: ``(K,)`` int64 nodes
    goals: IntArray  #: ``(K,)`` int64 nodes
    costs: FloatArray  #: ``(K, N)`` float32 length of the path from every node to each robot's goal [m]


@compiled
def _gap(points: Floats, u: Whole, v: Whole) -> float:
    return np.sqrt(squared_gap(points, u, points, v, points, v))


@compiled
def passes_too_near(
    roadmap: Roadmap, bodies: RobotArrays, k: Whole, tail: Whole, head: Whole, i: Whole, u: Whole, gap: float
) -> bool:
    """Check whether robot ``k`` passes robot ``i`` at node ``u`` too near, ``gap``, on its way between two nodes.

    Starts and goals may be nearer to each other than robots keep: then it may leave its own, and come to its own, if it
    comes no nearer on the way.
    """
    hard = bodies.radius[k] + bodies.radius[i] + bodies.margin
    arrived = bodies.docks and u == bodies.goals[i]
    need = hard + (bodies.slack / 2 + bodies.goal_radius if arrived else bodies.slack)
    if gap >= need:
        return False
    if tail == bodies.starts[k] or tail == bodies.goals[k]:
        need = min(need, _gap(roadmap.flat, u, tail))
    if head == bodies.goals[k]:
        need = min(need, max(_gap(roadmap.flat, u, head), hard))
    return gap < need - ROUNDING * bodies.size


@compiled
def closed(roadmap: Roadmap, bodies: RobotArrays, arrived: Ints, k: Whole, tail: Whole, head: Whole, e: Whole) -> bool:
    """Check whether an edge, or its reverse, is closed for good to a robot that drives from ``tail`` to ``head``.

    The robot does not fit, would arrive in passing, or be too near to one that has arrived. ``arrived`` ``(N,)`` is the
    robot that has arrived at each node, -1 for none.
    """
    if roadmap.room[e] < bodies.safety_distance[k]:
        return True
    if not bodies.docks:
        return False
    for number in range(roadmap.near_first[e], roadmap.near_first[e + 1]):
        u = np.int64(roadmap.near[number])
        if u == bodies.goals[k]:
            if u != head and u != tail and roadmap.gaps[number] < bodies.goal_radius + bodies.slack / 2:
                return True
        elif arrived[u] >= 0:
            i = np.int64(arrived[u])
            if i != k and passes_too_near(roadmap, bodies, k, tail, head, i, u, roadmap.gaps[number]):
                return True
    return False


@cached_kernel(variant="costs", **OPTIONS)
def fill_costs(roadmap: Roadmap, bodies: RobotArrays, arrived: Ints, k: Whole, end: Whole, costs: FloatArray) -> None:
    """Length of a robot's shortest path from every node to node ``end``; ``costs`` ``(N,)`` is output."""
    costs[:] = np.inf
    heap = [(0.0, np.int64(end))]
    costs[end] = 0.0
    while len(heap) > 0:
        cost, n = heapq.heappop(heap)
        if cost > costs[n]:
            continue
        for e in range(roadmap.first[n], roadmap.first[n + 1]):
            head = np.int64(roadmap.heads[e])
            # Compared as they are kept, in single precision, or rounding would let nodes come up for ever.
            through = np.float32(cost + roadmap.lengths[e])
            if through < costs[head] and not closed(roadmap, bodies, arrived, k, head, n, e):
                costs[head] = through
                heapq.heappush(heap, (np.float64(through), head))


@cached_kernel(variant="open", **OPTIONS)
def is_open(roadmap: Roadmap, bodies: RobotArrays, arrived: Ints, k: Whole, at: Whole, costs: FloatArray) -> bool:
    """Check whether no robot that has arrived closes the path that a robot at a node would take by these costs."""
    if not costs[at] < np.inf:
        return False
    while at != bodies.goals[k]:
        best, edge = costs[at], -1
        for e in range(roadmap.first[at], roadmap.first[at + 1]):
            if costs[roadmap.heads[e]] < best and roadmap.room[e] >= bodies.safety_distance[k]:
                best, edge = costs[roadmap.heads[e]], e
        if edge < 0:
            return False
        head = np.int64(roadmap.heads[edge])
        if closed(roadmap, bodies, arrived, k, at, head, edge):
            return False
        at = head
    return True
