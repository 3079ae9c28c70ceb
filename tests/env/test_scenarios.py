"""Every named scenario makes problems that are valid, solvable and reproducible, or says what would be."""

from __future__ import annotations

import math
import re
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from env_support import WALLED, needed, scenario_models

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.footprints import Box, Ellipsoid
from d4orm_env.scenarios import describe_scenario, list_scenarios, make_problem
from d4orm_env.scenarios.generators import fibonacci_sphere
from d4orm_env.scenarios.layout import default_horizon
from d4orm_env.scenarios.problems import SCENARIOS

OPEN = ("circle", "sphere", "random", "four_obstacles", "heterogeneous", "swap")
PAPER = ("paper_circle", "paper_sphere", "paper_random", "paper_heterogeneous", "paper_obstacles")
AMSWARM = tuple(f"amswarm_{index}" for index in range(1, 6))
CASES = scenario_models()


def gaps(problem: Problem, positions: Any) -> list[float]:
    """Between the surfaces of any two robots, and of robots and obstacles; written apart from the code under test."""
    radius = [float(value) for value in np.asarray(problem.team.radius)]
    points = np.asarray(positions, np.float64).tolist()
    found = [math.dist(points[i], points[j]) - radius[i] - radius[j] for i, j in combinations(range(len(points)), 2)]
    for point, own in zip(points, radius, strict=True):
        for *centre, size in problem.world.balls.tolist() + problem.world.cylinders.tolist():
            found.append(math.dist(point[: len(centre)], centre) - own - size)
        for box in problem.world.boxes.tolist():
            corners = zip(point, box[: len(point)], box[len(point) :], strict=True)
            found.append(math.hypot(*(max(low - x, 0, x - high) for x, low, high in corners)) - own)
        for value, lower, upper in zip(point, *problem.world.bounds.tolist(), strict=True):
            found += [value - own - lower, upper - value - own]
    return found


def starts(problem: Problem) -> Any:
    return problem.start[:, : problem.dimension]


def test_the_cases_cover_every_scenario() -> None:
    assert {name for name, _ in CASES} == set(list_scenarios())
    assert list_scenarios() == (*OPEN, *AMSWARM, *PAPER, *WALLED)


@pytest.mark.parametrize(("name", "model"), CASES)
@pytest.mark.parametrize("num_obstacles", [0, 3])
def test_starts_and_goals_keep_the_margin(name: str, model: str | None, num_obstacles: int) -> None:
    problem, plain = (
        make_problem(name, model=model, num_obstacles=number, seed=5, **needed(name)) for number in (num_obstacles, 0)
    )
    assert problem.name == name
    assert problem.world.num_obstacles - plain.world.num_obstacles == num_obstacles
    for positions in (starts(problem), problem.goal):
        assert min(gaps(problem, positions)) > problem.margin
    assert (np.linalg.norm(problem.goal - starts(problem), axis=1) > problem.goal_radius).all()
    speeds = [problem.start[k, list(robot.speed_indices)] for k, robot in enumerate(problem.team.robot_models)]
    assert not np.concatenate(speeds).any()


@pytest.mark.parametrize(("name", "model"), CASES)
def test_the_same_arguments_give_the_same_problem(name: str, model: str | None) -> None:
    # The paper's obstacles stand still up to four.
    arguments: dict[str, Any] = {"model": model, "num_obstacles": 5 if name == "paper_obstacles" else 2, **needed(name)}
    first, again, other = (make_problem(name, seed=seed, **arguments) for seed in (3, 3, 4))
    assert first == again
    assert first != other
    # Problems that differ in their seed alone have the same shapes, so that nothing is compiled again for them.
    assert (first.horizon, first.start.shape) == (other.horizon, other.start.shape)


@pytest.mark.parametrize("name", [name for name in list_scenarios() if name not in AMSWARM])
@pytest.mark.parametrize("num_robots", [1, 2, 3, 5, 16, 37])
def test_any_number_of_robots(name: str, num_robots: int) -> None:
    problem = make_problem(name, num_robots, **needed(name))
    assert problem.num_robots == num_robots
    for positions in (starts(problem), problem.goal):
        assert min(gaps(problem, positions)) > problem.margin


