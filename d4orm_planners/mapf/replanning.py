"""A path for one robot among all others as they drive, compiled with numba: in space and time, on the roadmap."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import Floats, IntArray, Ints, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.spaces import Space, is_free_line
from d4orm_planners.mapf import near_neighbours
from d4orm_planners.mapf.occupancy import BLOCK, Buckets, Others, bucket_of, last_passage, sort_boxes
from d4orm_planners.mapf.roadmap import Footprints, Roadmap
from d4orm_planners.mapf.safe_intervals import Intervals, free_intervals, interval_at


@compiled
def _meets(others: Others, i: Whole, block: Whole, tail: Floats, head: Floats, depart: Whole, arrive: Whole) -> bool:
    """Check whether a robot that drives straight from one position to another is near robot ``i`` in a block."""
    boxes, need = others.boxes[block], others.need[i]
    if (
        need <= 0.0
        or boxes[0, i] - need > max(tail[0], head[0])
        or boxes[3, i] + need < min(tail[0], head[0])
        or boxes[1, i] - need > max(tail[1], head[1])
        or boxes[4, i] + need < min(tail[1], head[1])
        or boxes[2, i] - need > max(tail[2], head[2])
        or boxes[5, i] + need < min(tail[2], head[2])
    ):
        return False
    for step in range(max(depart + 1, block * BLOCK), min(arrive + 1, (block + 1) * BLOCK)):
        share, place = (step - depart) / (arrive - depart), others.positions[step, i]
        dx = tail[0] + share * (head[0] - tail[0]) - place[0]
        dy = tail[1] + share * (head[1] - tail[1]) - place[1]
        dz = tail[2] + share * (head[2] - tail[2]) - place[2]
        if dx * dx + dy * dy + dz * dz < need * need:
            return True
    return False


@compiled
def _is_line_free(others: Others, tail: Floats, head: Floats, depart: Whole, arrive: Whole) -> bool:
    """Check whether none is near a robot that drives straight from one position to another between two steps."""
    for block in range((depart + 1) // BLOCK, arrive // BLOCK + 1):
        for i in range(others.need.shape[0]):
            if _meets(others, i, block, tail, head, depart, arrive):
                return False
    return True


@compiled
def _is_edge_free(others: Others, buckets: Buckets, tail: Floats, head: Floats, depart: Whole, arrive: Whole) -> bool:
    """The same of a short line."""
    for block in range((depart + 1) // BLOCK, arrive // BLOCK + 1):
        bucket = bucket_of(buckets, block, (tail[0] + head[0]) / 2, (tail[1] + head[1]) / 2)
        for number in range(buckets.first[bucket], buckets.first[bucket + 1]):
            if _meets(others, buckets.items[number], block, tail, head, depart, arrive):
                return False
    return True


@cached_kernel(variant="straighten", **OPTIONS)
def straighten(
    roadmap: Roadmap, bodies: Footprints, space: Space | None, others: Others, k: Whole, reach: float, path: IntArray
) -> int:
    """Leave out nodes of a path where the straight line is free of obstacles and of others.

    Args:
        roadmap: The roadmap.
        bodies: The robots.
        space: The world; ``None`` where there are no obstacles.
        others: Their motions.
        k: The robot.
        reach: Distance that it keeps from obstacles [m].
        path: ``(n, 3)`` of :func:`find_path`, changed in place.

    Returns:
        How many are left.
    """
    nodes, goal, docked, count, i = roadmap.nodes, bodies.goals[k], bodies.docked + bodies.slack, 1, 0
    while i + 1 < path.shape[0]:
        j = i + 1
        depart, tail = path[j, 1], nodes[path[i, 0]]
        while j + 1 < path.shape[0]:
            head = nodes[path[j + 1, 0]]
            near = near_neighbours.squared_gap(nodes, goal, nodes, path[i, 0], nodes, path[j + 1, 0])
            if bodies.docks and path[j + 1, 0] != goal and near < docked * docked:
                break
            # Nested, because the compiler leaves out what is never reached.
            if space is not None:  # noqa: SIM102
                if not is_free_line(space, reach, tail, head):
                    break
            if not _is_line_free(others, tail, head, depart, path[j + 1, 2]):
                break
            j += 1
        path[count, 0], path[count, 1], path[count, 2] = path[j, 0], depart, path[j, 2]
        count, i = count + 1, j
    return count


class Trip(NamedTuple):
    """Motion that a robot is taken to make when its path is planned.

    Attributes:
        stride: Distance that it drives in a step [m].
        launch: Steps that it loses whenever it sets out.
        latest: Step by which it must have arrived.
        dwell: Steps for which it stays at its goal; negative for ever.
    """

    stride: float
    launch: Whole
    latest: int
    dwell: Whole


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
    return found


class _Search(NamedTuple):
    """The search for one robot's path.

    Attributes:
        others: Motions of the others.
        buckets: The same by where edges near to them have their middles.
        safe: The safe intervals.
        came: Entry of the tree that comes first to each of them; -1 for none.
        dock: Step until which the robot must not come to its goal for good; -1 for none.
    """

    others: Others
    buckets: Buckets
    safe: Intervals
    came: Ints
    dock: Whole


@compiled
def _departure(
    search: _Search,
    tree: IntArray,
    entry: Whole,
    head: Whole,
    steps: Whole,
    left: float,
    trip: Trip,
    dock: Whole,
    depart: Whole,
) -> tuple[Whole, Whole, Whole]:
    """The next departure from an entry of the tree that comes to a safe interval before all others.

    Args:
        search: The search.
        tree: Nodes, departures, arrivals, entries before and intervals.
        entry: The entry.
        head: Node to drive to.
        steps: Steps that it takes.
        left: Steps from there to the goal, at least.
        trip: The motion; the dwell of goals only.
        dock: Step until which it must not arrive.
        depart: Earliest departure.

    Returns:
        Departure, arrival and interval, or -1 for the interval if there is none.
    """
    safe = search.safe
    while depart < safe.ends[tree[entry, 4]]:
        lost = trip.launch if depart > tree[entry, 2] or tree[entry, 3] < 0 else 0
        until = depart + steps + lost
        if until + left > trip.latest:
            break
        there = interval_at(safe, head, until)
        if there == safe.first[head + 1]:
            break
        before = search.came[there]
        if safe.begins[there] > until:
            depart += safe.begins[there] - until
        elif before >= 0 and tree[before, 2] <= until:
            depart += safe.ends[there] - until
        elif until <= dock:
            depart += 1
        elif safe.ends[there] < min(until + trip.dwell, trip.latest):
            depart += 1 + safe.ends[there] - until
        else:
            return depart, until, np.int64(there)
    return depart, depart, np.int64(-1)


@register_jitable(nogil=True, **OPTIONS)
def _follow_edge(
    search: _Search,
    roadmap: Roadmap,
    e: Whole,
    left: float,
    trip: Trip,
    dock: Whole,
    tree: IntArray,
    entry: Whole,
    used: int,
    heap: list[tuple[float, np.int64]],
) -> tuple[IntArray, int]:
    """Enter whatever is come to from an entry by an edge, see :func:`_departure`; the tree, and its entries in use."""
    nodes, node, head, depart = roadmap.nodes, tree[entry, 0], np.int64(roadmap.heads[e]), tree[entry, 2]
    steps, failures = np.int64(np.ceil(roadmap.lengths[e] / trip.stride)), 0
    while True:
        depart, until, there = _departure(search, tree, entry, head, steps, left, trip, dock, depart)
        if there < 0:
            return tree, used
        if not _is_edge_free(search.others, search.buckets, nodes[node], nodes[head], depart, until):
            # Whoever stands in the way often does so for long.
            failures += 1
            depart += 1 + failures // 4
            continue
        if used == tree.shape[0]:
            tree = np.concatenate((tree, np.empty((used, 5), np.int64)))
        tree[used, 0], tree[used, 1], tree[used, 2] = head, depart, until
        tree[used, 3], tree[used, 4], search.came[there] = entry, there, used
        heapq.heappush(heap, (until + left, np.int64(used)))
        used, depart = used + 1, depart + 1


@compiled
def _is_way(roadmap: Roadmap, bodies: Footprints, k: Whole, node: Whole, e: Whole) -> bool:
    """Check whether a robot can take an edge from a node: it fits, leads to the goal, and does not dock in passing."""
    nodes, head, goal = roadmap.nodes, np.int64(roadmap.heads[e]), bodies.goals[k]
    if roadmap.room[e] < bodies.reach[k] or not bodies.costs[k, head] < np.inf:
        return False
    aside = (bodies.docked + bodies.slack / 2) ** 2
    docks = bodies.docks and head != goal
    return not (docks and near_neighbours.squared_gap(nodes, goal, nodes, node, nodes, head) < aside)


@register_jitable(nogil=True, **OPTIONS)
def _begin(roadmap: Roadmap, bodies: Footprints, others: Others, k: Whole, trip: Trip) -> _Search:
    goal = roadmap.nodes[bodies.goals[k]]
    # Nobody may come near its goal once it stands there for good.
    dock = np.int64(-1) if trip.dwell >= 0 else last_passage(others, goal, np.empty(len(others.need) + 1, np.int64))
    buckets = sort_boxes(others, roadmap.nodes, roadmap.lengths.max() / 2, trip.latest // BLOCK + 1)
    safe = free_intervals(others, roadmap.starts[k], roadmap.nodes.shape[0], trip.latest + 1)
    return _Search(others, buckets, safe, np.full(safe.begins.shape[0], -1, np.int32), dock)


@cached_kernel(variant="path", **OPTIONS)
def find_path(roadmap: Roadmap, bodies: Footprints, others: Others, k: Whole, trip: Trip) -> IntArray:
    """The soonest path of a robot to its goal among all others: safe interval path planning.

    After M. Phillips and M. Likhachev, *SIPP: safe interval path planning for dynamic environments* (ICRA 2011).

    Args:
        roadmap: The roadmap.
        bodies: The robots.
        others: Their motions, no shorter than it may take.
        k: The robot.
        trip: Its motion.

    Returns:
        ``(n, 3)`` int64 nodes, the steps at which it sets out for each and comes to each; none where there is no path.
    """
    goal, start, costs = bodies.goals[k], np.int64(roadmap.starts[k]), bodies.costs[k]
    search, passing = (
        _begin(roadmap, bodies, others, k, trip),
        Trip(trip.stride, trip.launch, trip.latest, np.int64(-1)),
    )
    tree, used = np.empty((1024, 5), np.int64), 1
    tree[0, 0], tree[0, 1], tree[0, 2], tree[0, 3], tree[0, 4] = start, 0, 0, -1, search.safe.first[start]
    search.came[search.safe.first[start]] = 0
    heap = [(float(costs[start]) / trip.stride, np.int64(0))]
    while len(heap) > 0:
        _, entry = heapq.heappop(heap)
        node = tree[entry, 0]
        if search.came[tree[entry, 4]] != entry:
            continue
        if node == goal and tree[entry, 2] > search.dock:
            return _followed_back(tree, entry)
        if node == goal and bodies.docks:
            continue
        for e in range(roadmap.first[node], roadmap.first[node + 1]):
            if _is_way(roadmap, bodies, k, node, e):
                head = np.int64(roadmap.heads[e])
                motion = trip if head == goal else passing
                dock, left = search.dock if head == goal and bodies.docks else np.int64(-1), costs[head] / trip.stride
                tree, used = _follow_edge(search, roadmap, e, left, motion, dock, tree, entry, used, heap)
    return np.empty((0, 3), np.int64)
