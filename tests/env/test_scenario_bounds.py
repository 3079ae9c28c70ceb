"""Open scenarios with bounds: around where robots start and end, or as they are given."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import WALLED, needed, scenario_models
from hypothesis import assume, given
from hypothesis import strategies as st

from d4orm_env import load_problem, navigation_v0, save_problem
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.scenarios import make_problem

BOUNDED = (*WALLED, *(f"amswarm_{index}" for index in range(1, 6)))
OPEN = [case for case in scenario_models() if case[0] not in BOUNDED]


@pytest.mark.parametrize(("name", "model"), OPEN)
def test_a_margin_lies_around_where_robots_start_and_end(name: str, model: str | None) -> None:
    first, other = (make_problem(name, model=model, seed=seed, bounds=0.75) for seed in (0, 1))
    positions = np.vstack([first.start[:, : first.dimension], first.goal])
    lower, upper = first.world.bounds
    assert (lower <= positions.min(axis=0) - 0.7499).all()
    assert (upper >= positions.max(axis=0) + 0.7499).all()
    # Worlds that differ in their seed alone are stepped as one batch only if they have the same bounds.
    np.testing.assert_array_equal(other.world.bounds, first.world.bounds)
    np.testing.assert_array_equal(make_problem(name, model=model, seed=0).start, first.start)


def test_the_margin_of_the_circle() -> None:
    np.testing.assert_array_equal(make_problem("circle", bounds=0.5).world.bounds, [[-3, -3], [3, 3]])
    flat = make_problem("circle", model="holonomic3d", bounds=0.5)
    np.testing.assert_array_equal(flat.world.bounds, [[-3, -3, -0.5], [3, 3, 0.5]])


def test_corners_are_taken_as_they_are() -> None:
    box = ((-4, -3), (5, 3))
    np.testing.assert_array_equal(make_problem("random", bounds=box).world.bounds, box)


def test_random_obstacles_leave_a_passage_to_the_bounds() -> None:
    problem = make_problem("random", num_obstacles=20, bounds=0.3, seed=1)
    passage = 2 * (0.15 + problem.margin)
    centres, radii = problem.world.circles[:, :2], problem.world.circles[:, 2:]
    lower, upper = problem.world.bounds
    assert (np.minimum(centres - lower, upper - centres) - radii > passage).all()


def test_bounds_are_part_of_a_saved_problem(tmp_path: Path) -> None:
    problem = make_problem("swap", num_robots=4, bounds=0.6)
    save_problem(problem, tmp_path / "explicit.yaml")
    (tmp_path / "short.yaml").write_text("version: 1\nscenario: swap\nnum_robots: 4\nbounds: 0.6\n")
    assert load_problem(tmp_path / "explicit.yaml") == load_problem(tmp_path / "short.yaml") == problem


def test_every_environment_takes_them() -> None:
    arguments: dict[str, Any] = {"scenario": "circle", "num_robots": 1, "bounds": 0.5}
    env = navigation_v0.parallel_env(**arguments)
    many = gymnasium.make_vec("d4orm/Navigation-v0", 2, vectorization_mode="vector_entry_point", **arguments)
    for problem in (env.problem, JointNavigationEnv(**arguments).problem, many.unwrapped.problem):
        np.testing.assert_array_equal(problem.world.bounds, [[-3, -3], [3, 3]])


def test_a_robot_touches_them() -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=1, bounds=0.5)
    env.reset(seed=0)
    away = {"robot_0": np.array([1.0, 0.0], np.float32)}
    # It starts 0.35 m from them, surface to wall, and has come 0.32 m after eight steps, 0.405 m after nine.
    assert [env.step(away)[-1]["robot_0"]["collided"] for _ in range(9)] == [False] * 8 + [True]


@given(
    name=st.sampled_from(["circle", "random", "swap"]),
    num_robots=st.integers(1, 6),
    seed=st.integers(0, 3),
    corners=st.tuples(*(st.floats(-5, 5, width=32) for _ in range(4))),
)
def test_either_everybody_keeps_the_margin_or_somebody_is_named(
    name: str, num_robots: int, seed: int, corners: tuple[float, ...]
) -> None:
    lower, upper = corners[:2], corners[2:]
    plain = make_problem(name, num_robots, seed)
    positions = np.vstack([plain.start[:, :2], plain.goal]).astype(np.float64)
    room = (
        np.minimum(positions - lower, np.subtract(upper, positions)).min() - float(plain.team.radius[0]) - plain.margin
    )
    assume(abs(room) > 1e-5)
    if room > 0:
        problem = make_problem(name, num_robots, seed, bounds=(lower, upper))
        assert problem == plain.replace(world=problem.world)
    else:
        with pytest.raises(ValueError, match=r"use wider bounds|must lie below upper"):
            make_problem(name, num_robots, seed, bounds=(lower, upper))


BAD = [
    ("circle", 0.1, "the start of robot_0 at (2.5, 0) is 0.1 m inside the bounds 0.1, and its radius and the margin"),
    ("circle", [[-2, -3], [3, 3]], "robot_4 at (-2.5, 0) is 0.5 m outside the bounds .* use wider bounds"),
    ("sphere", [[-3, -3], [3, 3]], "bounds has shape (2, 2); expected (2, 3)"),
    ("circle", [[2, 2], [-2, 2]], "must lie below upper"),
    ("circle", [[1, 2], [3]], "bounds must be an array of numbers"),
    ("circle", [[-1e9, -1e9], [1e9, 1e9]], "magnitudes must be at most 10000"),
    ("circle", 0, "bounds is 0; it must be positive"),
    ("circle", math.nan, "bounds is nan"),
    ("circle", "wide", "bounds must be a number"),
    *((name, 1.0, "has bounds of its own and takes none, not 1.0") for name in BOUNDED),
]


@pytest.mark.parametrize(("name", "bounds", "message"), BAD)
def test_bad_bounds_are_named_in_one_line(name: str, bounds: Any, message: str) -> None:
    pattern = message.replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(ValueError, match=pattern) as error:
        make_problem(name, bounds=bounds, **needed(name))
    assert "\n" not in str(error.value)
