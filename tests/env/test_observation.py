"""Observations: every component as a number on small problems, and inside its bounds everywhere a robot can get."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from engine_support import observe_team, random_controls
from env_support import mixed_problem
from hypothesis import given, settings
from hypothesis import strategies as st

from d4orm_env.core.observation import Sensed, _gap_to_triangle, insert_nearest, observe_obstacles, observe_robot
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine.cpu import CpuEngine
from d4orm_env.scenarios import make_problem

ENGINE = CpuEngine()


def observe(
    problem: Problem,
    states: Any = None,
    controls: Any = None,
    arrived: Any = None,
    time_left: float = 0.75,
    **sizes: int,
) -> list[dict[str, float]]:
    """Every robot's observation, by component name."""
    layout = ObservationLayout.for_problem(problem, **sizes)
    states = problem.start if states is None else np.array(states, np.float32)
    controls = np.zeros((problem.num_robots, problem.control_size)) if controls is None else np.array(controls)
    arrived = np.zeros(problem.num_robots, bool) if arrived is None else np.array(arrived)
    values = observe_team(problem.arrays, layout, states, controls.astype(np.float32), arrived, time_left)
    assert values.dtype == np.float32
    assert values.shape == (problem.num_robots, layout.size)
    assert (layout.low <= values).all()
    assert (values <= layout.high).all()
    return [dict(zip(layout.names, row.tolist(), strict=True)) for row in values]


def part(observation: dict[str, float], prefix: str) -> dict[str, float]:
    """The components of one neighbour or obstacle."""
    return {name.removeprefix(prefix + "."): value for name, value in observation.items() if name.startswith(prefix)}


def close(expected: dict[str, float]) -> Any:
    return pytest.approx(expected, abs=1e-5)


PLANAR = Problem(
    Team(("holonomic2d",) * 3, radius=[0.25, 0.5, 0.375], max_speed=[1.0, 2.0, 3.0], max_acceleration=[0.5, 0.75, 1.5]),
    [[0, 0, 0.6, -0.8], [0, 3, 0, 1], [-1, 0, 0, 0]],
    [[4, 2], [0, 6], [-4, -2]],
    World(2, circles=[[3, -4, 1]], boxes=[[-1, 1, 1, 2]], lower=[-6, -7], upper=[9, 8]),
)


def test_a_robot_sees_itself_and_its_goal() -> None:
    own = {name: value for name, value in observe(PLANAR)[0].items() if "." not in name}
    assert own == close(
        {
            "velocity_x": 0.6,
            "velocity_y": -0.8,
            "heading_cos": 0,
            "heading_sin": 0,
            "speed": 1,
            "goal_x": 4,
            "goal_y": 2,
            "time_left": 0.75,
            "arrived": 0,
            "radius": 0.25,
            "max_speed": 1,
            "max_acceleration": 0.5,
        }
    )
    assert len(own) == 8 + 4


def test_neighbours_come_nearest_first_relative_to_the_robot() -> None:
    first = observe(PLANAR, num_neighbors=2)[0]
    assert part(first, "neighbor_0") == close(
        {"present": 1, "position_x": -1, "position_y": 0, "velocity_x": -0.6, "velocity_y": 0.8, "radius": 0.375}
    )
    assert part(first, "neighbor_1") == close(
        {"present": 1, "position_x": 0, "position_y": 3, "velocity_x": -0.6, "velocity_y": 1.8, "radius": 0.5}
    )


def test_neighbours_that_do_not_fit_are_left_out_and_absent_ones_are_zeros() -> None:
    only = observe(PLANAR, num_neighbors=1)[1]
    assert part(only, "neighbor_0")["position_y"] == -3  # robot 0 at a distance of 3, robot 2 at the root of 10
    assert "neighbor_1.present" not in only
    many = observe(PLANAR, num_neighbors=4)[0]
    for i in (2, 3):
        assert set(part(many, f"neighbor_{i}").values()) == {0.0}
    assert [part(many, f"neighbor_{i}")["present"] for i in range(4)] == [1, 1, 0, 0]


