"""Which robots of an infeasible plan are replanned together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from d4orm_planners.base.candidate import Graph, components, conflicts, graph_of
from d4orm_planners.d4orm_d.decoupling import Grouping, failure_groups, independent_robots, reconnected, regrouped

MAX_ROBOTS = 7


def graph(num_robots: int, *edges: tuple[int, int]) -> Graph:
    """The graph with these edges."""
    return graph_of(num_robots, np.array(edges, int).reshape(-1, 2))


def edges(conflicts: Graph) -> list[tuple[int, int]]:
    """The edges of a graph, which must be symmetric and without loops."""
    assert all(robot in conflicts[other] for robot, others in enumerate(conflicts) for other in others)
    assert not any(robot in others for robot, others in enumerate(conflicts))
    return sorted((robot, other) for robot, others in enumerate(conflicts) for other in others if robot < other)


def first(graph: Graph) -> Grouping:
    """Groups of a first iteration with these conflicts."""
    return regrouped(graph, None)


def graphs(num_robots: int) -> st.SearchStrategy[Graph]:
    """Graphs without loops; every edge drawn on its own."""
    drawn = arrays(bool, (num_robots, num_robots))
    return drawn.map(lambda matrix: graph_of(num_robots, np.argwhere(np.triu(matrix, 1))))


def crosses(conflicts: Graph, group: Any) -> bool:
    """Whether an edge leads out of a group."""
    return any(not conflicts[robot] <= set(group) for robot in group)


@st.composite
def teams(draw: Any) -> tuple[np.ndarray, Graph, Graph]:
    """Who fails ``(K,)``, conflicts now and before; a robot in conflict now has failed."""
    num_robots = draw(st.integers(1, MAX_ROBOTS))
    now, before = draw(graphs(num_robots)), draw(graphs(num_robots))
    return draw(arrays(bool, num_robots)) | np.array([bool(others) for others in now]), now, before


def standing(*positions: tuple[float, ...], steps: int = 1) -> np.ndarray:
    """``(T+1, K, d)`` robots that stay where they are."""
    return np.repeat(np.array([positions], np.float32), steps + 1, axis=0)


# Conflicts. Two robots of radius 0.25 and a margin of 0.5 are in conflict up to a distance of 1 m.


@pytest.mark.parametrize(("distance", "expected"), [(0.0, True), (1.0, True), (1.0001, False), (50.0, False)])
def test_conflict_reaches_to_the_margin_and_includes_it(distance: float, expected: bool) -> None:
    near = conflicts(standing((0, 0), (distance, 0)), [0.25, 0.25], 0.5)
    assert edges(near) == ([(0, 1)] if expected else [])


def test_distance_in_conflicts_is_euclidean() -> None:
    assert edges(conflicts(standing((0, 0), (0.75, 0.75)), [0.25, 0.25], 0.5)) == []
    assert edges(conflicts(standing((0, 0), (0.5, 0.75)), [0.25, 0.25], 0.5)) == [(0, 1)]


def test_each_pair_has_the_sum_of_its_own_radii() -> None:
    positions = standing((0, 0), (2, 0), (4, 0))
    assert edges(conflicts(positions, [1.5, 0.25, 0.25], 0.25)) == [(0, 1)]


@pytest.mark.parametrize("step", [1, 8, 9, 40])
def test_one_step_of_contact_in_many_is_a_conflict(step: int) -> None:
    positions = standing((0, 0), (5, 0), (9, 0), steps=40)
    assert edges(conflicts(positions, [0.25] * 3, 0.5)) == []
    positions[step, 2] = [0.5, 0]
    assert edges(conflicts(positions, [0.25] * 3, 0.5)) == [(0, 2)]


def test_positions_crossed_at_different_steps_are_no_conflict() -> None:
    positions = np.array([[[0, 0], [5, 0]], [[5, 0], [0, 0]]], np.float32)
    assert edges(conflicts(positions, [0.25, 0.25], 0.5)) == []


def test_height_counts_in_space() -> None:
    assert edges(conflicts(standing((0, 0, 0), (0, 0, 1.5), (0, 0, 2)), [0.25] * 3, 0.5)) == [(1, 2)]


def test_robot_alone_is_in_conflict_with_nobody() -> None:
    assert conflicts(standing((0, 0), steps=20), [0.25], 0.5) == (frozenset(),)


def test_at_the_start_nobody_is_in_conflict() -> None:
    positions = standing((0, 0), (5, 0), steps=20)
    positions[0, 1] = 0
    assert edges(conflicts(positions, [0.25] * 2, 0.5)) == []


@given(arrays(np.float32, (20, 4, 2), elements=st.floats(-2, 2, width=32)), st.floats(0, 1, width=32))
def test_conflicts_are_what_every_distance_of_every_step_says(positions: np.ndarray, margin: float) -> None:
    radius = np.array([0.125, 0.25, 0.5, 0.0])
    position = positions[1:].astype(np.float64)
    gap2 = ((position[:, :, None] - position[:, None]) ** 2).sum(axis=3)
    reach2 = (radius[:, None] + radius + margin) ** 2
    expected = [(i, j) for i in range(4) for j in range(i + 1, 4) if (gap2[:, i, j] <= reach2[i, j]).any()]
    assert edges(conflicts(positions, radius, margin)) == expected


# Components


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ([], ((0,), (1,), (2,), (3,), (4,))),
        ([(0, 1), (1, 2), (2, 3), (3, 4)], ((0, 1, 2, 3, 4),)),
        ([(4, 2), (2, 0)], ((0, 2, 4), (1,), (3,))),
        ([(1, 3), (0, 4)], ((0, 4), (1, 3), (2,))),
        ([(0, 1), (1, 2), (2, 0)], ((0, 1, 2), (3,), (4,))),
    ],
    ids=["nobody", "chain", "through a middle robot", "two pairs", "ring"],
)
def test_components_are_who_is_linked_directly_or_through_others(links: Any, expected: Any) -> None:
    assert components(graph(5, *links)) == expected


@given(st.integers(1, MAX_ROBOTS).flatmap(graphs))
def test_components_part_the_team_and_no_link_crosses(matrix: Graph) -> None:
    groups = components(matrix)
    assert sorted(robot for group in groups for robot in group) == list(range(len(matrix)))
    assert [group[0] for group in groups] == sorted(min(group) for group in groups)
    for group in groups:
        assert not crosses(matrix, group)
        reached = {group[0]}
        for _ in group:
            reached |= {j for i in reached for j in matrix[i]}
        assert reached == set(group)


# Reconnection: what the paper's section V says of the conflicts of the previous iteration


def test_without_a_previous_iteration_the_conflicts_stay_as_they_are() -> None:
    assert edges(reconnected(graph(3, (0, 2)), None)) == [(0, 2)]


def test_robot_that_conflicts_outside_its_old_group_gets_its_free_neighbours_back() -> None:
    """0 and 1 conflicted; 0 has got out of it and into 2's way: 1 is likely to be in the way again."""
    assert edges(reconnected(graph(3, (0, 2)), first(graph(3, (0, 1))))) == [(0, 1), (0, 2)]