def test_defaults_are_the_papers() -> None:
    problem = make_problem("circle")
    assert (problem.num_robots, problem.dt, problem.horizon) == (8, 0.1, 100)
    assert (problem.margin, problem.goal_radius) == (0.05, 0.075)
    np.testing.assert_allclose(problem.goal_speed, 0.1)  # the paper has none, as its scenarios
    assert np.isinf(make_problem("paper_circle").goal_speed).all()
    np.testing.assert_allclose(problem.team.radius, 0.15)
    np.testing.assert_allclose(problem.team.limits, np.tile([1.0, 1.0, np.pi / 2], (8, 1)), rtol=1e-6)
    assert problem.world.lower is None


def test_arguments_reach_the_problem() -> None:
    given: dict[str, Any] = {"dt": 0.05, "margin": 0.1, "goal_radius": 0.2, "horizon": 77}
    problem = make_problem("random", 4, 9, radius=[0.1, 0.2, 0.3, 0.4], max_speed=2, max_turn_rate=0.5, **given)
    assert {name: getattr(problem, name) for name in given} == given
    np.testing.assert_allclose(problem.team.radius, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(problem.team.limits, np.tile([2.0, 1.0, 0.5], (4, 1)))
    mixed = make_problem("circle", 2, model=["velocity2d", "differential_drive"])
    assert mixed.team.models == ("velocity2d", "differential_drive")


class TestCircle:
    def test_is_antipodal(self) -> None:
        problem = make_problem("circle", num_robots=4, diameter=6.0)
        expected = [[3, 0], [0, 3], [-3, 0], [0, -3]]
        assert starts(problem).tolist() == expected
        np.testing.assert_array_equal(problem.goal, np.negative(expected))

    def test_lies_in_the_plane_in_space(self) -> None:
        problem = make_problem("circle", num_robots=12, model="holonomic3d")
        assert problem.goal.shape == (12, 3)
        assert not problem.start[:, 2].any()
        assert not problem.goal[:, 2].any()
        np.testing.assert_allclose(np.linalg.norm(problem.goal, axis=1), 2.5, rtol=1e-6)

    def test_seed_moves_obstacles_alone(self) -> None:
        first, other = (make_problem("circle", seed=seed, num_obstacles=4) for seed in (0, 1))
        assert first.replace(world=None) == other.replace(world=None)
        assert first.world.circles.tolist() != other.world.circles.tolist()
        assert (np.linalg.norm(first.world.circles[:, :2], axis=1) < 2.5).all()

    def test_differential_drives_face_their_goals(self) -> None:
        problem = make_problem("circle", num_robots=4, model="differential_drive")
        np.testing.assert_allclose(problem.start[:, 2], [np.pi, -np.pi / 2, 0, np.pi / 2], rtol=1e-6)


class TestSphere:
    @pytest.mark.parametrize("num_robots", [1, 2, 7, 100])
    def test_is_antipodal(self, num_robots: int) -> None:
        problem = make_problem("sphere", num_robots=num_robots, diameter=8)
        np.testing.assert_array_equal(problem.goal, -starts(problem))
        np.testing.assert_allclose(np.linalg.norm(problem.goal, axis=1), 4.0, rtol=1e-6)

    def test_points_are_spread_evenly(self) -> None:
        for count in (10, 64, 300):
            points = fibonacci_sphere(count)
            nearest = min(math.dist(a, b) for a, b in combinations(points.tolist(), 2))
            # No points can be further apart than about 3.81 / sqrt(count) (hexagonal packing).
            assert 3.0 < nearest * math.sqrt(count) < 3.81
            np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.1)