def test_obstacles_and_walls_come_nearest_first() -> None:
    first = observe(PLANAR, num_obstacles=7)[0]
    # The box's face is 1 m above, the circle's surface 4 m off along (3, -4) / 5, then the walls at -6, -7, 8 and 9.
    expected = [(0, 1, 0.75), (2.4, -3.2, 3.75), (-6, 0, 5.75), (0, -7, 6.75), (0, 8, 7.75), (9, 0, 8.75)]
    for i, (x, y, gap) in enumerate(expected):
        assert part(first, f"obstacle_{i}") == close({"present": 1, "position_x": x, "position_y": y, "gap": gap})
    assert set(part(first, "obstacle_6").values()) == {0.0}


def test_polygons_are_seen_among_other_obstacles() -> None:
    triangles = [[(-1, 1), (1, 1), (0, 2)], [(-5, 0), (-6, 1), (-6, -1)], [(0, -7), (-1, -8), (1, -8)]]
    world = World(2, circles=[[3, -4, 1]], polygons=triangles)
    seen = observe(PLANAR.replace(world=world), num_obstacles=4)[0]
    # A side 1 m above, the circle as before, and then two corners.
    for i, (x, y, gap) in enumerate([(0, 1, 0.75), (2.4, -3.2, 3.75), (-5, 0, 4.75), (0, -7, 6.75)]):
        assert part(seen, f"obstacle_{i}") == close({"present": 1, "position_x": x, "position_y": y, "gap": gap})


def test_the_nearest_point_of_a_box_may_be_its_corner() -> None:
    obstacle = part(observe(PLANAR, [[4, 6, 0, 0], [0, 3, 0, 1], [-5, 0, 0, 0]])[0], "obstacle_1")
    # From (4, 6) to the corner (1, 2): 5 m; the upper wall at 2 m comes before it.
    assert obstacle == close({"present": 1, "position_x": -3, "position_y": -4, "gap": 4.75})


def test_inside_an_obstacle_the_gap_is_negative_and_the_point_lies_outward() -> None:
    obstacle = part(observe(PLANAR, [[3, -3.5, 0, 0], [0, 3, 0, 1], [-5, 0, 0, 0]])[0], "obstacle_0")
    # Half a metre above the centre of the circle of radius 1: its surface is half a metre further up.
    assert obstacle == close({"present": 1, "position_x": 0, "position_y": 0.5, "gap": -0.75})


def test_a_robot_at_the_centre_of_a_circle_gets_numbers() -> None:
    obstacle = part(observe(PLANAR, [[3, -4, 0, 0], [0, 3, 0, 1], [-5, 0, 0, 0]])[0], "obstacle_0")
    assert obstacle["gap"] == pytest.approx(-1.25)
    assert all(math.isfinite(value) for value in obstacle.values())


def test_a_differential_drive_has_a_heading() -> None:
    problem = Problem(Team(("differential_drive",)), [[1, 2, 2 * math.pi / 3, -0.5]], [[1, 5]])
    own = observe(problem, controls=[[1.0, 1.0]], num_neighbors=0, num_obstacles=0)[0]
    # Driving backwards at half a metre per second along (-1/2, sqrt(3)/2).
    assert own == close(
        {
            "velocity_x": 0.25,
            "velocity_y": -math.sqrt(3) / 4,
            "heading_cos": -0.5,
            "heading_sin": math.sqrt(3) / 2,
            "speed": 0.5,
            "goal_x": 0,
            "goal_y": 3,
            "time_left": 0.75,
            "arrived": 0,
            "radius": 0.15,
            "max_speed": 1,
            "max_acceleration": 1,
        }
    )