def test_direct_neighbours_only_are_brought_back() -> None:
    """Of the old chain 0-1-2, robot 0 conflicts with 3 now: 1 comes back and 2 does not."""
    assert edges(reconnected(graph(4, (0, 3)), first(graph(4, (0, 1), (1, 2))))) == [(0, 1), (0, 3)]


def test_neighbours_that_are_in_conflict_themselves_are_not_brought_back() -> None:
    """1 has a conflict of its own, with 4, and so a group of its own; 2 is free."""
    now, before = graph(5, (0, 3), (1, 4)), graph(5, (0, 1), (0, 2))
    assert edges(reconnected(now, first(before))) == [(0, 2), (0, 3), (1, 4)]


def test_conflict_within_the_old_group_brings_nobody_back() -> None:
    """2 is in the old group of 0, though not its neighbour then."""
    assert edges(reconnected(graph(3, (0, 2)), first(graph(3, (0, 1), (1, 2))))) == [(0, 2)]


def test_robot_that_was_in_no_conflict_brings_nobody_back() -> None:
    assert edges(reconnected(graph(4, (2, 3)), first(graph(4, (0, 1))))) == [(2, 3)]


def test_robots_of_two_old_groups_that_meet_bring_both_back() -> None:
    now, before = graph(4, (1, 2)), graph(4, (0, 1), (2, 3))
    assert edges(reconnected(now, first(before))) == [(0, 1), (1, 2), (2, 3)]


