"""Scenarios with walls: everybody has a path that keeps clear of all who stand, at starts and at goals."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import pytest
from env_support import WALLED, needed, slow

from d4orm_env import Problem, verify
from d4orm_env.scenarios import make_problem


def lattice_step(problem: Problem) -> float:
    """A fraction of the step of the lattice on which the places were drawn, so that its paths are found again [m]."""
    radius = float(np.max(problem.team.radius))
    return 0.3 / 8 if problem.name == "map" else (2 * radius + problem.margin) / 8


def blocked_by(problem: Problem, points: Any, robot: int, standing: Any, clear: float) -> Any:
    """Which of ``(..., d)`` points bring a robot too near to obstacles, bounds or those that stand there."""
    radius = float(np.asarray(problem.team.radius)[robot])
    found = problem.world.clearance(points) < radius + problem.margin + clear
    for position in standing:
        found |= np.linalg.norm(points - position, axis=-1) < 2 * radius + problem.margin + clear
    return found


def lattice_path(problem: Problem, robot: int, standing: Any, clear: float) -> list[Any]:
    """Lattice points from a robot's start to its goal, each beside the one before, by breadth-first search."""
    low, high = problem.world.bounds.astype(np.float64)
    step = lattice_step(problem)
    shape = tuple(((high - low) / step + 1).astype(int))
    points = low + step * np.moveaxis(np.indices(shape), 0, -1)
    blocked = blocked_by(problem, points, robot, standing, clear)
    start, goal = (
        tuple(np.unravel_index(np.argmin(np.where(blocked, np.inf, np.linalg.norm(points - position, axis=-1))), shape))
        for position in (problem.start[robot, : problem.dimension], problem.goal[robot])
    )
    before: dict[Any, Any] = {start: start}
    queue = deque([start])
    while queue and goal not in before:
        node = queue.popleft()
        for axis in range(problem.dimension):
            for side in (-1, 1):
                near = (*node[:axis], node[axis] + side, *node[axis + 1 :])
                if near not in before and 0 <= near[axis] < shape[axis] and not blocked[near]:
                    before[near] = node
                    queue.append(near)
    assert goal in before, f"robot_{robot} has no path"
    nodes = [goal]
    while nodes[-1] != start:
        nodes.append(before[nodes[-1]])
    return [points[node] for node in reversed(nodes)]


def ways_past_everybody(problem: Problem) -> list[list[Any]]:
    """The path of each robot clear of all other starts and goals, and of all places where others may dock."""
    positions = np.concatenate([problem.start[:, : problem.dimension], problem.goal]).astype(np.float64)
    around = problem.goal_radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    paths = []
    for robot in range(problem.num_robots):
        others = np.delete(positions, [robot, problem.num_robots + robot], axis=0)
        paths.append(lattice_path(problem, robot, (others[:, None] + around).reshape(-1, 2), clear=5e-4))
    return paths


def one_after_another(problem: Problem, order: Any) -> tuple[Problem, Any]:
    """Controls of velocity2d robots that drive alone, each in its turn, and the problem with the time that takes."""
    positions = np.asarray(problem.start, np.float64)
    turns = []
    for robot in order:
        driven = lattice_path(problem, robot, np.delete(positions, robot, axis=0), clear=5e-3)
        path = np.array([problem.start[robot], *driven, problem.goal[robot]])
        moves = np.diff(path, axis=0)
        parts = np.maximum(np.ceil(np.linalg.norm(moves, axis=1) / (0.9 * problem.dt)), 1).astype(int)
        turn = np.zeros((parts.sum(), problem.num_robots, 2), np.float32)
        turn[:, robot] = np.repeat(moves / parts[:, None], parts, axis=0) / problem.dt
        turns.append(turn)
        path = positions[robot] + np.cumsum(turn[:, robot], axis=0) * problem.dt
        # There it docks, and executes no more of its controls.
        positions[robot] = path[np.argmax(np.linalg.norm(path - problem.goal[robot], axis=1) < problem.goal_radius)]
    controls = np.concatenate(turns)
    return problem.replace(horizon=len(controls)), controls