def test_the_velocity_of_a_first_order_robot_is_its_last_control() -> None:
    problem = Problem(Team(("velocity2d",) * 2), [[0, 0], [2, 0]], [[0, 5], [2, 5]])
    first, second = observe(problem, controls=[[0.3, 0.4], [-0.6, 0]], num_neighbors=1)
    assert (first["velocity_x"], first["velocity_y"], first["speed"]) == pytest.approx((0.3, 0.4, 0.5))
    assert part(second, "neighbor_0")["velocity_x"] == pytest.approx(0.9)


def test_a_docked_robot_is_seen_at_rest() -> None:
    problem = Problem(Team(("velocity2d",) * 2), [[0, 0], [2, 0]], [[0, 5], [2, 5]])
    first, second = observe(problem, controls=[[0.3, 0.4], [0.6, 0]], arrived=[False, True], num_neighbors=1)
    assert (second["arrived"], second["velocity_x"], second["speed"]) == (1, 0, 0)
    assert part(first, "neighbor_0")["velocity_x"] == pytest.approx(-0.3)


def test_space() -> None:
    world = World(3, spheres=[[2, 3, 6, 1]], cylinders=[[0, -5, 1]], boxes=[[-9, -9, -9, -3, 9, 9]])
    team = Team(("holonomic3d",) * 2, radius=0.5)
    start = [[0, 0, 0, 0.2, 0.3, 0.6], [1, 2, -2, 0, 0, 0]]
    first = observe(Problem(team, start, [[1, 0, 9], [1, 9, 0]], world), num_neighbors=1)[0]
    assert first["speed"] == pytest.approx(0.7)
    assert [first[f"velocity_{axis}"] for axis in "xyz"] == pytest.approx([0.2, 0.3, 0.6])
    assert [first[f"goal_{axis}"] for axis in "xyz"] == [1, 0, 9]
    assert part(first, "neighbor_0") == close(
        {
            "present": 1,
            "position_x": 1,
            "position_y": 2,
            "position_z": -2,
            "velocity_x": -0.2,
            "velocity_y": -0.3,
            "velocity_z": -0.6,
            "radius": 0.5,
        }
    )
    expected = [(-3, 0, 0, 2.5), (0, -4, 0, 3.5), (12 / 7, 18 / 7, 36 / 7, 5.5)]
    for i, (x, y, z, gap) in enumerate(expected):
        assert part(first, f"obstacle_{i}") == close(
            {"present": 1, "position_x": x, "position_y": y, "position_z": z, "gap": gap}
        )
    assert part(first, "obstacle_3")["present"] == 0


