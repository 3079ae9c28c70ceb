"""Large maps: lattices that get coarser say so, only free points count, and paths are found in narrow corridors."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d4orm_env import Problem, Team, World, make_problem
from d4orm_env.paths import shortest_paths
from d4orm_env.paths.lattice import lay_lattice
from d4orm_env.paths.spaces import make_space
from d4orm_env.scenarios.grid_map import GridMap
from d4orm_planners import make_planner
from d4orm_planners.mapf import roadmap as roadmaps
from d4orm_planners.mapf.lacam import TeamOnRoadmap as Searched
from d4orm_planners.mapf.near_neighbours import sort_into_cells
from d4orm_planners.mapf.occupancy import Occupancy
from d4orm_planners.mapf.reservations import free_intervals, interval_at
from d4orm_planners.mapf.roadmap import lay_roadmap


def caves(rows: int, columns: int, seed: int) -> np.ndarray:
    """The largest of the caves that a cellular automaton leaves."""
    from scipy.ndimage import label

    blocked = np.random.default_rng(seed).random((rows, columns)) < 0.45
    for _ in range(5):
        around = np.pad(blocked, 1, constant_values=True).astype(int)
        blocked = sum(around[i : i + rows, j : j + columns] for i in range(3) for j in range(3)) >= 5
    regions, _ = label(~blocked)
    return regions != 1 + np.argmax(np.bincount(regions.ravel())[1:])


def maze(rooms: int, seed: int) -> np.ndarray:
    """Corridors one cell wide, without a ring, that lead everywhere."""
    random, blocked, stack = np.random.default_rng(seed), np.ones((2 * rooms + 1,) * 2, bool), [(0, 0)]
    blocked[1, 1] = False
    while stack:
        i, j = stack[-1]
        near = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        near = [(k, m) for k, m in near if min(k, m) >= 0 and max(k, m) < rooms and blocked[2 * k + 1, 2 * m + 1]]
        if not near:
            stack.pop()
            continue
        k, m = near[random.integers(len(near))]
        blocked[2 * k + 1, 2 * m + 1] = blocked[i + k + 1, j + m + 1] = False
        stack.append((k, m))
    return blocked


def blocks(side: int, seed: int) -> np.ndarray:
    """Blocks of a city and streets, some of them one cell wide."""
    random, blocked, row = np.random.default_rng(seed), np.zeros((side, side), bool), 1
    while row < side:
        deep, column = int(random.integers(4, 20)), 1
        while column < side:
            wide = int(random.integers(4, 24))
            blocked[row : row + deep, column : column + wide] = True
            column += wide + int(random.integers(1, 5))
        row += deep + int(random.integers(1, 5))
    return blocked


def written(folder: Path, blocked: np.ndarray) -> Path:
    rows = "\n".join("".join(".@"[cell] for cell in row) for row in blocked.astype(int))
    path = folder / "large.map"
    path.write_text(f"type octile\nheight {blocked.shape[0]}\nwidth {blocked.shape[1]}\nmap\n{rows}\n")
    return path


def alone(world: World, start: tuple[float, float], goal: tuple[float, float]) -> Problem:
    return Problem(Team(("velocity2d",), radius=0.15), [start], [goal], world, horizon=1000)


def joined(problem: Problem, fineness: float) -> np.ndarray:
    """Who has a path on the roadmap."""
    roadmap = lay_roadmap(problem, fineness)
    return np.isfinite(Searched(problem, roadmap).bodies.costs[np.arange(problem.num_robots), roadmap.starts])


def test_a_lattice_says_how_far_apart_its_points_are() -> None:
    problem = alone(World(lower=[0, 0], upper=[100, 100]), (1, 1), (99, 99))
    lattice = lay_lattice(problem, None, 0.2, 0.5, 1000)
    assert len(lattice.positions) <= 1000
    assert 3.0 < lattice.step < 3.5
    assert np.diff(np.unique(lattice.positions[:, 0])) == pytest.approx(lattice.step)


def test_blocked_points_do_not_make_a_lattice_coarse() -> None:
    # A corridor 1 m wide along a wall of 99 m.
    world = World(boxes=[[0, 1, 100, 100]], lower=[0, 0], upper=[100, 100])
    problem = alone(world, (1, 0.5), (99, 0.5))
    lattice = lay_lattice(problem, make_space(problem), 0.2, 0.1, 10_000)
    assert lattice.step == 0.1
    assert len(lattice.nodes) > 900_000
    assert 5000 < len(lattice.positions) < 10_000
    np.testing.assert_array_equal(lattice.nodes[lattice.points], np.arange(len(lattice.points)))
    assert np.count_nonzero(lattice.nodes >= 0) == len(lattice.positions)
    assert problem.world.clearance(lattice.positions[:, :2]).min() > 0.2


def test_a_lattice_gets_as_coarse_as_its_free_points_require() -> None:
    problem = alone(World(boxes=[[40, 40, 60, 60]], lower=[0, 0], upper=[100, 100]), (1, 1), (99, 99))
    lattice = lay_lattice(problem, make_space(problem), 0.2, 0.1, 10_000)
    assert 8000 < len(lattice.positions) <= 10_000
    assert 0.95 < lattice.step < 1.1


@pytest.mark.parametrize("boxes", [(), ((40, 40, 60, 60),)])
def test_nodes_of_a_coarse_roadmap_are_joined(monkeypatch: pytest.MonkeyPatch, boxes: tuple[object, ...]) -> None:
    monkeypatch.setattr(roadmaps, "MAX_NODES", 2000)
    problem = alone(World(boxes=boxes, lower=[0, 0], upper=[100, 100]), (1, 1), (99, 99))
    roadmap = lay_roadmap(problem, 1.6)
    assert 1500 < len(roadmap.nodes) <= 2002
    assert len(roadmap.heads) > 7 * len(roadmap.nodes)
    assert joined(problem, 1.6).all()


def test_a_roadmap_does_not_get_coarser_with_the_horizon() -> None:
    problem = make_problem("rooms", num_robots=2, seed=1)
    short, long = (lay_roadmap(problem.replace(horizon=horizon), 1.6) for horizon in (100, 100_000))
    np.testing.assert_array_equal(short.nodes, long.nodes)


def test_paths_are_refined_beyond_the_limit_that_made_them_coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shortest_paths, "MAX_NODES", 400)
    world = GridMap(maze(9, 3), 0.6).world
    problem = alone(world, (0.9, 0.9), (10.5, 10.5))
    assert np.isfinite(problem.shortest_paths.length).all()
    monkeypatch.undo()
    assert problem.shortest_paths.length == pytest.approx(problem.replace().shortest_paths.length, rel=0.02)


@numba.njit
def _intervals(others, start, num_nodes, steps, first, begins, ends, asked, answers):  # type: ignore[no-untyped-def]
    safe = free_intervals(others, start, num_nodes, steps)
    first[:] = safe.first
    count = len(safe.begins)
    begins[:count], ends[:count] = safe.begins, safe.ends
    for row in range(len(asked)):
        answers[row] = interval_at(safe, asked[row, 0], asked[row, 1])
    return count


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 30))
def test_safe_intervals_are_those_of_every_step_looked_at(seed: int, num_robots: int, rows: int) -> None:
    random, steps = np.random.default_rng(seed), 25
    nodes = np.append(random.uniform(0, 4, (30, 2)), np.zeros((30, 1)), axis=1)
    positions = np.zeros((rows, num_robots, 3))
    positions[..., :2] = random.uniform(0, 4, (1, num_robots, 2)) + np.cumsum(
        random.choice([-0.3, 0.0, 0.3], (rows, num_robots, 2), p=[0.2, 0.6, 0.2]), axis=0
    )
    need = random.uniform(0.2, 1.0, num_robots)
    every = positions[np.minimum(np.arange(steps), rows - 1)]
    gaps = ((nodes[:, None, None] - every) ** 2).sum(axis=3)
    near = (gaps < need * need)[:, :, 1:].any(axis=2)  # robot 0 is the one that is replanned
    start = int(random.integers(30))
    first, begins, ends = np.empty(31, np.int64), np.empty(4000, np.int64), np.empty(4000, np.int64)
    asked = np.stack(np.meshgrid(np.arange(30), np.arange(steps), indexing="ij"), axis=-1).reshape(-1, 2)
    answers = np.empty(len(asked), np.int64)
    need[0] = 0.0
    others = Occupancy(sort_into_cells(nodes, 0.5), positions).around(need)
    _intervals(others, start, len(nodes), steps, first, begins, ends, asked, answers)
    for node in range(30):
        own = slice(first[node], first[node + 1])
        free = np.flatnonzero(np.diff(np.pad(~near[node], 1).astype(int))).reshape(-1, 2)
        if node == start and near[node, 0]:
            free = np.concatenate([[[0, 1]], free])
        np.testing.assert_array_equal(np.column_stack([begins[own], ends[own]]), free)
        over = (free[:, 1] <= np.arange(steps)[:, None]).sum(axis=1)
        np.testing.assert_array_equal(answers[node * steps : (node + 1) * steps], first[node] + over)


# One robot and eight on the whole way from a map to a plan that keeps clear.


@pytest.mark.parametrize("num_robots", [1, 8])
@pytest.mark.parametrize("blocked", [caves(194, 194, 1), blocks(256, 1)], ids=["caves", "city"])
@pytest.mark.slow
def test_first_plans_on_large_maps(tmp_path: Path, blocked: np.ndarray, num_robots: int) -> None:
    problem = make_problem("map", map=written(tmp_path, blocked), num_robots=num_robots, seed=0)
    plan = make_planner("mapf").solve(problem, seed=0, max_iterations=1)
    assert plan.solved


@pytest.mark.parametrize("num_robots", [1, 8])
@pytest.mark.slow
def test_first_plans_in_large_mazes_of_corridors_one_cell_wide(tmp_path: Path, num_robots: int) -> None:
    problem = make_problem("map", map=written(tmp_path, maze(64, 1)), num_robots=num_robots, seed=0)
    plan = make_planner("mapf").solve(problem, seed=0, max_iterations=1)
    assert plan.solved
