"""One step of the whole team on a roadmap, compiled with numba: priority inheritance with backtracking (PIBT).

After K. Okumura, M. Machida, X. Defago and Y. Tamura, *Priority inheritance with backtracking for iterative multi-agent
path finding* (AIJ 2022). Here a step is a sequence of moves of single robots, each of which keeps clear of where all
others are at rest: a robot in another's way moves first. So no two ever exchange places or turn in a ring, robots may
have any size and nodes lie anywhere, and the sequence gives the precedence wherever paths cross.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, Floats, IntArray, Ints, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.mapf.near_neighbours import squared_gap
from d4orm_planners.mapf.roadmap import Roadmap, RobotArrays, passes_too_near

FREE, MOVING, DONE = 0, 1, 2  #: Robots not moved yet in a step; about to, once others have yielded; moved, or staying
STAY, NOTHING = -1, -2  #: In place of an edge: to stay at a node, and that no edge is left to try
IDLE, TIE = 1 / 3, 1 / 150
"""Detour that a robot rather makes than stay where it is, and one that is as good as none, in radii of the largest
robot."""


class PibtWorkspace(NamedTuple):
    """Workspace of a step."""

    state: NDArray[np.int8]  #: ``(K,)`` int8
    may_dock: BoolArray  #: ``(K,)`` bool: may come to its goal
    who: Ints  #: ``(N,)`` int32 the robot at each node; -1 for none
    robots: IntArray  #: ``(K,)`` int64 those that others yield to, the first one first
    edges: IntArray  #: ``(K,)`` int64 by which each wants to go
    tried: IntArray  #: ``(K,)`` int64 how many edges each has tried
    options: IntArray  #: ``(K, D)`` int64 the edges that each tries in turn
    worth: Floats  #: ``(D,)`` float64 how good they are
    moves: IntArray  #: ``(K, 2)`` int64 robot and edge of each move, in their order


@compiled
def _mixed(a: np.uint64, b: np.uint64) -> float:
    """A number from 0 to 1 that looks random (after splitmix64)."""
    z = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b) * np.uint64(0xD1B54A32D192ED03)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.float64((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compiled
def _rank_options(
    roadmap: Roadmap, bodies: RobotArrays, scratch: PibtWorkspace, depth: Whole, k: Whole, at: Whole,
    pushed: bool | np.bool_, seed: int,
) -> None:  # fmt: skip
    """Sort the edges that a robot may take, the best first, with staying among them unless it is pushed."""
    options, worth, count = scratch.options[depth], scratch.worth, 0
    costs = bodies.costs[k]
    for e in range(roadmap.first[at], roadmap.first[at + 1] + 1):
        if e < roadmap.first[at + 1]:
            head = np.int64(roadmap.heads[e])
            if roadmap.room[e] < bodies.safety_distance[k] or not costs[head] < np.inf:
                continue
            value, option = np.float64(costs[head]) + roadmap.lengths[e], np.int64(e)
        elif pushed:
            continue
        else:
            value, option = np.float64(costs[at]) + IDLE * bodies.size, np.int64(STAY)
        # Ties are broken at random, lest two robots go on getting into each other's way.
        value += TIE * bodies.size * _mixed(np.uint64(seed) + np.uint64(k), np.uint64(e))
        position = count
        while position > 0 and worth[position - 1] > value:
            worth[position], options[position] = worth[position - 1], options[position - 1]
            position -= 1
        worth[position], options[position] = value, option
        count += 1
    options[count] = NOTHING


@compiled
def _blocking_robot(
    roadmap: Roadmap, bodies: RobotArrays, scratch: PibtWorkspace, positions: IntArray, k: Whole, e: Whole, depth: Whole
) -> Whole:
    """The first robot that has to yield before ``k`` takes an edge; -1 for none, -2 where that cannot be."""
    nodes, head, at = roadmap.flat, np.int64(roadmap.heads[e]), positions[k]
    found: Whole = np.int64(-1)
    for number in range(roadmap.near_first[e], roadmap.near_first[e + 1]):
        u = np.int64(roadmap.near[number])
        if bodies.docks and u == bodies.goals[k] and u != at:
            if head != u and roadmap.gaps[number] < bodies.goal_radius + bodies.slack / 2:
                return -2  # It would arrive in passing.
            if head == u and not scratch.may_dock[k]:
                return -2
        i = np.int64(scratch.who[u])
        if i < 0 or i == k:
            continue
        if passes_too_near(roadmap, bodies, k, at, head, i, u, roadmap.gaps[number]):
            if scratch.state[i] != FREE:
                return -2
            if found < 0:
                found = i
    # Those who wait for this one must get past it afterwards.
    for above in range(depth):
        i, end = scratch.robots[above], np.int64(roadmap.heads[scratch.edges[above]])
        gap = np.sqrt(squared_gap(nodes, head, nodes, positions[i], nodes, end))
        if passes_too_near(roadmap, bodies, i, positions[i], end, k, head, gap):
            return -2
    return found


@compiled
def _push(
    roadmap: Roadmap, bodies: RobotArrays, scratch: PibtWorkspace, positions: IntArray, depth: Whole, k: Whole,
    seed: int,
) -> None:  # fmt: skip
    """Have a robot look for an edge, for those before it to get past unless it is the first."""
    scratch.robots[depth], scratch.edges[depth], scratch.tried[depth] = k, NOTHING, 0
    scratch.state[k] = MOVING
    _rank_options(roadmap, bodies, scratch, depth, k, positions[k], depth > 0, seed)


@compiled
def _next_edge(roadmap: Roadmap, scratch: PibtWorkspace, positions: IntArray, depth: Whole, forced: Whole) -> Whole:
    """The next edge that a robot tries; :data:`NOTHING` if it stays. The first must go to node ``forced``, if any."""
    anywhere = depth > 0 or forced < 0
    while True:
        e = scratch.options[depth, scratch.tried[depth]]
        if e == NOTHING or (e == STAY and (anywhere or forced == positions[scratch.robots[depth]])):
            return np.int64(NOTHING)
        scratch.tried[depth] += 1
        if e != STAY and (anywhere or roadmap.heads[e] == forced):
            return e


@compiled
def _move(
    roadmap: Roadmap, bodies: RobotArrays, scratch: PibtWorkspace, positions: IntArray, root: Whole, forced: Whole,
    seed: int, count: Whole,
) -> Whole:  # fmt: skip
    """Let a robot move, and before it those that are in its way; how many moves there are then.

    ``forced`` is the node that it must go to, -1 for where it likes, ``count`` the moves so far; ``positions`` is
    changed. See :func:`step_team`.
    """
    depth: Whole = np.int64(0)  # literals would compile what they are passed to once more
    _push(roadmap, bodies, scratch, positions, depth, root, seed)
    while depth >= 0:
        k, e = scratch.robots[depth], scratch.edges[depth]
        if e == NOTHING:
            e = scratch.edges[depth] = _next_edge(roadmap, scratch, positions, depth, forced)
        blocker = np.int64(-1) if e == NOTHING else _blocking_robot(roadmap, bodies, scratch, positions, k, e, depth)
        if blocker == -2:
            scratch.edges[depth] = NOTHING
        elif blocker >= 0:
            depth += 1
            _push(roadmap, bodies, scratch, positions, depth, blocker, seed)
        else:
            scratch.state[k] = DONE
            depth -= 1
            if e == NOTHING:
                if depth >= 0:
                    scratch.edges[depth] = NOTHING  # A robot that does not yield blocks this edge.
                continue
            head = np.int64(roadmap.heads[e])
            scratch.who[positions[k]], scratch.who[head], positions[k] = -1, k, head
            scratch.moves[count, 0], scratch.moves[count, 1] = k, e
            count += 1
    return count


@cached_kernel(variant="step", **OPTIONS)
def step_team(
    roadmap: Roadmap, bodies: RobotArrays, scratch: PibtWorkspace, order: IntArray, robots: IntArray, targets: IntArray,
    seed: int, positions: IntArray,
) -> Whole:  # fmt: skip
    """Let the whole team move.

    Args:
        roadmap: The roadmap.
        bodies: The robots.
        scratch: Working space; its moves are output.
        order: ``(K,)`` robots, the first one first.
        robots: ``(C,)`` robots that must go ...
        targets: ... to these nodes ``(C,)``, or stay there.
        seed: Of ties.
        positions: ``(K,)`` int64 the robots' nodes, changed in place.

    Returns:
        The number of moves; -1 where a robot could not go where it must.
    """
    count: Whole = np.int64(0)
    scratch.state[:] = FREE
    scratch.who[:] = -1
    for k in range(positions.shape[0]):
        scratch.who[positions[k]] = k
        if bodies.docks and positions[k] == bodies.goals[k]:
            scratch.state[k] = DONE
    for number in range(robots.shape[0]):
        k = robots[number]
        if positions[k] == targets[number]:
            scratch.state[k] = DONE
    for number in range(robots.shape[0]):
        k = robots[number]
        if scratch.state[k] == FREE:
            count = _move(roadmap, bodies, scratch, positions, k, targets[number], seed, count)
        if positions[k] != targets[number]:
            return -1
    for number in range(order.shape[0]):
        k = order[number]
        if scratch.state[k] == FREE:
            count = _move(roadmap, bodies, scratch, positions, k, np.int64(-1), seed, count)
    return count