def test_whoever_was_brought_back_is_of_the_old_group() -> None:
    """1 was brought back to 0 and 2, and so has met nobody new when it meets 2."""
    earlier = regrouped(graph(3, (0, 2)), first(graph(3, (0, 1))))
    assert earlier.groups == ((0, 1, 2),)
    assert edges(reconnected(graph(3, (1, 2)), earlier)) == [(1, 2)]


@given(teams())
def test_reconnection_only_adds_old_conflicts_of_a_free_robot(team: Any) -> None:
    _, now, before = team
    joined = reconnected(now, first(before))
    added = set(edges(joined)) - set(edges(now))
    assert set(edges(now)) <= set(edges(joined))
    assert added <= set(edges(before))
    for pair in added:
        # One of the two is free now, the other is in conflict.
        assert sorted(bool(now[robot]) for robot in pair) == [False, True]


@given(teams())
def test_the_same_conflicts_again_bring_nobody_back(team: Any) -> None:
    now = team[1]
    assert reconnected(now, first(now)) == now


# Groups


def test_failure_groups_of_a_team_with_every_kind_of_robot() -> None:
    """0 and 3 conflict; 1 does not arrive; 2 and 4 succeed."""
    failed = np.array([True, True, False, True, False])
    assert failure_groups(failed, components(graph(5, (0, 3)))) == ((0, 3), (1,))


def test_successful_robot_brought_back_is_in_the_group() -> None:
    failed = np.array([True, False, True, False])
    joined = reconnected(graph(4, (0, 2)), first(graph(4, (0, 1))))
    assert failure_groups(failed, components(joined)) == ((0, 1, 2),)


def test_team_without_failure_has_no_groups() -> None:
    assert failure_groups(np.zeros(3, bool), components(graph(3))) == ()


@given(teams())
def test_every_failed_robot_is_in_one_group_and_nobody_in_two(team: Any) -> None:
    failed, now, before = team
    for matrix in (now, reconnected(now, first(before))):
        groups = failure_groups(failed, components(matrix))
        members = [robot for group in groups for robot in group]
        assert len(members) == len(set(members))
        assert set(np.flatnonzero(failed)) <= set(members)
        assert all(list(group) == sorted(group) for group in groups)
        assert all(failed[list(group)].any() for group in groups)
        for group in groups:
            assert not crosses(matrix, group)


@given(teams())
def test_before_reconnection_nobody_successful_is_in_a_group(team: Any) -> None:
    failed, now, _ = team
    groups = failure_groups(failed, components(now))
    assert {robot for group in groups for robot in group} == set(np.flatnonzero(failed))


# Independent robots


@pytest.mark.parametrize(
    ("order", "expected"),
    [([0, 1, 2, 3], (0, 2)), ([1, 0, 2, 3], (1, 3)), ([3, 2, 1, 0], (1, 3)), ([2], (2,)), ([], ())],
)
def test_order_decides_who_of_a_chain_is_taken(order: list[int], expected: tuple[int, ...]) -> None:
    assert independent_robots(order, graph(4, (0, 1), (1, 2), (2, 3))) == expected


@given(st.integers(1, MAX_ROBOTS).flatmap(lambda num: st.tuples(graphs(num), st.permutations(range(num)))), st.data())
def test_independent_robots_are_as_many_as_the_order_allows(case: Any, data: st.DataObject) -> None:
    matrix, order = case
    candidates = order[: data.draw(st.integers(0, len(order)))]
    taken = independent_robots(candidates, matrix)
    assert list(taken) == sorted(taken)
    assert set(taken) <= set(candidates)
    assert all(matrix[robot].isdisjoint(taken) for robot in taken)
    for position, robot in enumerate(candidates):
        sooner = [other for other in candidates[:position] if other in taken]
        assert (robot in taken) == matrix[robot].isdisjoint(sooner)
