"""Groups of robots of an infeasible plan to replan together (paper, section V, failure-aware grouping)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.lazy import LazyModule

if TYPE_CHECKING:
    from d4orm_planners.engine import path_index
else:
    path_index = LazyModule("d4orm_planners.engine.path_index")

Graph: TypeAlias = tuple[frozenset[int], ...]
"""The robots that each robot is in conflict with."""

Groups = tuple[tuple[int, ...], ...]


class Grouping(NamedTuple):
    """A team's groups, and the conflicts that they come from."""

    graph: Graph  #: The conflicts
    groups: Groups  #: Components of the graph after :func:`reconnected`, singletons included


def conflicts(positions: FloatArray, radius: ArrayLike, margin: float) -> Graph:
    """Find the robots that come within the margin of each other at any step after the start.

    Of ``positions`` ``(H+1, K, d)`` and ``radius`` ``(K,)``, all in metres.
    """
    return graph_of(positions.shape[1], path_index.PathIndex(positions, radius, margin).pairs())


def graph_of(num_robots: int, pairs: IntArray) -> Graph:
    """The graph of conflicts between pairs ``(P, 2)``."""
    neighbours: list[set[int]] = [set() for _ in range(num_robots)]
    for first, second in pairs.tolist():
        neighbours[first].add(second)
        neighbours[second].add(first)
    return tuple(map(frozenset, neighbours))


def regrouped(graph: Graph, previous: Grouping | None) -> Grouping:
    """The groups of a graph of conflicts that follows a previous one."""
    return Grouping(graph, components(reconnected(graph, previous)))


def reconnected(graph: Graph, previous: Grouping | None) -> Graph:
    """The graph of conflicts with those of the previous iteration added that are likely to come back.

    A robot of a previous group that now conflicts with a robot outside that group is joined again to those of its
    previous direct neighbours that are free of conflicts now.
    """
    if previous is None:
        return graph
    joined = [set(neighbours) for neighbours in graph]
    for group in previous.groups:
        for robot in group if len(group) > 1 else ():
            if not graph[robot] <= set(group):
                for other in previous.graph[robot]:
                    if not graph[other]:
                        joined[robot].add(other)
                        joined[other].add(robot)
    return tuple(map(frozenset, joined))


def components(graph: Graph) -> Groups:
    """Connected components, singletons included, in order of their first members."""
    seen: set[int] = set()
    groups = []
    for first in range(len(graph)):
        if first in seen:
            continue
        members, frontier = {first}, {first}
        while frontier:
            frontier = set().union(*(graph[robot] for robot in frontier)) - members
            members |= frontier
        seen |= members
        groups.append(tuple(sorted(members)))
    return tuple(groups)


def failure_groups(failed: BoolArray, groups: Groups) -> Groups:
    """Groups to replan: those, of all with singletons included, that hold a robot that failed ``(K,)``."""
    return tuple(group for group in groups if failed[list(group)].any())


def independent_robots(candidates: Iterable[int], graph: Graph) -> tuple[int, ...]:
    """Candidates, taken in order, that conflict with none taken before; sorted."""
    taken: set[int] = set()
    for robot in candidates:
        if taken.isdisjoint(graph[robot]):
            taken.add(int(robot))
    return tuple(sorted(taken))