class TestRandom:
    def test_seeds_differ_and_obstacles_do_not_move_robots(self) -> None:
        plain, crowded, other = (
            make_problem("random", 16, seed, num_obstacles=obstacles) for seed, obstacles in ((1, 0), (1, 5), (2, 0))
        )
        assert crowded.replace(world=None) == plain
        assert plain != other

    @pytest.mark.parametrize(("model", "size"), [("holonomic2d", 7.0), ("holonomic3d", 4.0)])
    def test_fills_the_square_evenly(self, model: str, size: float) -> None:
        problems = [make_problem("random", 20, seed, size=size, model=model) for seed in range(30)]
        positions = np.concatenate([np.concatenate([starts(problem), problem.goal]) for problem in problems])
        assert np.abs(positions).max() <= size / 2
        assert np.abs(positions).max(axis=0) == pytest.approx(size / 2, rel=0.02)
        # 1200 uniform numbers: the mean has a standard deviation of size / 120.
        np.testing.assert_allclose(positions.mean(axis=0), 0, atol=5 * size / 120)

    def test_default_size_keeps_the_density_of_large_teams(self) -> None:
        for num_robots, size in ((4, 5), (16, 5), (64, 10)):
            positions = starts(make_problem("random", num_robots))
            assert 0.6 * size / 2 < np.abs(positions).max() <= size / 2


def test_four_obstacles_congest_the_centre() -> None:
    problem = make_problem("four_obstacles", num_robots=16)
    assert sorted(map(tuple, problem.world.circles[:, :2].tolist())) == [(-1, 0), (0, -1), (0, 1), (1, 0)]
    np.testing.assert_allclose(problem.world.circles[:, 2], 0.15)
    assert problem.replace(world=None) == make_problem("circle", num_robots=16)
    # A straight drive runs into an obstacle: the scenario is not the plain circle in disguise.
    line = np.linspace(starts(problem)[0], problem.goal[0], 101)
    assert problem.world.clearance(line).min() < 0
    assert make_problem("four_obstacles", model="holonomic3d").world.cylinders.shape == (4, 3)


def test_four_obstacles_stay_when_random_ones_come() -> None:
    fixed = make_problem("four_obstacles").world.circles.tolist()
    assert make_problem("four_obstacles", num_obstacles=2).world.circles.tolist()[:4] == fixed


def test_heterogeneous_mixes_models_and_limits() -> None:
    problem = make_problem("heterogeneous", num_robots=4)
    assert problem.team.models == ("differential_drive", "holonomic2d") * 2
    assert np.asarray(problem.team.max_acceleration).tolist() == [1, 2, 1, 2]
    np.testing.assert_allclose(problem.start[:, 2:], [[np.pi, 0], [0, 0], [0, 0], [0, 0]], atol=1e-6)
    assert np.asarray(make_problem("heterogeneous", max_acceleration=3).team.max_acceleration).tolist() == [3] * 8


@pytest.mark.parametrize("num_robots", [6, 7])
def test_swap_exchanges_two_rows(num_robots: int) -> None:
    problem = make_problem("swap", num_robots=num_robots, distance=4.0, spacing=1.0)
    np.testing.assert_array_equal(problem.goal, starts(problem) * [-1, 1])
    positions = {tuple(position) for position in starts(problem).tolist()}
    occupied = [tuple(goal) in positions for goal in problem.goal.tolist()]
    assert occupied.count(False) == num_robots % 2
    assert set(starts(problem)[:, 0].tolist()) == {-2.0, 2.0}


AMSWARM_CYLINDERS = {
    "amswarm_1": set(),
    "amswarm_2": {(0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)},
    "amswarm_3": {(0, 1), (0, -1), (1, 0), (-1, 0)},
    "amswarm_4": {(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)},
    "amswarm_5": {(0, 0), (0, 1), (0, -1), (-1, 1), (-1, -1)},
}