@pytest.mark.parametrize("name", WALLED)
@pytest.mark.parametrize("seed", [0, slow(1)])
def test_one_after_another_everybody_arrives_in_any_order(name: str, seed: int) -> None:
    problem = make_problem(name, 4, seed, model="velocity2d", **needed(name))
    order = np.random.default_rng(seed).permutation(4)
    longer, controls = one_after_another(problem, order)
    report = verify(longer, controls)
    assert report.ok, report.violations[:3]


@pytest.mark.parametrize("name", WALLED)
@pytest.mark.parametrize(("num_robots", "settings"), [(20, {}), (8, {"num_obstacles": 2}), (8, {"radius": 0.2})])
@pytest.mark.slow
def test_every_robot_gets_by_all_others_wherever_they_stand(
    name: str, num_robots: int, settings: dict[str, Any]
) -> None:
    problem = make_problem(name, num_robots, 7, **settings, **needed(name))
    assert len(ways_past_everybody(problem)) == num_robots


@pytest.mark.parametrize("corridor_width", [0.5, 0.7])
def test_in_a_narrow_maze_robots_stand_in_dead_ends(corridor_width: float) -> None:
    problem = make_problem("maze", 6, 1, corridor_width=corridor_width)
    assert len(ways_past_everybody(problem)) == 6


@pytest.mark.parametrize("name", ["corridor", "doorway"])
@pytest.mark.parametrize("num_robots", [1, 5, 8])
def test_teams_exchange_rooms(name: str, num_robots: int) -> None:
    problem = make_problem(name, num_robots)
    from_left = np.arange(num_robots) < (num_robots + 1) // 2
    assert ((problem.start[:, 0] < 0) == from_left).all()
    assert ((problem.goal[:, 0] > 0) == from_left).all()


def test_a_robot_in_a_bay_lets_another_pass() -> None:
    problem = make_problem("corridor", 2, bays=1)
    apart = 2 * 0.15 + problem.margin
    assert problem.world.clearance([0, 0.3 + 0.6 - 0.21]) > 0.2  # in the bay, above the axis
    assert problem.world.clearance([0, -0.09]) > 0.2  # on the other side of the corridor
    assert apart < 0.3 + 0.6 - 0.21 + 0.09
    assert problem.world.clearance([1.5, 0.0]) == pytest.approx(0.3)


def test_a_maze_without_loops_has_one_way_between_any_two_cells() -> None:
    problem = make_problem("maze", 2, cells=(6, 4), corridor_width=1.0, loops=0.0)
    between = [((x + 1) * 1.1 - 0.05, y * 1.1 + 0.5) for x in range(5) for y in range(4)]
    between += [(x * 1.1 + 0.5, (y + 1) * 1.1 - 0.05) for x in range(6) for y in range(3)]
    low = problem.world.bounds[0].astype(np.float64)
    is_open = problem.world.clearance(low + np.array(between)) > 0
    assert is_open.sum() == 6 * 4 - 1
    assert make_problem("maze", 2, cells=(6, 4), loops=1.0).world.num_obstacles == 0


def test_rooms_have_as_many_doors_as_asked_for() -> None:
    # Three by two rooms have seven walls between them, of which a tree opens five.
    for share, doors in ((0, 5), (0.5, 6), (1, 7)):
        world = make_problem("rooms", 2, rooms=(3, 2), room_size=2.0, extra_doors=share).world
        length = 2 * 4.1 + 6.2 - 0.8 * doors
        areas = np.prod(world.boxes[:, 2:] - world.boxes[:, :2], axis=1)
        assert areas.sum() / 0.1 == pytest.approx(length, abs=1e-3)


def test_a_warehouse_has_its_shelves() -> None:
    world = make_problem("warehouse", 3, shelves=(3, 4), shelf_length=2.0, shelf_width=0.5, aisle_width=1.0).world
    assert len(world.boxes) == 12
    np.testing.assert_allclose(world.boxes[:, 2:] - world.boxes[:, :2], [[2.0, 0.5]] * 12, atol=1e-6)
    np.testing.assert_allclose(world.upper - world.lower, [3 * 3 + 1, 4 * 1.5 + 1], atol=1e-6)


