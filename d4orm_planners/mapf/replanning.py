"""A path for one robot among all others as they drive, compiled with numba: in space and time, on the roadmap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import register_jitable

from d4orm_env.core.arrays import Floats, IntArray, Ints, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined
from d4orm_planners.mapf.beam import sink
from d4orm_planners.mapf.near_neighbours import squared_gap
from d4orm_planners.mapf.reservations import (
    Intervals,
    Reservations,
    Trip,
    first_meeting,
    interval_at,
    meeting,
    steps_to_turn,
    straighten,
)
from d4orm_planners.mapf.roadmap import Roadmap, RobotArrays
from d4orm_planners.tracking.timed_path import timed_kernel


@register_jitable(nogil=True, **OPTIONS)
def _followed_back(tree: IntArray, entry: Whole) -> IntArray:
    """``(n, 3)`` the path that ends with an entry."""
    count, walk = 0, entry
    while walk >= 0:
        count, walk = count + 1, tree[walk, 3]
    found, walk = np.empty((count, 3), np.int64), entry
    while walk >= 0:
        count -= 1
        found[count, 0], found[count, 1], found[count, 2] = tree[walk, 0], tree[walk, 1], tree[walk, 2]
        walk = tree[walk, 3]
    found[0, 2] = 0  # there it is from the first step, whenever it sets out
    return found


class _Tree(NamedTuple):
    """Entries of a search so far, with room for more."""

    entries: IntArray  #: ``(N, 5)`` int64 nodes, departures for them, arrivals, previous entries, intervals
    costs: Floats  #: ``(N,)`` steps from the start through each to the goal, at least
    heap: IntArray  #: ``(N,)`` int64 numbers of those that nothing has been tried from, the soonest at the goal first
    sizes: IntArray  #: ``(2,)`` int64 how many there are of both


class _Search(NamedTuple):
    """The search for one robot's path."""

    reservations: Reservations  #: All others
    came: Ints  #: Entry of the tree that comes first to each safe interval; -1 for none
    soonest: Whole  #: No step before it can be that at which the robot comes to its goal for good


@compiled
def _departure(
    search: _Search, tree: IntArray, entry: Whole, head: Whole, steps: Whole, left: float, trip: Trip, dock: Whole,
    depart: Whole, turn: Whole, arrival: Whole,
) -> tuple[Whole, Whole, Whole]:  # fmt: skip
    """The next departure from an entry of the tree that comes to a safe interval before all others, its arrival and the
    interval, -1 if there is none.

    The robot drives to node ``head`` in some ``steps``, from which on it takes at least the ``left`` ones to the goal.
    It departs at ``depart`` or later, loses the steps of a ``turn`` before it drives, and comes to safe interval
    ``arrival`` of the node or a later one, after step ``dock``.
    """
    safe = search.reservations.safe
    # At its start a robot may turn even where it is too near to somebody to stay.
    while depart + (turn if tree[entry, 3] >= 0 else 0) < safe.ends[tree[entry, 4]]:
        lost = trip.launch if depart > tree[entry, 2] or tree[entry, 3] < 0 else 0
        until = depart + turn + steps + lost
        if until + left > trip.latest:
            break
        while arrival < safe.first[head + 1] and safe.ends[arrival] <= until:
            arrival += 1
        if arrival == safe.first[head + 1]:
            break
        before = search.came[arrival]
        if safe.begins[arrival] > until:
            depart += safe.begins[arrival] - until
        elif before >= 0 and tree[before, 2] <= until:
            depart += safe.ends[arrival] - until
        elif until <= dock:
            depart = max(depart, dock - turn - steps - trip.launch) + 1
        elif safe.ends[arrival] < min(until + trip.dwell, trip.latest):
            depart += 1 + safe.ends[arrival] - until
        else:
            return depart, until, np.int64(arrival)
    return depart, depart, np.int64(-1)