@pytest.mark.parametrize("name", AMSWARM)
def test_amswarm_environments(name: str) -> None:
    problem = make_problem(name)
    assert problem.team.models == ("holonomic3d",) * 10
    np.testing.assert_allclose(problem.team.radius, 0.29)
    assert (problem.margin, problem.horizon) == (0.05, 100)
    assert {(x, y) for x, y, _ in problem.world.cylinders.tolist()} == AMSWARM_CYLINDERS[name]
    np.testing.assert_allclose(problem.world.cylinders[:, 2], 0.2)
    assert problem.world.bounds.tolist() == [[-3] * 3, [3] * 3]
    assert problem.replace(world=None) == make_problem(
        "circle", 10, model="holonomic3d", radius=0.29, goal_speed=math.inf
    )


def test_amswarm_jitter_moves_the_starts_alone() -> None:
    still, moved, other = (
        make_problem("amswarm_2", seed=seed, jitter=jitter) for seed, jitter in ((0, 0), (0, 0.005), (1, 0.005))
    )
    shift = np.abs(starts(moved) - starts(still))
    assert 0.004 < shift.max() <= 0.00501
    assert (shift > 0).mean() > 0.9
    np.testing.assert_array_equal(moved.goal, still.goal)
    assert moved != other


class TestPaper:
    """Known answers from the definitions of the authors' code of 2026."""

    def test_circle(self) -> None:
        problem = make_problem("paper_circle", 4, max_speed=0.1)
        assert problem.horizon == 100
        assert problem.replace(horizon=1) == make_problem("circle", 4, max_speed=0.1, horizon=1, goal_speed=math.inf)

    def test_sphere(self) -> None:
        problem = make_problem("paper_sphere", 2)
        np.testing.assert_allclose(problem.team.radius, 0.3)
        assert problem.margin == 0.05
        # Polar angles of 60 and 120 degrees; the second azimuth is pi (1 + sqrt 5), 222.4922 degrees.
        expected = [[2.1650635, 0, 1.25], [-1.5964505, -1.4624794, -1.25]]
        np.testing.assert_allclose(starts(problem), expected, atol=1e-6)
        np.testing.assert_array_equal(problem.goal, -starts(problem))

    @pytest.mark.parametrize("seed", range(5))
    def test_random(self, seed: int) -> None:
        problem = make_problem("paper_random", 16, seed)
        third = 5 / 3
        row = [-5, -third, third, 5]
        np.testing.assert_allclose(problem.goal, [(x, y) for y in row for x in row], rtol=1e-6)
        distance = np.linalg.norm(problem.goal - starts(problem), axis=1)
        assert (distance.min(), distance.max()) == (pytest.approx(5.5, abs=0.5), pytest.approx(5.5, abs=0.5))
        assert np.abs(starts(problem)).max() <= 5
        assert min(math.dist(a, b) for a, b in combinations(starts(problem).tolist(), 2)) >= 0.9 - 1e-6

    def test_random_takes_the_first_points_of_its_grid(self) -> None:
        assert make_problem("paper_random", 3).goal.tolist() == [[-5, -5], [5, -5], [-5, 5]]
        assert make_problem("paper_random", 64).goal[-1].tolist() == [5, 5]

    def test_random_has_no_room_for_a_hundred(self) -> None:
        with pytest.raises(ValueError, match=r"100 robots of radius 0\.15 m found no room.*use fewer robots"):
            make_problem("paper_random", 100)

    def test_heterogeneous(self) -> None:
        problem = make_problem("paper_heterogeneous", num_robots=4)
        assert problem.team.models == ("holonomic2d", "differential_drive") * 2
        assert np.asarray(problem.team.max_acceleration).tolist() == [1, 2, 1, 2]
        np.testing.assert_allclose(problem.team.max_turn_rate, np.pi / 2)
        np.testing.assert_allclose(problem.start[:, 2:], [[0, 0], [-np.pi / 2, 0], [0, 0], [np.pi / 2, 0]], atol=1e-6)

    @pytest.mark.parametrize(
        ("count", "expected"),
        [
            (0, []),
            (1, [[0, 0, 0.5]]),
            (2, [[0, 1, 0.15], [0, -1, 0.15]]),
            (3, [[0, 1, 0.15], [0.8660254, -0.5, 0.15], [-0.8660254, -0.5, 0.15]]),
            (4, [[0, 1, 0.15], [1, 0, 0.15], [0, -1, 0.15], [-1, 0, 0.15]]),
        ],
    )
    def test_obstacles(self, count: int, expected: list[list[float]]) -> None:
        problem = make_problem("paper_obstacles", num_obstacles=count)
        np.testing.assert_allclose(problem.world.circles, np.reshape(expected, (-1, 3)), atol=1e-7)
        assert problem.replace(world=None) == make_problem("paper_circle")

    def test_more_obstacles_fill_the_unit_disc(self) -> None:
        circles = make_problem("paper_obstacles", num_obstacles=2000, obstacle_radius=0.1).world.circles
        distance = np.linalg.norm(circles[:, :2], axis=1)
        assert distance.max() <= 1
        # Uniform in the disc: the mean distance is 2/3, with a standard deviation of sqrt(1/18 / 2000).
        assert distance.mean() == pytest.approx(2 / 3, abs=0.02)
        np.testing.assert_allclose(circles[:, 2], 0.1)
        assert make_problem("paper_obstacles").world.num_obstacles == 4


