"""Footprints: what they are, and their contacts in every engine and in the judge, against an independent library."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely import geometry as shapely

from d4orm_env import Problem, Team, World, load_problem, make_problem, navigation_v0, rollout, save_problem, verify
from d4orm_env.core.gaps import pair_gap, world_gap
from d4orm_env.engine.choice import get_engine
from d4orm_env.footprints import Box, Capsule, Disc, Ellipsoid, Footprint, Polygon
from d4orm_env.scenarios.settings import parsed
from d4orm_env.verify.footprints import Obstacles, Sides, TurningPairs

KITE = Polygon([[0.3, 0.0], [0.0, 0.2], [-0.2, 0.1], [-0.2, -0.1]])
SHAPES: tuple[Footprint, ...] = (Box(0.6, 0.2, 0.1), Capsule(0.4, 0.1), KITE, Disc(0.2), Box(0.3, 0.3))
WORLD = World(
    circles=[[1, 1, 0.2]], boxes=[[-1.2, -1, -0.8, 0.2]], polygons=[[[0.5, -1], [1.1, -1.2], [0.8, -0.5], [0.8, -0.9]]],
    lower=[-2, -2], upper=[2, 2],
)  # fmt: skip
NEAR = 1e-5
"""Closer to contact than this [m], float32 may decide."""


def planar_problem(model: str = "unicycle", **settings: Any) -> Problem:
    team = Team((model,) * len(SHAPES), footprint=SHAPES)
    columns = np.arange(len(SHAPES)) * 0.9 - 1.8
    start = np.zeros((len(SHAPES), team.state_size))
    start[:, :3] = np.column_stack([columns, np.full(len(SHAPES), -1.5), np.full(len(SHAPES), np.pi / 2)])
    return Problem(
        team, start, np.column_stack([columns, np.full(len(SHAPES), 1.7)]), WORLD, **{"horizon": 1} | settings
    )


def outline(footprint: Footprint, x: float, y: float, turn: float) -> tuple[shapely.base.BaseGeometry, float]:
    """The core as shapely has it, and its rounding."""
    corners, rounding = footprint.core  # type: ignore[attr-defined]
    kinds = {1: lambda: shapely.Point(corners[0]), 2: lambda: shapely.LineString(corners)}
    core = kinds.get(len(corners), lambda: shapely.Polygon(corners))()
    return affinity.translate(affinity.rotate(core, turn, origin=(0, 0), use_radians=True), x, y), rounding


def gaps(states: np.ndarray) -> np.ndarray:
    """``(K,)`` distance from every robot to the nearest thing."""
    bodies = [outline(footprint, *state[:3]) for footprint, state in zip(SHAPES, states.astype(float), strict=True)]
    things = [(shapely.Point(1, 1), 0.2), (shapely.box(-1.2, -1, -0.8, 0.2), 0.0)]
    things += [(shapely.Polygon(corners), 0.0) for corners in WORLD.polygons]
    least = np.full(len(bodies), np.inf)
    for i, j in combinations(range(len(bodies)), 2):
        gap = bodies[i][0].distance(bodies[j][0]) - bodies[i][1] - bodies[j][1]
        least[[i, j]] = np.minimum(least[[i, j]], gap)
    for robot, (core, rounding) in enumerate(bodies):
        left, low, right, high = core.bounds
        ends = np.array([left + 2, low + 2, 2 - right, 2 - high]) - rounding
        others = [core.distance(thing) - rounding - size for thing, size in things]
        least[robot] = min(least[robot], ends.min(), *others)
    return least


def test_gaps_of_footprints_at_rest_are_those_of_shapely() -> None:
    random, apart = np.random.default_rng(0), 0
    for _ in range(40):
        poses = np.column_stack([random.uniform(-0.6, 0.6, (len(SHAPES), 2)), random.uniform(-3, 3, len(SHAPES))])
        bodies = [outline(footprint, *pose) for footprint, pose in zip(SHAPES, poses, strict=True)]
        for i, j in combinations(range(len(SHAPES)), 2):
            (one, its), (other, others) = bodies[i], bodies[j]
            gap = pair_gap(SHAPES[i], poses[i], SHAPES[j], poses[j])
            if one.disjoint(other):
                assert gap == pytest.approx(one.distance(other) - its - others, abs=1e-9)
                apart += 1
            else:
                assert gap <= 0
    assert 100 < apart < 390


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_contacts_are_those_of_shapely(engine: str) -> None:
    problem, random = planar_problem(), np.random.default_rng(0)
    nobody, still = np.zeros(len(SHAPES), bool), np.zeros((len(SHAPES), 2), np.float32)
    touched = 0
    for _ in range(150):
        states = np.column_stack([random.uniform(-1.9, 1.9, (len(SHAPES), 2)), random.uniform(-3, 3, len(SHAPES))])
        after = get_engine(engine).step(problem.arrays, states.astype(np.float32), nobody, still)
        gap = gaps(states.astype(np.float32))
        for extra, flags in ((0.0, after.collided), (problem.margin, after.margin_violated)):
            clear = np.abs(gap - extra) > NEAR
            np.testing.assert_array_equal(flags[clear], (gap <= extra)[clear])
            touched += int(flags.sum())
    assert touched > 300


@pytest.mark.parametrize("model", ["differential_drive", "unicycle", "car"])
def test_the_judge_finds_the_smallest_gaps(model: str) -> None:
    """Against the least of many moments of a motion that turns."""
    # Kernels are compiled apart with and without these, and for those two by other tests with them.
    headings = {} if model == "unicycle" else {"goal_heading": 0.0}
    problem = planar_problem(model, horizon=8, **headings)
    random = np.random.default_rng(3)
    for _ in range(3):
        states = problem.start.copy()
        states[:, :2], states[:, 2] = random.uniform(-1.4, 1.4, (len(SHAPES), 2)), random.uniform(-3, 3, len(SHAPES))
        moved = problem.with_state(states, problem.goal)
        controls = random.uniform(-1, 1, (8, len(SHAPES), problem.control_size)).astype(np.float32)
        report = verify(moved, controls)
        # Each step again in 16: the controls are held, so that the motion is the same.
        fine = moved._unchecked(dt=moved.dt / 16, horizon=8 * 16)
        path = rollout(fine, np.repeat(controls, 16, axis=0)).states
        least = np.array([gaps(moment) for moment in path]).min()
        found = min(report.min_separation, report.min_clearance)
        assert found <= least + 1e-4
        assert found > 0 or least < 2e-3
        if least > 0:
            assert found > least - 0.02
        contact = any(violation.kind.endswith("contact") for violation in report.violations)
        assert contact == (found <= 0)


def test_the_judge_sees_a_corner_that_sweeps_by_within_a_step() -> None:
    """Two long boxes end to end: turning on the spot by a half turn in one step, one touches the other in between."""
    team = Team(("unicycle",) * 2, footprint=Box(1.0, 0.1), max_turn_rate=[31.5, 1.0])
    problem = Problem(team, [[0, 0, 0], [0, 0.4, 0]], [[0, 3], [3, 0.4]], horizon=1)
    turned = np.array([[[0, np.pi / 0.1], [0, 0]]], np.float32)
    assert not rollout(problem, turned).collided.any()
    assert any(violation.kind == "robot contact" for violation in verify(problem, turned).violations)


@given(
    st.tuples(*[st.floats(0.1, 0.6)] * 6),
    st.tuples(*[st.floats(-1.2, 1.2)] * 3),
)
@settings(max_examples=40, deadline=None)
def test_ellipsoids_touch_where_no_plane_parts_them(sizes: tuple[float, ...], offset: tuple[float, ...]) -> None:
    a, b, d = np.array(sizes[:3], np.float32), np.array(sizes[3:], np.float32), np.array(offset, np.float32)
    team = Team(("holonomic3d",) * 2, footprint=[Ellipsoid(*map(float, a)), Ellipsoid(*map(float, b))])
    apart = [[0] * 6, [9, 9, 9, 0, 0, 0]]
    problem = Problem(team, apart, [[1, 0, 0], [9, 9, 8]], horizon=1)
    states = np.array([[0] * 6, [*d, 0, 0, 0]], np.float32)
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach = np.linalg.norm(directions * a, axis=1) + np.linalg.norm(directions * b, axis=1)
    parted = float((directions @ d - reach).max())
    after = get_engine("cpu").step(problem.arrays, states, np.zeros(2, bool), np.zeros((2, 3), np.float32))
    report = verify(problem.with_state(states, problem.goal), np.zeros((1, 2, 3), np.float32))
    if abs(parted) > 5e-3:
        assert bool(after.collided[0]) == (parted < 0)
        assert (report.min_separation <= 0) == (parted < 0)
        assert parted < 0 or report.min_separation >= parted - 5e-3


def test_ellipsoids_among_obstacles() -> None:
    """Beside a sphere, a cylinder and a box, over the floor: 1 cm clear of each, and 1 cm within."""
    obstacles = {"spheres": [[0, 0, 1, 0.2]], "cylinders": [[3, 0, 0.2]], "boxes": [[5, -1, 0, 6, 1, 2]]}
    world = World(3, **obstacles, lower=[-9, -9, 0], upper=[9, 9, 9])
    team = Team(("holonomic3d",), footprint=Ellipsoid(0.1, 0.1, 0.3))
    problem = Problem(team, [[-3, 0, 1, 0, 0, 0]], [[-3, 0, 2]], world, horizon=1, margin=0.05)
    for position in ([-0.3, 0, 1], [0, 0, 1.5], [2.7, 0, 4], [4.9, 0, 1], [-3, 0, 0.3]):
        away = np.sign(np.array(position) - [{-0.3: 0, 0: 0, 2.7: 3, 4.9: 5.5, -3: -3}[position[0]], 0, 1]) * 0.01
        if position[0] in (2.7, 4.9, -3):
            away[2] = 0.01 if position[0] == -3 else 0
        for sign, collides in ((1, False), (-1, True)):
            states = np.array([[*(np.array(position) + sign * away), 0, 0, 0]], np.float32)
            for engine in ENGINE_NAMES:
                after = get_engine(engine).step(problem.arrays, states, np.zeros(1, bool), np.zeros((1, 3), np.float32))
                assert bool(after.collided[0]) == collides, (position, sign, engine)
                assert after.margin_violated[0]
            report = verify(problem.with_state(states, problem.goal), np.zeros((1, 1, 3), np.float32))
            assert (report.min_clearance <= 0) == collides


@pytest.mark.parametrize("gap", [0.01, -0.01])
def test_obstacles_and_bounds_meet_the_body_of_an_ellipsoid(gap: float) -> None:
    """Below a sphere, under the ceiling, over the floor and a box, and beside a cylinder."""
    obstacles = {"spheres": [[0, 0, 1, 0.2]], "cylinders": [[3, 0, 0.2]], "boxes": [[5, -1, 0, 6, 1, 1]]}
    world = World(3, **obstacles, lower=[-9, -9, 0], upper=[9, 9, 2])
    body, team = 0.1, Team(("holonomic3d",), footprint=Ellipsoid(0.1, 0.1, 0.3, body=0.1))
    problem = Problem(team, [[-3, 0, 1, 0, 0, 0]], [[-3, 0, 1.5]], world, horizon=1, margin=0.05)
    away = body + gap
    for position in ([0, 0, 0.8 - away], [-2, 0, 2 - away], [-2, 0, away], [5.5, 0, 1 + away], [2.8 - away, 0, 1]):
        states = np.array([[*position, 0, 0, 0]], np.float32)
        for engine in ENGINE_NAMES:
            after = get_engine(engine).step(problem.arrays, states, np.zeros(1, bool), np.zeros((1, 3), np.float32))
            assert bool(after.collided[0]) == (gap < 0), (position, engine)
            assert after.margin_violated[0]
        report = verify(problem.with_state(states, problem.goal), np.zeros((1, 1, 3), np.float32))
        assert report.min_clearance == pytest.approx(gap, abs=1e-6)
        pose = np.append(np.array(position), 0.0)
        assert world_gap(world, team.footprint[0], pose) == pytest.approx(gap, abs=1e-3)
    env = navigation_v0.parallel_env(problem=problem, observed_obstacles=1)
    seen = env.reset(seed=0)[0]["robot_0"]
    assert np.isclose(seen, 0.9).any()  # 1 m above the floor


def test_ellipsoids_meet_other_robots_whatever_these_are() -> None:
    """Over another ellipsoid with or without a body, and over a ball."""
    for other, reach in ((Ellipsoid(0.1, 0.1, 0.3, 0.1), 0.3), (Ellipsoid(0.2, 0.1, 0.25), 0.25), (Disc(0.15), 0.15)):
        for gap in (0.01, -0.01):
            team = Team(("holonomic3d",) * 2, footprint=[Ellipsoid(0.1, 0.1, 0.3, 0.1), other])
            states = np.array([[0] * 6, [0, 0, 0.3 + reach + gap, 0, 0, 0]], np.float32)
            problem = Problem(team, [[0] * 6, [9, 0, 0, 0, 0, 0]], [[0, 9, 0], [9, 9, 0]], horizon=1)
            for engine in ENGINE_NAMES:
                still = np.zeros(2, bool), np.zeros((2, 3), np.float32)
                after = get_engine(engine).step(problem.arrays, states, *still)
                assert after.collided.tolist() == [gap < 0] * 2
            report = verify(problem.with_state(states, problem.goal), np.zeros((1, 2, 3), np.float32))
            assert report.min_separation == pytest.approx(gap, abs=1e-4)


@given(st.tuples(*[st.floats(0.05, 0.5)] * 4), st.tuples(*[st.floats(-1.2, 1.2)] * 3), st.floats(0, 0.3))
@settings(max_examples=60, deadline=None)
def test_flattened_balls_are_near_where_ellipsoids_are(
    sizes: tuple[float, ...], offset: tuple[float, ...], margin: float
) -> None:
    """Just there where all are alike, and where they are not, at least there."""
    (a, b, c, e), away = sizes, np.array(offset)
    for one, other in ((Ellipsoid(a, a, c), Ellipsoid(a, a, c)), (Ellipsoid(a, b, c), Ellipsoid(b, b, e)),
                       (Ellipsoid(a, a, c), Disc(e))):  # fmt: skip
        team = Team(("holonomic3d",) * 2, footprint=[one, other])
        flat = float(np.linalg.norm(team.flattened(away, margin)) - team.girth.sum()) - margin
        wider = [Ellipsoid(*(axis + margin / 2 for axis in shape.semi_axes)) for shape in (one, other)]
        gap = pair_gap(wider[0], np.zeros(4), wider[1], np.append(away, 0.0))
        assert flat <= 1e-3 or gap >= -1e-3
        if one == other and a <= c:
            assert (flat > 0) == (gap > 0) or abs(gap) < 1e-3


def test_a_body_is_kept_in_files_and_checked(tmp_path: Path) -> None:
    team = Team(("holonomic3d",) * 2, footprint=[Ellipsoid(0.1, 0.1, 0.3, body=0.08), Ellipsoid(0.1, 0.1, 0.3)])
    problem = Problem(team, [[0] * 6, [2, 0, 0, 0, 0, 0]], [[0, 3, 0], [2, 3, 0]])
    save_problem(problem, tmp_path / "team.yaml")
    assert load_problem(tmp_path / "team.yaml") == problem
    np.testing.assert_allclose(team.wall_radius, [0.08, 0.3])
    np.testing.assert_allclose(team.inner_radius, [0.08, 0.1], rtol=1e-5)
    assert repr(team.shapes[1]) == "Ellipsoid(x=0.1, y=0.1, z=0.3)"  # of which digests are made
    with pytest.raises(ValueError, match=r"body of Ellipsoid is 0\.2; its ball must be within the ellipsoid, 0\.1 at"):
        Ellipsoid(0.1, 0.1, 0.3, body=0.2)


def test_discs_given_as_footprints_are_the_same_team() -> None:
    problem = make_problem("circle", num_robots=4)
    other = problem.replace(team=problem.team.replace(footprint=Disc(0.15)))
    assert other == problem
    assert not other.team.shapes
    assert other.team.footprint == (Disc(float(np.float32(0.15))),) * 4


def test_radius_and_footprint_follow_from_each_other() -> None:
    team = Team(("unicycle",) * 2, footprint=[Box(0.8, 0.6), Disc(0.2)])
    np.testing.assert_allclose(team.radius, [0.5, 0.2])
    np.testing.assert_allclose(team.inner_radius, [0.3, 0.2], rtol=1e-5)
    assert team.replace(max_speed=0.5).footprint == team.footprint
    assert not team.replace(radius=0.3).shapes
    assert team.select([0]).footprint == (Box(0.8, 0.6),)
    with pytest.raises(ValueError, match="is not that of the footprints"):
        Team(("unicycle",), radius=0.3, footprint=Box(0.8, 0.6))


def test_files_keep_footprints(tmp_path: object) -> None:
    problem = planar_problem()
    path = f"{tmp_path}/problem.yaml"
    save_problem(problem, path)
    assert load_problem(path) == problem
    assert load_problem(path).team.footprint == problem.team.footprint


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box(0, 1), "length of Box is 0; it must be positive"),
        (lambda: Disc(float("nan")), "radius of Disc is nan"),
        (lambda: Capsule(1, 1, offset="x"), "offset of Capsule must be a number, not 'x'"),
        (lambda: Box("1", 0.2), "length of Box must be a number, not '1'"),
        (lambda: Box(1, b"2"), "width of Box must be a number, not b'2'"),
        (lambda: Disc("1"), "radius of Disc must be a number, not '1'"),
        (lambda: Capsule(1, "1e-1"), "radius of Capsule must be a number, not '1e-1'"),
        (lambda: Ellipsoid(1, 1, np.str_("1")), "z of Ellipsoid must be a number, not "),
        (
            lambda: Polygon([[0, 0], [1, "0"], [0, 1]]),
            "corners of Polygon must be rows of two numbers, not [[0, 0], [1, '0']",
        ),
        (
            lambda: Polygon(np.array([["0", "0"], ["1", "0"], ["0", "1"]])),
            "corners of Polygon must be rows of two numbers",
        ),
        (lambda: Polygon([[0, 0], [True, 0], [0, 1]]), "corners of Polygon must be rows of two numbers"),
        (lambda: Polygon([[0, 0], [1, 0]]), "corners of Polygon have shape (2, 2); expected (n, 2), n from 3 to 8"),
        (
            lambda: Polygon([[0, 0], [1, 0], [0.2, 0.2], [0, 1]]),
            "Polygon is not convex at corner 2, [0.2, 0.2]; give the corners of its convex hull",
        ),
        (lambda: Polygon([[np.cos(4 * np.pi * i / 5), np.sin(4 * np.pi * i / 5)] for i in range(5)]), "not convex"),
        (
            lambda: Team(("unicycle",) * 2, footprint=[Disc(1)]),
            "footprint has 1 entries for 2 robots; give one for each, such as Box",
        ),
        (lambda: Team(("unicycle",), footprint=Ellipsoid(1, 1, 1)), "lies in 3 dimensions and the team moves in 2"),
        (lambda: Team(("holonomic3d",), footprint=Box(1, 1)), "lies in 2 dimensions and the team moves in 3"),
        (lambda: Team(("unicycle",), footprint=["box"]), "footprint of robot_0 is 'box'; give one such as Box"),
    ],
)
def test_what_is_wrong_is_told(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        make()  # type: ignore[operator]


def test_a_footprint_that_does_not_fit_its_start_is_told() -> None:
    team = Team(("unicycle",) * 2, footprint=Box(1.0, 0.2))
    Problem(team, [[0, 0, 0], [0, 0.3, 0]], [[0, 3], [3, 0.3]])
    with pytest.raises(ValueError, match=r"starts of robot_0 .* and robot_1 .* overlap by 0.4 m; move them apart"):
        Problem(team, [[0, 0, 0], [0, 0.2, np.pi / 2]], [[0, 3], [3, 0.3]])
    world = World(boxes=[[0.45, -1, 2, 1]])
    with pytest.raises(ValueError, match=r"start of robot_0 .* is 0.05 m inside an obstacle .*Box\(length=1.0"):
        Problem(team, [[0, 0, 0], [-3, 0.3, 0]], [[0, 3], [3, 3]], world)


def test_the_environment_goes_by_footprints() -> None:
    team = Team(("differential_drive",) * 2, footprint=Box(1.0, 0.2))
    start, goal = [[0, 0, 0, 0], [0, 0.3, 0, 0]], [[0, 3], [3, 0.3]]
    env = navigation_v0.parallel_env(problem=Problem(team, start, goal, goal_heading=0.0))
    _, infos = env.reset(seed=0)
    assert not infos["robot_0"]["collided"]
    assert infos["robot_0"]["contacts"] == []
    for _ in range(10):
        infos = env.step({"robot_0": np.array([1.5, 0], np.float32), "robot_1": np.zeros(2, np.float32)})[-1]
    assert infos["robot_0"]["collided"]
    assert infos["robot_1"]["collided"]
    assert infos["robot_0"]["contacts"] == ["robot_1"]


def ellipsoids_problem() -> Problem:
    team = Team(("holonomic3d",) * 4, footprint=Ellipsoid(0.12, 0.1, 0.3))
    start = np.pad(np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]), ((0, 0), (0, 3)))
    world = World(
        3, spheres=[[1, 0, 0.5, 0.2]], cylinders=[[-1, 0, 0.2]], boxes=[[-0.2, -1.2, -1, 0.2, -0.9, 1]],
        lower=[-2, -2, -2], upper=[2, 2, 2],
    )  # fmt: skip
    return Problem(team, start, -start[:, :3], world, horizon=60)


@pytest.mark.parametrize("make", [lambda: planar_problem(horizon=60), ellipsoids_problem])
def test_discs_and_balls_round_bodies_hide_no_gap_from_the_judge(
    make: Callable[[], Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, contacts = make(), set()
    held = np.random.default_rng(0).normal(size=(3, 6, problem.num_robots, problem.control_size))
    plans = np.repeat(held, 10, axis=1)
    reports = [verify(problem, plan) for plan in plans]
    for watch in (TurningPairs, Obstacles, Sides):
        monkeypatch.setattr(watch, "outer_gap", lambda self, pairs, *positions: np.full(len(pairs), -np.inf))
    for plan, report in zip(plans, reports, strict=True):
        everything = verify(problem, plan)
        contacts |= {violation.kind for violation in report.violations}
        assert [str(violation) for violation in report.violations] == [str(other) for other in everything.violations]
        assert report.min_separation == pytest.approx(everything.min_separation, abs=1e-9)
        assert report.min_clearance == pytest.approx(everything.min_clearance, abs=1e-9)
    assert contacts >= {"robot contact", "obstacle contact", "bounds contact"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"shape": "box", "length": 0.3}, "footprint box lacks width; it has length, width, offset"),
        ({"shape": "disc", "radus": 0.3}, "footprint disc: field 'radus' is unknown; choose one of radius; did you"),
        ({"shape": "train", "front": {"shape": "disc", "radius": 0.1}}, "footprint train lacks trailers; it has front"),
    ],
)
def test_fields_of_a_footprint_in_a_file_are_checked(content: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        parsed(content)


@pytest.mark.parametrize("trailers", [3, None, "box", {"shape": "disc", "radius": 0.1}])
def test_trailers_in_a_file_are_a_list(trailers: object) -> None:
    told = re.escape(f"trailers of Train are {trailers!r}; give a list of footprints, one each")
    with pytest.raises(ValueError, match=told):
        parsed({"shape": "train", "front": {"shape": "disc", "radius": 0.1}, "trailers": trailers})


def test_what_is_no_team_or_no_polygon_is_told() -> None:
    with pytest.raises(ValueError, match=r"team is 5; give a Team, as make_team\(\) returns"):
        Problem(5, [[0]], [[0]])  # type: ignore[arg-type]
    for polygons, told in ((5, "5"), ("", "''"), ({}, "{}")):
        with pytest.raises(ValueError, match=f"polygons must be a list of polygons, .*, not {told}"):
            World(polygons=polygons)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, int])
def test_any_kind_of_number_makes_the_same_footprint(kind: type, tmp_path: Path) -> None:
    footprint = Box(kind(1), kind(2), kind(1))
    assert footprint == Box(1.0, 2.0, 1.0)
    assert repr(footprint) == repr(Box(1.0, 2.0, 1.0))
    problem = Problem(Team(("unicycle",), footprint=footprint), [[0, 0, 0]], [[5, 0]])
    save_problem(problem, tmp_path / "box.yaml")
    assert load_problem(tmp_path / "box.yaml") == problem


def test_discs_among_other_footprints_survive_a_file(tmp_path: Path) -> None:
    footprints = [Disc(1 / 3), Box(0.4, 0.2), Disc(0.1 + 0.2)]
    team = Team(("velocity2d", "unicycle", "unicycle"), footprint=footprints)
    problem = Problem(team, [[0, 0, 0], [2, 0, 0], [4, 0, 0]], [[0, 3], [2, 3], [4, 3]])
    save_problem(problem, tmp_path / "team.yaml")
    assert load_problem(tmp_path / "team.yaml") == problem
    with pytest.raises(ValueError, match="offset of Box must be a number, not True"):
        Box(0.5, 0.2, True)


@pytest.mark.parametrize(
    ("obstacles", "gap"),
    [
        ({"spheres": [[1, 0, 0, 0.2]]}, 0.7),
        ({"cylinders": [[0, -1, 0.2]]}, 0.6),
        ({"boxes": [[-1, -1, 0.5, 1, 1, 2]]}, 0.2),
        ({"boxes": [[-2, -1, -1, -1, 1, 1]]}, 0.9),
    ],
)  # fmt: skip
def test_gaps_of_ellipsoids_along_their_axes(obstacles: Any, gap: float) -> None:
    """Of semi-axes 0.1, 0.2, 0.3 m at the origin: that much less than to the obstacle."""
    world = World(3, **obstacles)
    assert world_gap(world, Ellipsoid(0.1, 0.2, 0.3), np.zeros(4)) == pytest.approx(gap, abs=1e-3)


@pytest.mark.parametrize(
    ("obstacles", "gap"),
    [
        ({"spheres": [[3, 1, 3, 0.2]]}, 0.7),
        ({"cylinders": [[2, 0, 0.2]]}, 0.6),
        ({"boxes": [[1, 0, 3.5, 3, 2, 5]]}, 0.2),
        ({"lower": [-9, -9, 2], "upper": [9, 9, 9]}, 0.7),
        ({"lower": [-9, -9, -9], "upper": [2.5, 9, 9]}, 0.4),
    ],
)  # fmt: skip
def test_gaps_of_ellipsoids_elsewhere(obstacles: Any, gap: float) -> None:
    """The same one at (2, 1, 3)."""
    pose = np.array([2.0, 1.0, 3.0, 0.0])
    assert world_gap(World(3, **obstacles), Ellipsoid(0.1, 0.2, 0.3), pose) == pytest.approx(gap, abs=1e-3)


@pytest.mark.parametrize(
    ("lower", "upper", "gap"),
    [([-0.5, -9], [9, 9], 0.2), ([-9, -0.7], [9, 9], 0.6), ([-9, -9], [0.6, 9], 0.3), ([-9, -9], [9, 0.9], 0.8)],
)
def test_round_ends_come_nearer_to_every_side_of_the_bounds(lower: list[float], upper: list[float], gap: float) -> None:
    """Of a capsule at the origin that reaches 0.3 m ahead and behind, and 0.1 m to either side."""
    assert world_gap(World(lower=lower, upper=upper), Capsule(0.4, 0.1), np.zeros(3)) == pytest.approx(gap)