@pytest.mark.parametrize("sizes", [(0, 0), (1, 0), (0, 2), (4, 4), (7, 3)])
def test_names_and_bounds_have_the_layouts_size(sizes: tuple[int, int]) -> None:
    for problem, d in ((PLANAR, 2), (make_problem("sphere", num_robots=3), 3)):
        layout = ObservationLayout.for_problem(problem, *sizes)
        assert layout.size == 2 * d + 8 + sizes[0] * (2 + 2 * d) + sizes[1] * (2 + d)
        assert len(layout.names) == len(set(layout.names)) == len(layout.high) == layout.size
        assert layout.names.index("heading_cos") == d
        assert np.isfinite(layout.low).all()
        assert (layout.low < layout.high).all()
        for name, low, high in zip(layout.names, layout.low, layout.high):
            if name.endswith(("present", "time_left", "arrived")):
                assert (low, high) == (0, 1)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"num_neighbors": -1}, "num_neighbors is -1; it must be at least 0"),
        ({"num_obstacles": 1.5}, "num_obstacles must be a whole number, not 1.5"),
    ],
)
def test_bad_sizes_are_refused(sizes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ObservationLayout.for_problem(PLANAR, **sizes)


def test_a_layout_cannot_be_changed() -> None:
    layout = ObservationLayout.for_problem(PLANAR)
    with pytest.raises(ValueError, match="read-only"):
        layout.high[0] = 1


@given(keys=st.lists(st.integers(0, 9), max_size=12), size=st.integers(0, 5), data=st.data())
def test_insert_nearest_keeps_the_smallest_in_order(keys: list[int], size: int, data: st.DataObject) -> None:
    table = np.full((size, 2), np.inf)
    for number in data.draw(st.permutations(range(len(keys)))):
        insert_nearest(keys[number], number, table)
    # Of equal keys the one with the lower number comes first, whichever came first.
    expected = sorted(range(len(keys)), key=lambda number: (keys[number], number))[:size]
    count = len(expected)
    assert table[:count, 1].tolist() == expected
    assert table[:count, 0].tolist() == [keys[number] for number in expected]
    assert np.isinf(table[count:, 0]).all()


def scattered(dimension: int, **shapes: Any) -> Problem:
    team = Team(("holonomic2d" if dimension == 2 else "holonomic3d",) * 8)
    start = np.zeros((8, 2 * dimension))
    start[:, 0], start[:, 1] = 5, 0.5 * np.arange(8)
    return Problem(team, start, start[:, :dimension] + [1, *[0] * (dimension - 1)], world=World(dimension, **shapes))


def boxes(random: np.random.Generator, dimension: int) -> Any:
    low = random.uniform(-3, 3, (60, dimension))
    return np.hstack([low, low + random.uniform(0.1, 1, (60, dimension))])


def balls(random: np.random.Generator, dimension: int) -> Any:
    return np.hstack([random.uniform(-3, 3, (60, dimension)), random.uniform(0.1, 0.5, (60, 1))])


RANDOM = np.random.default_rng(0)
SCATTERED = {
    "boxes and circles": scattered(2, boxes=boxes(RANDOM, 2), circles=balls(RANDOM, 2)),
    "polygons": scattered(2, polygons=[np.add([(0, 0), (1, 0.2), (0.3, 0.8)], (i - 4, -i % 3)) for i in range(8)]),
    "spheres and boxes": scattered(3, boxes=boxes(RANDOM, 3), spheres=balls(RANDOM, 3)),
    "cylinders": scattered(3, cylinders=balls(RANDOM, 2)),
    "cylinders and spheres": scattered(3, cylinders=balls(RANDOM, 2)[:20], spheres=balls(RANDOM, 3)),
    "maze": make_problem("maze", num_robots=8, seed=0),
}


@pytest.mark.parametrize("name", SCATTERED)
def test_the_nearest_obstacles_are_found_from_any_distance(name: str) -> None:
    problem = SCATTERED[name]
    layout = ObservationLayout.for_problem(problem, 0, 4)
    robots, d = problem.num_robots, problem.dimension
    random = np.random.default_rng(1)
    assert problem.arrays_to_observe(4).grid.nearest == 4
    assert problem.arrays.grid.nearest < 4  # so that all are looked at
    for distance in np.repeat([0.5, 3, 5, 10, 20, 40, 80, 160, 1e4], 20):
        state = np.zeros_like(problem.start)
        state[:, :d] = random.uniform(-distance, distance, (robots, d))
        seen = [
            observe_team(arrays, layout, state, np.zeros((robots, d)), np.zeros(robots, bool), 0.5)
            for arrays in (problem.arrays, problem.arrays_to_observe(4))
        ]
        np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize("goal_heading", [None, [math.nan, 2.0, math.nan]])
def test_the_plain_function_and_the_compiled_one_agree(goal_heading: Any) -> None:
    world = World(2, circles=[[5, 5, 1]], boxes=[[-4, -4, -3, -3]])
    problem = mixed_problem().replace(goal_heading=goal_heading, world=world)
    layout = ObservationLayout.for_problem(problem, 3, 3)
    controls = random_controls(problem, 0)[0]
    compiled = observe_team(problem.arrays, layout, problem.start, controls, np.zeros(3, bool), 0.5)
    position = problem.start[:, :2]
    # By hand: the velocity2d robot moves as told, the drive heads along angle 0.5 at rest.
    velocity = np.array([controls[0], [0, 0], problem.start[2, 2:]], np.float32)
    heading = np.array([[0, 0], [math.cos(0.5), math.sin(0.5)], [0, 0]], np.float32)
    plain = np.empty_like(compiled)
    sensed = Sensed(
        position,
        velocity,
        np.asarray(problem.team.radius),
        heading,
        np.zeros(3),
        np.zeros(3, bool),
        np.empty((5, 1)),
        np.empty((3, 2)),
        np.empty((3, 2)),
    )
    for k in range(3):
        first = observe_robot(k, problem.arrays, problem.goal, sensed, 0.5, plain[k])
        observe_obstacles(k, problem.arrays, sensed, first, plain[k])
    np.testing.assert_allclose(np.clip(plain, layout.low, layout.high), compiled, atol=1e-6)


DASH = Problem(Team(("holonomic2d",) * 2, max_acceleration=10), [[-1, 0, 0, 0], [1, 0, 0, 0]], [[1, 0], [-1, 0]])
"""Within a step these robots get well beyond the speed limit, which is applied at its end."""

REACHES = [
    DASH,
    PLANAR,
    mixed_problem(),
    make_problem("amswarm_5", horizon=40),
    make_problem("random", num_robots=4, num_obstacles=3, model="differential_drive", horizon=40),
]


def unclipped(problem: Problem, controls: Any, layout: ObservationLayout, every: int) -> list[np.ndarray]:
    """Observations along a rollout, without the engine's clipping to the layout's bounds."""
    trajectory = ENGINE.rollout(problem, controls)
    unbounded = np.full(layout.size, np.inf, np.float32)
    loose = dataclasses.replace(layout, low=-unbounded, high=unbounded)
    return [
        observe_team(
            problem.arrays, loose, trajectory.states[t + 1], trajectory.controls[t], trajectory.arrived[t + 1],
            1 - (t + 1) / problem.horizon,
        )
        for t in range(every - 1, problem.horizon, every)
    ]  # fmt: skip


def components_outside(layout: ObservationLayout, values: np.ndarray) -> list[str]:
    slack = 1e-5 * np.maximum(1, layout.high)
    outside = (values < layout.low - slack) | (values > layout.high + slack)
    return [layout.names[i] for i in np.flatnonzero(outside.any(axis=0))]


def test_robots_that_race_apart_stay_in_bounds() -> None:
    controls = np.tile([[-10.0, 0.0], [10.0, 0.0]], (DASH.horizon, 1, 1))
    layout = ObservationLayout.for_problem(DASH)
    (last,) = unclipped(DASH, controls, layout, DASH.horizon)
    # 0.15 m a step: 0.1 m at the speed limit, and 0.05 m of acceleration beyond it; less 0.1 m in the first step.
    assert last[0, layout.names.index("neighbor_0.position_x")] == pytest.approx(2 + 2 * (15 - 0.1), abs=1e-3)
    assert components_outside(layout, last) == []


@pytest.mark.parametrize("problem", REACHES, ids=["dash", "bounded", "mixed", "space", "drives"])
@settings(max_examples=100)
@given(data=st.data())
def test_wherever_robots_get_observations_keep_their_bounds(problem: Problem, data: st.DataObject) -> None:
    """The engine clips to the bounds; what is checked is that no clip is ever needed, but for rounding."""
    layout = ObservationLayout.for_problem(problem)
    seed, scale = data.draw(st.integers(0, 2**31)), data.draw(st.floats(0, 5))
    for values in unclipped(problem, random_controls(problem, seed, scale), layout, 7):
        assert components_outside(layout, values) == []


@pytest.mark.parametrize(
    ("position", "expected"),
    [((0.3, 0.3), (0, 0, 0)), ((-0.5, 0.2), (0.5, 0.5, 0)), ((1.0, 1.0), (0.5**0.5, -0.5, -0.5))],
)
def test_the_nearest_point_of_a_triangle(position: Any, expected: Any) -> None:
    """Distance and the way to it; nothing from within."""
    found = _gap_to_triangle(np.array(position), np.array([0.0, 0, 1, 0, 0, 1]))
    np.testing.assert_allclose(found, expected, atol=1e-12)