class TestObstacles:
    @pytest.mark.parametrize("name", ["circle", "random", "swap", "sphere", "amswarm_3"])
    def test_leave_a_passage_for_every_robot(self, name: str) -> None:
        problem = make_problem(name, num_obstacles=6, seed=2)
        passage = 2 * (float(np.max(problem.team.radius)) + problem.margin)
        balls = problem.world.balls.tolist()
        assert len(balls) == 6
        for (*a, size_a), (*b, size_b) in combinations(balls, 2):
            assert math.dist(a, b) - size_a - size_b > passage
        for *centre, size in balls:
            for x, y, radius in problem.world.cylinders.tolist():
                assert math.dist(centre[:2], (x, y)) - size - radius > passage

    def test_take_their_radius(self) -> None:
        circles = make_problem("circle", num_obstacles=2, obstacle_radius=0.4).world.circles
        np.testing.assert_allclose(circles[:, 2], 0.4)

    def test_that_do_not_fit_are_refused_with_the_number_that_does(self) -> None:
        with pytest.raises(ValueError, match=r"use num_obstacles=\d+") as error:
            make_problem("circle", num_obstacles=500)
        fitting = int(re.findall(r"num_obstacles=(\d+)", str(error.value))[0])
        assert make_problem("circle", num_obstacles=fitting).world.num_obstacles == fitting


class TestHorizon:
    def test_stays_at_the_papers_where_that_suffices(self) -> None:
        for name in {*OPEN, *AMSWARM, *PAPER} - {"random"}:
            assert make_problem(name).horizon == 100

    def test_grows_with_the_way(self) -> None:
        team = Team(("holonomic2d",))
        assert [default_horizon(team, 0.1, distance) for distance in (0.5, 5, 5.25, 5.3, 18)] == [
            100,
            100,
            100,
            110,
            310,
        ]
        assert default_horizon(team, 0.05, 5) == 200
        assert default_horizon(Team(("velocity2d",), max_speed=0.5), 0.1, 5) == 160
        # The slowest robot sets the pace; one that never reaches its top speed is slower still.
        assert default_horizon(Team(("holonomic2d",) * 2, max_speed=np.array([1, 0.5], np.float32)), 0.1, 5) == 170
        assert default_horizon(Team(("holonomic2d",), max_acceleration=0.1), 0.1, 5) == 230
        assert make_problem("circle", diameter=18).horizon == 310

    def test_is_what_the_caller_says(self) -> None:
        assert make_problem("circle", diameter=18, horizon=50).horizon == 50