@compiled
def _add_entry(
    tree: _Tree, head: Whole, depart: Whole, until: Whole, entry: Whole, arrival: Whole, cost: float
) -> None:
    entries, heap, number, slot = tree.entries, tree.heap, tree.sizes[0], tree.sizes[1]
    entries[number, 0], entries[number, 1], entries[number, 2] = head, depart, until
    entries[number, 3], entries[number, 4], tree.costs[number] = entry, arrival, cost
    # It has the highest number, so it rises above what costs more only.
    while slot > 0 and tree.costs[heap[(slot - 1) // 2]] > cost:
        heap[slot], slot = heap[(slot - 1) // 2], (slot - 1) // 2
    heap[slot] = number
    tree.sizes[0], tree.sizes[1] = number + 1, tree.sizes[1] + 1


@inlined
def _follow_edge(
    search: _Search, roadmap: Roadmap, e: Whole, left: float, trip: Trip, dock: Whole, tree: _Tree, entry: Whole
) -> None:
    """Enter whatever is come to from an entry by an edge, see :func:`_departure`."""
    reservations, entries, head, failures = search.reservations, tree.entries, np.int64(roadmap.heads[e]), 0
    node, depart, above = entries[entry, 0], entries[entry, 2], entries[entry, 3]
    tail, to = roadmap.flat[node], roadmap.flat[head]
    steps = np.int64(np.ceil(roadmap.lengths[e] / trip.stride))
    turn = steps_to_turn(roadmap.nodes, trip, entries[above, 0] if above >= 0 else above, node, head)
    arrival = interval_at(reservations.safe, head, depart + turn + steps)
    robot: Whole = np.int64(-1)
    met: Whole = np.int64(0)
    while True:
        depart, until, arrival = _departure(
            search, entries, entry, head, steps, left, trip, dock, depart, turn, arrival
        )
        if arrival < 0:
            return
        first = depart + turn
        # Whoever stands in the way often does so for long, and where it was met before.
        if robot < 0 or meeting(reservations.others, robot, tail, to, first, until, first + met, first + met + 1) < 0:
            robot, met = first_meeting(reservations.others, reservations.buckets, tail, to, first, until)
            met -= first
        if robot >= 0:
            failures += 1
            depart += 1 + failures // 4
            continue
        search.came[arrival] = tree.sizes[0]
        _add_entry(tree, head, depart, until, entry, arrival, until + left)
        depart += 1


@compiled
def _is_way(roadmap: Roadmap, bodies: RobotArrays, k: Whole, node: Whole, e: Whole) -> bool:
    """Check whether a robot can take an edge from a node: it fits, can go on to its goal, and does not pass that."""
    nodes, head, goal = roadmap.nodes, np.int64(roadmap.heads[e]), bodies.goals[k]
    if roadmap.room[e] < bodies.safety_distance[k] or not bodies.costs[k, head] < np.inf:
        return False
    aside = (bodies.goal_radius + bodies.slack / 2) ** 2
    docks = bodies.docks and head != goal
    return not (docks and squared_gap(nodes, goal, nodes, node, nodes, head) < aside)


@compiled
def _soonest(roadmap: Roadmap, bodies: RobotArrays, reservations: Reservations, k: Whole, trip: Trip) -> Whole:
    """The first step at which some edge to the goal is free for a robot that comes to stay; none if beyond the last."""
    others, buckets, goal, until = reservations.others, reservations.buckets, bodies.goals[k], reservations.dock + 1
    while until <= trip.latest:
        for e in range(roadmap.first[goal], roadmap.first[goal + 1]):
            tail, head = roadmap.flat[np.int64(roadmap.heads[e])], roadmap.flat[goal]
            steps = np.int64(np.ceil(roadmap.lengths[e] / trip.stride))
            for depart in (until - steps, until - steps - trip.launch):
                if depart >= 0 and first_meeting(others, buckets, tail, head, depart, until)[0] < 0:
                    return until
        until += 1
    return until


@compiled
def _room_needed(roadmap: Roadmap, safe: Intervals, node: Whole) -> Whole:
    """Entries that may be made from one at a node, at most: one for every interval of every neighbour."""
    most = np.int64(0)
    for e in range(roadmap.first[node], roadmap.first[node + 1]):
        head = np.int64(roadmap.heads[e])
        most += safe.first[head + 1] - safe.first[head]
    return most


@compiled
def _grow(roadmap: Roadmap, bodies: RobotArrays, search: _Search, k: Whole, trip: Trip, tree: _Tree) -> Whole:
    """Search until an entry is at the goal for good, which is returned; -1 if there is none, -2 if room is short."""
    goal, costs = bodies.goals[k], bodies.costs[k]
    passing = Trip(trip.stride, trip.launch, trip.latest, np.int64(-1), trip.turn, trip.facing, trip.release)
    root, entries, heap, sizes = np.int64(0), tree.entries, tree.heap, tree.sizes
    while sizes[1] > 0:
        entry = heap[0]
        node = entries[entry, 0]
        if sizes[0] + _room_needed(roadmap, search.reservations.safe, node) > entries.shape[0]:
            return np.int64(-2)
        sizes[1] -= 1
        heap[0] = heap[sizes[1]]
        sink(tree.costs, heap, root, sizes[1])
        if search.came[entries[entry, 4]] != entry:
            continue
        if node == goal and entries[entry, 2] > search.reservations.dock:
            return entry
        if node == goal and bodies.docks:
            continue
        for e in range(roadmap.first[node], roadmap.first[node + 1]):
            if _is_way(roadmap, bodies, k, node, e):
                head = np.int64(roadmap.heads[e])
                motion = trip if head == goal else passing
                dock = search.reservations.dock if head == goal and bodies.docks else np.int64(-1)
                left = costs[head] / trip.stride
                _follow_edge(search, roadmap, e, left, motion, dock, tree, entry)
                if head == goal:
                    last = np.int64(search.came[search.reservations.safe.first[goal + 1] - 1])
                    if last >= 0 and entries[last, 2] == search.soonest:
                        return last
    return np.int64(-1)


@register_jitable(nogil=True, **OPTIONS)
def _with_room(tree: _Tree, room: Whole) -> _Tree:
    entries, costs = np.concatenate((tree.entries, np.empty((room, 5), np.int64))), np.empty(room)
    return _Tree(
        entries, np.concatenate((tree.costs, costs)), np.concatenate((tree.heap, np.empty(room, np.int64))), tree.sizes
    )


@cached_kernel(variant="path", **OPTIONS)
def find_path(roadmap: Roadmap, bodies: RobotArrays, reservations: Reservations, k: Whole, trip: Trip) -> IntArray:
    """The soonest path of a robot to its goal among all others: safe interval path planning.

    After M. Phillips and M. Likhachev, *SIPP: safe interval path planning for dynamic environments* (ICRA 2011).

    Args:
        roadmap: The roadmap.
        bodies: The robots.
        reservations: All others, for as long as it may take.
        k: The robot.
        trip: Its motion.

    Returns:
        ``(n, 3)`` int64 nodes, the steps at which it sets out for each and comes to each; none where there is no path.
    """
    start, soonest = np.int64(roadmap.starts[k]), _soonest(roadmap, bodies, reservations, k, trip)
    if soonest > trip.latest and start != bodies.goals[k]:
        return np.empty((0, 3), np.int64)
    search = _Search(reservations, np.full(reservations.safe.begins.shape[0], -1, np.int32), soonest)
    tree = _Tree(np.empty((1024, 5), np.int64), np.empty(1024), np.empty(1024, np.int64), np.zeros(2, np.int64))
    zero = np.int64(0)  # a literal would compile what it is passed to once more
    interval = reservations.safe.first[start]
    search.came[interval] = 0
    left = float(bodies.costs[k, start]) / trip.stride
    _add_entry(tree, start, zero, trip.release, zero - 1, interval, trip.release + left)
    while True:
        entry = _grow(roadmap, bodies, search, k, trip, tree)
        if entry >= 0:
            return _followed_back(tree.entries, entry)
        if entry == -1:
            return np.empty((0, 3), np.int64)
        tree = _with_room(tree, len(tree.costs))


def is_compiled(problem: Problem) -> bool:
    """Check whether all that a team like this in a world like this needs has been compiled in this process."""
    open_world = not problem.world.num_obstacles
    return all(timed_kernel(model).signatures for model in set(problem.team.models)) and any(
        (signature[2] is types.none) == open_world for signature in straighten.signatures
    )
