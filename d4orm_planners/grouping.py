"""Which robots of an infeasible plan to replan together (paper, section V, failure-aware grouping): pure functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray

Groups = tuple[tuple[int, ...], ...]


def conflicts(positions: FloatArray, radius: ArrayLike, margin: float) -> BoolArray:
    """Which robots come within the margin of each other at any step.

    Args:
        positions: ``(T, K, d)`` [m].
        radius: ``(K,)`` [m].
        margin: [m].

    Returns:
        ``(K, K)`` symmetric, false on the diagonal.
    """
    num_robots = positions.shape[1]
    radii = np.asarray(radius, np.float64)
    reach2 = (radii[:, None] + radii[None, :] + margin) ** 2
    near = np.zeros((num_robots, num_robots), bool)
    # Axis by axis and a few steps at a time, so that nothing of size T * K * K * d is ever held.
    for first in range(0, len(positions), 16):
        places = positions[first : first + 16].astype(np.float64)
        gap2 = sum((places[:, :, None, axis] - places[:, None, :, axis]) ** 2 for axis in range(places.shape[2]))
        near |= (gap2 <= reach2).any(axis=0)
    np.fill_diagonal(near, False)
    return near


def reconnected(graph: BoolArray, previous: BoolArray | None) -> BoolArray:
    """The graph of conflicts with those of the previous iteration added that are likely to come back.

    A robot of a previous group that now conflicts with a robot outside that group is joined again to those of its
    previous direct neighbours that are free of conflicts now.

    Args:
        graph: ``(K, K)`` conflicts now.
        previous: ``(K, K)`` conflicts in the previous iteration, or ``None``.
    """
    if previous is None:
        return graph
    joined = graph.copy()
    group_of = np.full(len(graph), -1)
    for number, group in enumerate(components(previous)):
        group_of[list(group)] = number
    free = ~graph.any(axis=1)
    for robot in np.flatnonzero(previous.any(axis=1)):
        if (graph[robot] & (group_of != group_of[robot])).any():
            neighbours = previous[robot] & free
            joined[robot] |= neighbours
            joined[:, robot] |= neighbours
    return joined


def components(graph: BoolArray) -> Groups:
    """Connected components of a symmetric ``(K, K)`` graph, singletons included, in order of their first members."""
    unseen = np.ones(len(graph), bool)
    groups = []
    for first in range(len(graph)):
        if not unseen[first]:
            continue
        members, frontier = np.zeros(len(graph), bool), np.zeros(len(graph), bool)
        frontier[first] = True
        while frontier.any():
            members |= frontier
            frontier = graph[frontier].any(axis=0) & ~members
        unseen &= ~members
        groups.append(tuple(int(robot) for robot in np.flatnonzero(members)))
    return tuple(groups)


def failure_groups(failed: BoolArray, graph: BoolArray) -> Groups:
    """Groups to replan: the components of the graph that hold a failed robot.

    Args:
        failed: ``(K,)`` robots that do not arrive, or violate the margin to anything.
        graph: ``(K, K)`` conflicts, after :func:`reconnected`.

    Returns:
        Disjoint groups of robots, each in ascending order. A robot that fails without conflict is a group of its own.
    """
    return tuple(group for group in components(graph) if failed[list(group)].any())


def independent_robots(candidates: Sequence[int], graph: BoolArray) -> tuple[int, ...]:
    """Those of the candidates, taken in order, that conflict with none taken before; sorted.

    Args:
        candidates: Robots, the most wanted first.
        graph: ``(K, K)`` conflicts.
    """
    taken: list[int] = []
    for robot in candidates:
        if not graph[robot, taken].any():
            taken.append(int(robot))
    return tuple(sorted(taken))