TOO_MANY = [
    ("circle", {"num_robots": 60}, "diameter"),
    ("circle", {"num_robots": 2, "diameter": 0.1}, "diameter"),
    ("heterogeneous", {"num_robots": 46}, "diameter"),
    ("four_obstacles", {"num_robots": 100}, "diameter"),
    ("sphere", {"num_robots": 600}, "diameter"),
    ("random", {"num_robots": 300, "size": 5}, "size"),
    ("random", {"num_robots": 1, "size": 0.05}, "size"),
    ("random", {"num_robots": 2, "size": 0.3}, "size"),
    ("random", {"num_robots": 3, "size": 0.3, "goal_radius": 0.4}, "size"),
    ("random", {"num_robots": 300, "size": 2, "model": "holonomic3d"}, "size"),
    ("swap", {"distance": 0.2}, "distance"),
    ("swap", {"spacing": 0.2, "radius": 0.3}, "spacing"),
]


@pytest.mark.parametrize(("name", "arguments", "remedy"), TOO_MANY)
def test_robots_that_do_not_fit_are_told_what_would(name: str, arguments: dict[str, Any], remedy: str) -> None:
    with pytest.raises(ValueError, match=rf"do not fit .*; use {remedy}=[\d.]+$") as error:
        make_problem(name, **arguments)
    size = float(re.findall(rf"{remedy}=([\d.]+)", str(error.value))[0])
    for seed in range(5):
        assert make_problem(name, seed=seed, **{**arguments, remedy: size}).num_robots == arguments.get("num_robots", 8)


def test_the_diameter_that_is_named_is_hardly_more_than_needed() -> None:
    with pytest.raises(ValueError, match=r"use diameter=6\.69$"):
        make_problem("circle", num_robots=60)
    with pytest.raises(ValueError, match="do not fit"):
        make_problem("circle", num_robots=60, diameter=6.68)


BAD = [
    ("labyrinth", {}, "'labyrinth' is unknown; choose one of circle, sphere"),
    (None, {}, "None is unknown"),
    ("circle", {"num_robots": 0}, "num_robots is 0; it must be at least 1"),
    ("circle", {"num_robots": 2.5}, "num_robots must be a whole number"),
    ("circle", {"num_robots": True}, "num_robots must be a whole number"),
    ("circle", {"num_robots": 10**9}, "num_robots is 1000000000; scenarios make at most"),
    ("circle", {"seed": -1}, "seed is -1"),
    ("circle", {"seed": "x"}, "seed must be a whole number"),
    ("circle", {"num_obstacles": -1}, "num_obstacles is -1"),
    ("circle", {"obstacle_radius": 0}, "obstacle_radius is 0"),
    ("circle", {"horizon": 0}, "horizon is 0"),
    ("circle", {"dt": 0}, "dt is 0"),
    ("circle", {"dt": 1e-9}, "needs 9.6e.* steps; use a larger dt"),
    ("circle", {"dt": 100}, "dt is 100 s, in which the slowest robot may move by 100 m, farther than the 5 m"),
    ("circle", {"max_speed": 1000}, "move by 100 m, farther than .* give metres and seconds"),
    ("circle", {"goal_radius": 75}, "goal_radius is 75 m, farther than the 5 m that scenario 'circle' is made for"),
    ("circle", {"margin": math.nan}, "margin is nan"),
    ("circle", {"goal_radius": -1}, "goal_radius is -1"),
    ("circle", {"goal_speed": 1e7}, "goal_speed of robot_0 is 1e"),
    ("circle", {"radius": 0}, "radius of robot_0 is 0"),
    ("circle", {"radius": [0.1, 0.2]}, "radius has shape"),
    ("circle", {"footprint": 0.3}, r"footprint of robot_0 is 0\.3; give one such as Box"),
    ("circle", {"footprint": {"shape": "blob"}}, "footprint 'blob' is unknown"),
    ("circle", {"footprint": Box(0.4, 0.2), "radius": 0.3}, "radius 0.3 is not that of the footprints"),
    ("circle", {"goal_heading": 0.0}, "a holonomic2d has no heading"),
    ("circle", {"max_speed": math.nan}, "max_speed"),
    ("circle", {"max_acceleration": 1e300}, "max_acceleration.* is inf"),
    ("circle", {"diameter": math.nan}, "diameter is nan"),
    ("circle", {"diameter": "wide"}, "diameter must be a number"),
    ("circle", {"diameter": 1e9}, "diameter is 1e\\+09; scenarios take at most 10000"),
    ("circle", {"model": "boat"}, "model 'boat' is unknown; choose one of holonomic2d"),
    ("circle", {"model": {}}, "model must be the name of a model"),
    ("circle", {"model": ["holonomic2d"]}, "lists 1 names for 8 robots"),
    ("circle", {"num_robots": 2, "model": ["holonomic2d", "holonomic3d"]}, "mix 2D and 3D"),
    ("sphere", {"model": "holonomic2d"}, "three-dimensional and .*; use model='holonomic3d'"),
    ("amswarm_1", {"model": "differential_drive"}, "use model='holonomic3d'"),
    ("amswarm_1", {"num_robots": 8}, "exactly 10 robots"),
    ("amswarm_1", {"jitter": -1}, "jitter is -1"),
    ("amswarm_1", {"jitter": 1e308}, "jitter is 1e"),
    ("amswarm_2", {"jitter": 0.3, "seed": 1}, "the start of robot_.* from an obstacle or the bounds"),
    ("heterogeneous", {"model": "holonomic2d"}, "takes no model"),
    ("paper_heterogeneous", {"model": "holonomic2d"}, "'paper_heterogeneous' mixes holonomic2d and .* takes no model"),
    ("paper_sphere", {"model": "holonomic2d"}, "three-dimensional and .*; use model='holonomic3d'"),
    ("paper_random", {"model": "holonomic3d"}, "is planar"),
    ("random", {"size": 0}, "size is 0"),
    ("swap", {"spacing": math.inf}, "spacing is inf"),
    ("four_obstacles", {"obstacle_distance": 2.15}, "the start of robot_0 is 0.05.* the margin is 0.05"),
]


