"""Cars with trailers: their motion, and their trailers in every contact."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, PYTHON_OPS
from shapely import affinity
from shapely import geometry as shapely

from d4orm_env import Problem, Team, World, load_dynobench, load_problem, make_problem, rollout, save_problem, verify
from d4orm_env.dynamics.models import get_model
from d4orm_env.dynamics.transition import TimeStep, advance
from d4orm_env.engine.choice import get_engine
from d4orm_env.footprints import Box, Disc, Polygon, Train
from d4orm_planners import make_planner
from d4orm_planners.engine.sampling_types import moving_robots

STEP = TimeStep(0.1, 0.1 / 2, 0.1 / 3, 0.1 / 6)
KITE = Polygon([[0.3, 0.0], [0.0, 0.2], [-0.2, 0.1], [-0.2, -0.1]])
MODELS = ("car_with_2_trailers", "unicycle", "car_with_1_trailer")
SHAPES = (Train(Box(0.5, 0.25, 0.1), [Box(0.3, 0.25), KITE]), Box(0.6, 0.2), Train(Disc(0.15), [Box(0.3, 0.2)]))
WORLD = World(
    boxes=[[-1.2, -1, -0.8, 0.2]], polygons=[[[0.5, -1], [1.1, -1.2], [0.8, -0.5]]], lower=[-2, -2], upper=[2, 2]
)
NEAR = 1e-5
"""Closer to contact than this [m], float32 may decide."""


def problem_of(horizon: int = 1) -> Problem:
    team = Team(MODELS, footprint=SHAPES, own_limits={"hitch_length_1": 0.4, "max_hitch_angle_1": 1.5})
    start = [[-1.6, -0.6, 1.57, 0, 0], [0, -1.5, 1.57, 0, 0], [1.5, 0.3, 1.57, 0, 0]]
    return Problem(team, start, [[-1.6, 1.5], [0, 1.5], [1.5, 1.5]], WORLD, horizon=horizon)


def bodies_of(state: np.ndarray, robot: int, hitches: dict[int, tuple[float, ...]]) -> list[tuple[object, float]]:
    """Cores as shapely has them, and their roundings: hand-written, from what a hitch angle means."""
    shape = SHAPES[robot]
    x, y, turn = state[:3]
    shapes = (shape.front, *shape.trailers) if isinstance(shape, Train) else (shape,)
    placed = []
    for number, footprint in enumerate(shapes):
        if number:
            turn -= state[2 + number]
            length = hitches[robot][number - 1]
            x, y = x - length * math.cos(turn), y - length * math.sin(turn)
        corners, rounding = footprint.core
        core = shapely.Point(corners[0]) if len(corners) == 1 else shapely.Polygon(corners)
        core = affinity.rotate(core, turn, origin=(0, 0), use_radians=True)
        placed.append((affinity.translate(core, x, y), rounding))
    return placed


def gaps(states: np.ndarray) -> np.ndarray:
    """``(K,)`` distance from every robot to the nearest thing."""
    bodies = [bodies_of(state, robot, {0: (0.4, 0.5), 2: (0.4,)}) for robot, state in enumerate(states.astype(float))]
    least = np.full(len(bodies), np.inf)
    for i, j in combinations(range(len(bodies)), 2):
        gap = min(a.distance(b) - r - s for a, r in bodies[i] for b, s in bodies[j])
        least[[i, j]] = np.minimum(least[[i, j]], gap)
    things = [shapely.box(-1.2, -1, -0.8, 0.2), shapely.Polygon(WORLD.polygons[0])]
    for robot, own in enumerate(bodies):
        for core, rounding in own:
            left, low, right, high = core.bounds
            ends = np.array([left + 2, low + 2, 2 - right, 2 - high]) - rounding
            least[robot] = min(least[robot], ends.min(), *(core.distance(thing) - rounding for thing in things))
    return least


def random_states(random: np.random.Generator) -> np.ndarray:
    states = np.zeros((3, 5), np.float32)
    states[:, :2], states[:, 2] = random.uniform(-1.6, 1.6, (3, 2)), random.uniform(-3, 3, 3)
    states[0, 3:], states[2, 3] = random.uniform(-0.7, 0.7, 2), random.uniform(-1.4, 1.4)
    return states


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_contacts_are_those_of_shapely(engine: str) -> None:
    problem, random, touched = problem_of(), np.random.default_rng(0), 0
    for _ in range(150):
        states = random_states(random)
        after = get_engine(engine).step(problem.arrays, states, np.zeros(3, bool), np.zeros((3, 2), np.float32))
        gap = gaps(states)
        for extra, flags in ((0.0, after.collided), (problem.margin, after.margin_violated)):
            clear = np.abs(gap - extra) > NEAR
            np.testing.assert_array_equal(flags[clear], (gap <= extra)[clear])
            touched += int(flags.sum())
    assert 200 < touched < 800


def test_the_judge_finds_the_smallest_gaps() -> None:
    problem, random = problem_of(horizon=8), np.random.default_rng(4)
    for _ in range(4):
        moved = problem._unchecked(start=random_states(random))
        controls = random.uniform(-0.5, 0.5, (8, 3, 2)).astype(np.float32)
        report = verify(moved, controls)
        fine = moved._unchecked(dt=moved.dt / 16, horizon=8 * 16)
        path = rollout(fine, np.repeat(controls, 16, axis=0)).states
        least = np.array([gaps(moment) for moment in path]).min()
        found = min(report.min_separation, report.min_clearance)
        assert least - 0.02 < found <= least + 1e-4 or (found <= 0 and least < 2e-3)


def test_trailers_follow() -> None:
    """On a circle the first trailer's hitch angle settles where both turn about one centre."""
    model, team = get_model("car_with_1_trailer"), Team(("car_with_1_trailer",))
    limits = tuple(team.limits[0].tolist())
    x: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    for _ in range(200):
        x = advance(model.functions, x, (0.5, 0.3), limits, STEP, PYTHON_OPS)
    radius = 0.3 / math.tan(0.3)
    assert x[3] == pytest.approx(math.asin(0.5 / radius), abs=1e-3)
    assert not model.turns_in_place
    assert team.turning_radius[0] == pytest.approx(0.3 / math.tan(0.6))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_pulled_straight_all_trailers_line_up(count: int) -> None:
    name = f"car_with_{count}_trailer" + "s" * (count > 1)
    model, team = get_model(name), Team((name,))
    limits = tuple(team.limits[0].tolist())
    x: tuple[float, ...] = (0.0, 0.0, 0.0, *(0.6, -0.5, 0.4)[:count])
    for _ in range(150):
        x = advance(model.functions, x, (1.0, 0.0), limits, STEP, PYTHON_OPS)
    assert np.abs(x[3:]).max() < 1e-3
    assert team.radius[0] == pytest.approx(0.5 * count + 0.15)
    poses = team.body_poses(np.array([x], np.float32))
    np.testing.assert_allclose(poses[:, 0], x[0] - 0.5 * np.arange(count + 1), atol=2e-3)