def test_a_forest_has_its_trees() -> None:
    assert len(make_problem("forest", 3, size=6, density=0.5, obstacle_radius=0.1).world.circles) == 18
    spatial = make_problem("forest", 3, model="holonomic3d", size=4, density=0.5).world
    assert spatial.cylinders.shape == (8, 3)
    assert spatial.bounds.tolist() == [[-2] * 3, [2] * 3]


@pytest.mark.parametrize("name", [name for name in WALLED if name != "map"])
def test_the_seed_changes_neither_size_nor_horizon(name: str) -> None:
    problems = [make_problem(name, 5, seed) for seed in range(6)]
    assert len({(problem.horizon, *problem.world.bounds.ravel().tolist()) for problem in problems}) == 1
    assert len({problem.start.tobytes() for problem in problems}) == 6


BAD = [
    ("rooms", {"rooms": 3}, "rooms must be two whole numbers, columns and rows, not 3"),
    ("rooms", {"rooms": (0, 3)}, "rooms is 0; it must be at least 1"),
    ("rooms", {"rooms": (1000, 1000)}, "rooms is 1000 x 1000; scenarios make at most 10000 in all"),
    ("rooms", {"door_width": 3}, "door_width is 3; it must be at most the room_size, which is 2.5"),
    ("rooms", {"door_width": 0.3}, "do not fit through a door_width of 0.3 m; use door_width=0.45"),
    ("rooms", {"extra_doors": 1.5}, "extra_doors is 1.5; it must be at most 1"),
    ("rooms", {"rooms": (1, 1), "num_robots": 30}, "starts and goals .* use fewer robots, more rooms or a larger"),
    ("rooms", {"model": "holonomic3d"}, "is planar and model 'holonomic3d' is not; use model='holonomic2d'"),
    ("maze", {"corridor_width": 0.4}, "do not fit through a corridor_width of 0.4 m; use corridor_width="),
    ("maze", {"loops": -1}, "loops is -1"),
    ("maze", {"cells": (2, 2), "corridor_width": 0.5}, "use fewer robots, more cells or a larger corridor_width"),
    ("warehouse", {"aisle_width": 0.4}, "use aisle_width="),
    ("warehouse", {"shelf_length": 0}, "shelf_length is 0"),
    ("forest", {"density": 1e6}, "trees in a size of 8; scenarios make at most 10000"),
    ("forest", {"density": 30}, "use fewer robots, a larger size or a lower density"),
    ("forest", {"radius": 5}, "use fewer robots, a larger size or a lower density"),
    ("corridor", {"bays": 9}, "9 bays do not fit along a length of 4; use length="),
    ("corridor", {"bays": -1}, "bays is -1"),
    ("corridor", {"room_size": 1}, "room_size is 1; a corridor_width of 0.6 with its bays needs 1.8"),
    ("doorway", {"door_width": 0.2}, "use door_width=0.45"),
    ("doorway", {"room_size": 1}, "use fewer robots, a larger room_size"),
]


@pytest.mark.parametrize(("name", "arguments", "message"), BAD)
def test_bad_arguments_are_named(name: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        make_problem(name, **arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [name for name in WALLED if name != "map"])
def test_tiny_and_huge_robots_are_placed_or_refused(name: str) -> None:
    assert make_problem(name, 3, radius=0.001, margin=0.0).num_robots == 3
    with pytest.raises(ValueError, match="fit"):
        make_problem(name, 3, radius=50)


def test_the_horizon_suits_the_way() -> None:
    problem = make_problem("maze", 4, 3, model="velocity2d")
    longest = max(lattice_step(problem) * len(lattice_path(problem, robot, (), 0.0)) for robot in range(4))
    assert math.ceil(longest / problem.dt) < problem.horizon
