"""Straight lines among robots as they drive, compiled with numba: which are free, and paths straightened by them."""

from __future__ import annotations

from d4orm_env.core.arrays import Floats, IntArray, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.spaces import Space, is_free_line
from d4orm_planners.mapf import near_neighbours
from d4orm_planners.mapf.occupancy import BLOCK, Buckets, Others, bucket_of
from d4orm_planners.mapf.roadmap import Footprints, Roadmap


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
        share, position = (step - depart) / (arrive - depart), others.positions[step, i]
        dx = tail[0] + share * (head[0] - tail[0]) - position[0]
        dy = tail[1] + share * (head[1] - tail[1]) - position[1]
        dz = tail[2] + share * (head[2] - tail[2]) - position[2]
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
def is_edge_free(others: Others, buckets: Buckets, tail: Floats, head: Floats, depart: Whole, arrive: Whole) -> bool:
    """The same of a short line."""
    for block in range((depart + 1) // BLOCK, arrive // BLOCK + 1):
        bucket = bucket_of(buckets, block, (tail[0] + head[0]) / 2, (tail[1] + head[1]) / 2)
        for number in range(buckets.first[bucket], buckets.first[bucket + 1]):
            if _meets(others, buckets.items[number], block, tail, head, depart, arrive):
                return False
    return True


@cached_kernel(variant="straighten", **OPTIONS)
def straighten(
    roadmap: Roadmap,
    bodies: Footprints,
    space: Space | None,
    others: Others,
    k: Whole,
    safety_distance: float,
    path: IntArray,
) -> int:
    """Leave out nodes of a path where the straight line is free of obstacles and of others.

    Args:
        roadmap: The roadmap.
        bodies: The robots.
        space: The world; ``None`` where there are no obstacles.
        others: Their motions.
        k: The robot.
        safety_distance: Distance that it keeps from obstacles [m].
        path: ``(n, 3)`` of :func:`~d4orm_planners.mapf.replanning.find_path`, changed in place.

    Returns:
        How many are left.
    """
    nodes, goal, arrived, count, i = roadmap.nodes, bodies.goals[k], bodies.goal_radius + bodies.slack, 1, 0
    while i + 1 < path.shape[0]:
        j = i + 1
        depart, tail = path[j, 1], nodes[path[i, 0]]
        while j + 1 < path.shape[0]:
            head = nodes[path[j + 1, 0]]
            near = near_neighbours.squared_gap(nodes, goal, nodes, path[i, 0], nodes, path[j + 1, 0])
            if bodies.docks and path[j + 1, 0] != goal and near < arrived * arrived:
                break
            # Nested, because the compiler leaves out what is never reached.
            if space is not None:  # noqa: SIM102
                if not is_free_line(space, safety_distance, tail, head):
                    break
            if not _is_line_free(others, tail, head, depart, path[j + 1, 2]):
                break
            j += 1
        path[count, 0], path[count, 1], path[count, 2] = path[j, 0], depart, path[j, 2]
        count, i = count + 1, j
    return count