def test_moving_robots_bring_their_trailers() -> None:
    problem = problem_of()
    states = random_states(np.random.default_rng(1))
    moving = moving_robots(problem.team, states[None])
    assert moving.headings is not None
    np.testing.assert_allclose(moving.headings[0, 3], states[0, 2] - states[0, 3], atol=1e-6)
    assert moving.footprints is not None
    assert moving.footprints.following.tolist() == [3, -1, 5, 4, -1, -1]


def test_a_trailer_that_touches_at_the_start_is_told() -> None:
    team = Team(("car_with_1_trailer",) * 2, footprint=Train(Box(0.5, 0.25), [Box(0.3, 0.25)]))
    Problem(team, [[0, 0, 0, 0], [0.6, 0.3, 0, 0]], [[3, 0], [3, 2]])
    with pytest.raises(ValueError, match=r"starts of robot_0 .* and robot_1 .* overlap"):
        Problem(team, [[0, 0, 0, 0], [-0.4, 0.3, -1.57, 0]], [[3, 0], [3, 2]])


def test_footprints_have_a_body_for_every_trailer() -> None:
    with pytest.raises(ValueError, match="footprint of robot_0 has 0 trailers, and a car_with_1_trailer pulls 1; give"):
        Team(("car_with_1_trailer",), footprint=Box(0.5, 0.25))
    with pytest.raises(ValueError, match="trailers of Train are none"):
        Train(Box(0.5, 0.25), [])


def test_files_keep_trains(tmp_path: Path) -> None:
    problem = problem_of()
    save_problem(problem, tmp_path / "problem.yaml")
    assert load_problem(tmp_path / "problem.yaml") == problem


@pytest.mark.slow
def test_two_cars_with_trailers_swap(tmp_path: Path) -> None:
    path = tmp_path / "swap2_trailer.yaml"
    path.write_text(
        "environment: {min: [0, 0], max: [5, 5]}\nrobots:\n"
        "  - {type: car_first_order_with_1_trailers_0, start: [1, 2.5, 0, 0], goal: [4, 2.5, 0, 0]}\n"
        "  - {type: car1_v0, start: [4, 2.5, 3.14, 3.14], goal: [1, 2.5, 3.14, 3.14]}\n"
    )
    problem = load_dynobench(path)
    assert problem.team.models == ("car_with_1_trailer",) * 2
    assert problem.start[1, 3] == 0
    loose = problem.replace(goal_radius=0.1, goal_heading_tolerance=np.pi, arrival="dock", horizon=150, margin=0.05)
    plan = make_planner().solve(loose, seed=0, max_iterations=10)
    assert plan.solved
    assert verify(loose, plan.controls).ok


def test_a_team_with_trailers_is_made_by_name() -> None:
    problem = make_problem("circle", num_robots=2, model="car_with_1_trailer")
    assert problem.team.shapes[0] == Train(Disc(0.15), [Disc(0.15)])