@pytest.mark.parametrize("footprint", [Box(0.4, 0.2), {"shape": "box", "length": 0.4, "width": 0.2}])
def test_scenarios_take_footprints_and_goal_headings(footprint: Any) -> None:
    problem = make_problem(
        "circle", num_robots=3, model="differential_drive", footprint=footprint, goal_heading=0.5,
        goal_heading_tolerance=0.2,
    )  # fmt: skip
    assert problem.team.footprint == (Box(0.4, 0.2),) * 3
    assert problem.goal_heading.tolist() == [0.5] * 3
    assert problem.goal_heading_tolerance.tolist() == [np.float32(0.2)] * 3


def test_a_footprint_replaces_a_scenarios_own_radius() -> None:
    problem = make_problem("amswarm_2", footprint=Ellipsoid(0.1, 0.1, 0.25))
    assert problem.team.radius.tolist() == [0.25] * 10


@pytest.mark.parametrize(("name", "arguments", "message"), BAD)
def test_bad_arguments_are_named(name: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        make_problem(name, **arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"diametre": 5}, "takes no argument 'diametre'; it takes .*diameter, .*dt.*; did you mean 'diameter'?"),
        ({"size": 5}, "takes no argument 'size'"),
        ({"scenario_": 1}, "takes no argument"),
    ],
)
def test_unknown_arguments_are_type_errors(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        make_problem("circle", **arguments)


def test_none_takes_the_default() -> None:
    names = (*SCENARIOS["circle"].arguments,)
    assert make_problem("circle", **dict.fromkeys(names)) == make_problem("circle")


def test_every_scenario_is_described_in_one_line() -> None:
    lines = [describe_scenario(name) for name in list_scenarios()]
    assert all(line.endswith(".") and len(line) <= 120 for line in lines)
    assert len(set(lines)) == len(lines)
    with pytest.raises(ValueError, match="unknown"):
        describe_scenario("labyrinth")
    with pytest.raises(TypeError):
        SCENARIOS["mine"] = SCENARIOS["circle"]  # type: ignore[index]
