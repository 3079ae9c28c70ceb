"""Instances as dynobench and db-CBS write them, and results that a checker of their kind accepts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from d4orm_env import load_dynobench, load_problem, rollout, verify
from d4orm_env.footprints import Box, Disc
from d4orm_env.scenarios.dynobench import _turn_as_theirs, result_lines
from d4orm_env.scenarios.dynobench_types import MODELS, checked_types
from d4orm_planners import make_planner

INSTANCE = """
environment:
  min: [0, 0]
  max: [5, 4]
  obstacles:
    - {type: box, center: [2.5, 3.2], size: [0.4, 0.6]}
robots:
  - {type: unicycle_first_order_0, start: [1, 1.5, 0], goal: [4, 1.5, 0]}
  - {type: unicycle1_v0, start: [4, 1.6, 3.14], goal: [1, 1.6, 3.14]}
  - {type: double_integrator_0, start: [1, 3, 0, 0], goal: [4, 3, 0, 0]}
"""


@pytest.fixture
def instance(tmp_path: Path) -> Path:
    path = tmp_path / "swap.yaml"
    path.write_text(INSTANCE)
    return path


def test_an_instance_means_what_it_says(instance: Path) -> None:
    problem = load_dynobench(instance)
    assert problem.name == "swap"
    assert load_problem(instance) == problem
    assert problem.team.models == ("unicycle", "unicycle", "holonomic2d")
    assert problem.team.footprint == (Box(0.5, 0.25), Box(0.5, 0.25), Disc(0.1))
    np.testing.assert_allclose(problem.start[1, :3], [4, 1.6, 3.14], rtol=1e-6)
    np.testing.assert_allclose(problem.goal_heading[:2], [0, 3.14], rtol=1e-6)
    assert np.isnan(problem.goal_heading[2])
    np.testing.assert_allclose(problem.world.boxes, [[2.3, 2.9, 2.7, 3.5]], rtol=1e-6)
    np.testing.assert_allclose(problem.world.bounds, [[-0.1, -0.1], [5.1, 4.1]], rtol=1e-5)
    assert problem.arrival == "stay"
    assert (problem.dt, problem.margin, problem.goal_radius) == (0.1, 0.0, 0.01)
    np.testing.assert_allclose(problem.team.max_acceleration[2], 2.0)
    np.testing.assert_allclose(problem.team.max_turn_rate[:2], 0.5)


def test_a_robot_may_end_on_either_side_of_a_goal_on_the_bounds(instance: Path) -> None:
    """No motion ends exactly there; the checkers let a state leave the bounds by 0.01."""
    instance.write_text(INSTANCE.replace("goal: [4, 3, 0, 0]", "goal: [5, 3, 0, 0]"))
    problem = load_dynobench(instance)
    np.testing.assert_allclose(problem.world.bounds, [[-0.1, -0.1], [5.105, 4.1]], rtol=1e-6)
    alone = problem.select([2])
    plan = make_planner().solve(alone, seed=0, time_limit=60)
    assert verify(alone, plan.controls).ok


def test_a_solution_passes_a_check_of_their_kind(instance: Path, tmp_path: Path) -> None:
    """Euler steps of theirs lead from each state to the next within 0.01; starts, goals and limits are kept."""
    problem = load_dynobench(instance)
    plan = make_planner("hybrid").solve(problem, seed=0, time_limit=60)
    assert plan.solved
    plan.to_dynobench(tmp_path / "result.yaml")
    result = yaml.safe_load((tmp_path / "result.yaml").read_text())["result"]
    for entry, given in zip(yaml.safe_load(INSTANCE)["robots"], result, strict=True):
        states, actions = np.array(given["states"]), np.array(given["actions"])
        assert len(states) == len(actions) + 1
        np.testing.assert_allclose(states[0], entry["start"], atol=1e-5)
        turns = states.shape[1] == 3
        missed = states[-1] - entry["goal"]
        assert np.abs(missed).max() <= 0.01 + 1e-4  # headings on either side of pi are far apart for theirs
        following = states[:-1].copy()
        if turns:
            rates = np.column_stack([actions[:, 0] * np.cos(states[:-1, 2]), actions[:, 0] * np.sin(states[:-1, 2])])
            following += 0.1 * np.column_stack([rates, actions[:, 1]])
            assert np.abs(actions).max() <= 0.5 + 1e-6
        else:
            following += 0.1 * np.column_stack([states[:-1, 2:], actions])
            assert np.abs(actions).max() <= 2.0 + 1e-6
        if turns:
            following[:, 2] = (following[:, 2] + np.pi) % (2 * np.pi) - np.pi
        gap = states[1:] - following
        assert np.abs(gap[:-1]).max() <= 0.0101  # the last one ends at rest


@pytest.mark.parametrize(
    ("headings", "rates", "end", "written"),
    [
        ([3.1, 3.1401, -3.1412], [0.4, 0.01], np.nan, [3.1, 3.1401, 3.14159]),  # theirs is at 3.1411
        ([3.05, 3.1, -3.139], [0.5, 0.44], 3.14, [3.05, 3.09659, 3.14159]),  # and goals are compared without turns
        ([3.05, 3.1, -3.1], [0.5, 0.83], 3.14, [3.05, 3.1, -3.1]),  # too far from there
    ],
)
def test_headings_beside_half_a_turn_are_on_their_side(
    headings: list[float], rates: list[float], end: float, written: list[float]
) -> None:
    found = np.array(headings)
    _turn_as_theirs(found, np.array(rates), end)
    np.testing.assert_allclose(found, written, atol=1e-9)


@pytest.mark.parametrize(
    ("robots", "lower"),
    [
        (["unicycle1_sphere_v0, start: [0.2, 2, 0], goal: [4, 2, 0]"], [-0.4, -0.4]),
        (
            ["unicycle1_sphere_v0, start: [0.2, 2, 0], goal: [4, 2, 0]", "integrator2_2d_v0, start: [2, 1, 0, 0], "
             "goal: [3, 1, 0, 0]"], [-0.205, -0.1],
        ),
        (["car1_v0, start: [0.5, 2, 0, 0], goal: [4, 2, 0, 0]"], [-0.155, -0.125]),
    ],
)  # fmt: skip
def test_bounds_are_wide_enough_for_starts_and_goals(robots: list[str], lower: list[float], tmp_path: Path) -> None:
    """They hold reference points in dynobench, and bodies here."""
    path = tmp_path / "edge.yaml"
    listed = "".join(f"  - {{type: {robot}}}\n" for robot in robots)
    path.write_text(f"environment:\n  min: [0, 0]\n  max: [5, 4]\n  obstacles: []\nrobots:\n{listed}")
    np.testing.assert_allclose(load_dynobench(path).world.lower, lower, atol=1e-6)


def test_a_goal_heading_may_have_whole_turns(instance: Path) -> None:
    instance.write_text(INSTANCE.replace("goal: [4, 1.5, 0]", f"goal: [4, 1.5, {32 * np.pi + 0.5}]"))
    assert load_dynobench(instance).goal_heading[0] == pytest.approx(0.5, abs=1e-4)


def test_own_parameters_are_taken(instance: Path) -> None:
    wide = {"dynamics": "unicycle1", "max_vel": 1.0, "max_angular_vel": 2.0, "shape": "sphere", "radius": 0.3}
    problem = load_dynobench(instance, models={"unicycle1_v0": wide})
    assert problem.team.footprint[1] == Disc(0.3)
    assert problem.team.max_speed.tolist() == [0.5, 1.0, 0.5]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("unicycle1_v0", "hovercraft_7", "robot types 'hovercraft_7' are unknown; known are unicycle1_v0"),
        ("type: box", "type: torus", "type of obstacle 0 is 'torus'; known are box, sphere"),
        ("{type: box", "{kind: box", "obstacle 0 is {'kind': 'box', 'center': "),
        ("size: [0.4, 0.6]", "size: [-0.4, 0.6]", "size of obstacle 0 is [-0.4, 0.6]; it must be positive"),
        ("obstacles:\n", "obstacles:\n    - 5\n", "obstacle 0 is 5; it must be a mapping"),
        ("obstacles:", "obstacle:", "environment has the key 'obstacle'; did you mean 'obstacles'?"),
        ("goal: [4, 1.5, 0]", "gaol: [4, 1.5, 0]", "robot_0 has the key 'gaol'; did you mean 'goal'?"),
        (
            "goal: [4, 1.5, 0]",
            "goal: [true, 1.5, 0]",
            "goal of robot_0 is [True, 1.5, 0]; it must be a list of numbers",
        ),
        ("type: unicycle1_v0", "type: [a]", "robot types ['a'] are unknown; known are unicycle1_v0"),
        ("robots:", "agents:", "is no multi-robot problem of dynobench (it lacks 'robots'); it has environment: min"),
        ("goal: [4, 1.5, 0]", "goal: [4, left, 0]", "goal of robot_0 is [4, 'left', 0]; it must be a list of numbers"),
        ("goal: [4, 1.5, 0]", "goal: there", "goal of robot_0 is 'there'; it must be a list of numbers, as"),
        ("min: [0, 0]", "min: [0, low]", "environment's min is [0, 'low']; it must have numbers, 2 of them"),
        ("size: [", "size: [big, ", "size of obstacle 0 is ['big', "),
        ("min: [0, 0]", "min: [0]", "environment's min is [0]; it must have numbers, 2 of them"),
        ("center: [2.5, 3.2]", "center: [2.5]", "center of obstacle 0 is [2.5]; it must have numbers, 2 of them"),
        ("size: [0.4, 0.6]", "size: 0.4", "size of obstacle 0 is 0.4; it must have numbers, 2 of them"),
        ("min: [0, 0]", "min: 0", "environment's min is 0; it must have numbers, 2 of them"),
        (
            "goal: [4, 1.5, 0]",
            "goal: [4, 1.5]",
            "goal of robot_0 is [4, 1.5]; a unicycle_first_order_0 has 3 components",
        ),
    ],
)
def test_what_is_wrong_is_told(instance: Path, old: str, new: str, message: str) -> None:
    instance.write_text(INSTANCE.replace(old, new))
    with pytest.raises(ValueError, match=rf"^{re.escape(str(instance))}: .*{re.escape(message)}"):
        load_dynobench(instance)


def test_limits_that_are_not_symmetric_are_taken(instance: Path) -> None:
    slow = {"dynamics": "unicycle1", "max_vel": 0.5, "min_vel": -0.1, "max_angular_vel": 0.5, "min_angular_vel": -0.25}
    shape = {"shape": "box", "size": [0.5, 0.25]}
    team = load_dynobench(instance, models={"unicycle1_v0": slow | shape}).team
    assert team.models == ("unicycle", "unicycle1", "holonomic2d")
    np.testing.assert_allclose(team.control_bounds[:, 1], np.float32([[-0.1, -0.25], [0.5, 0.5]]))


CAR = {
    "dynamics": "car_with_trailers", "max_vel": 0.5, "max_steering_abs": 1.0, "l": 0.25, "num_trailers": 1,
    "hitch_lengths": [0.5], "shape": "box", "size": [0.5, 0.25], "size_trailer": [0.3, 0.25],
}  # fmt: skip


@pytest.mark.parametrize(
    ("models", "message"),
    [
        (["mine"], "models is ['mine']; give parameters by type"),
        ({"mine": "unicycle1"}, "robot type mine is 'unicycle1'; give its parameters"),
        ({"mine": {}}, "robot type mine: dynamics None has no model here; there are unicycle1, unicycle2"),
        ({"mine": CAR | {"dynamics": ["unicycle1"]}}, "robot type mine: dynamics ['unicycle1'] has no model here"),
        ({"mine": CAR | {"dynamics": "boat"}}, "robot type mine: dynamics 'boat' has no model here"),
        ({"mine": CAR | {"shape": "blob"}}, "robot type mine: shape is 'blob'; it must be one of sphere, box"),
        ({"mine": CAR | {"shape": "sphere"}}, "robot type mine: radius is missing, which car_with_trailers in the"),
        ({"mine": CAR | {"max_val": 1}}, "robot type mine has the parameter 'max_val'"),
        ({"mine": {"dynamics": "unicycle2", "max_vel": 1, "shape": "sphere"}}, "mine: max_angular_vel is missing"),
        ({"mine": CAR | {"max_vel": "fast"}}, "robot type mine: max_vel must be a number, not 'fast'"),
        ({"mine": CAR | {"l": 0}}, "robot type mine: l is 0; it must be positive and finite"),
        ({"mine": CAR | {"min_vel": 0.25}}, "robot type mine: min_vel is 0.25; it must be negative"),
        ({"mine": CAR | {"min_vel": None}}, "robot type mine: min_vel is None; it must be negative"),
        ({"mine": CAR | {"size": 0.5}}, "robot type mine: size is 0.5; it must be a list of numbers"),
        ({"mine": CAR | {"hitch_lengths": 0.5}}, "robot type mine: hitch_lengths is 0.5; it must be a list of numbers"),
        ({"mine": CAR | {"size": [0.5]}}, "robot type mine: size is [0.5]; it must have numbers, 2 of them"),
        ({"mine": CAR | {"num_trailers": 0}}, "robot type mine: num_trailers is 0; it must be at least 1"),
        ({"mine": CAR | {"num_trailers": 2}}, "robot type mine: hitch_lengths has 1 entries for 2 trailers"),
    ],
)
def test_parameters_that_do_not_fit_are_told(instance: Path, models: Any, message: str) -> None:
    """In their own words, and not as a fault of the file."""
    with pytest.raises(ValueError, match=f"^{re.escape(message)}|^robot type {re.escape(message)}"):
        load_dynobench(instance, models=models)
    load_dynobench(instance, models={"mine": CAR | {"distance_weights": [1, 0.5]}})


def test_all_types_that_are_known_have_what_they_need() -> None:
    assert checked_types(MODELS) == MODELS


@pytest.mark.parametrize("goal", ["[4, 2.5, 0, 0.25, 0]", "[4, 2.5, 0, 0, 0.1]"])
def test_goals_in_motion_are_refused(tmp_path: Path, goal: str) -> None:
    path = tmp_path / "one.yaml"
    robots = f"robots: [{{type: unicycle_second_order_0, start: [1, 2.5, 0, 0, 0], goal: {goal}}}]\n"
    path.write_text("environment: {min: [0, 0], max: [5, 5]}\n" + robots)
    with pytest.raises(ValueError, match=rf"goal of robot_0 is {re.escape(goal)}; give one at rest"):
        load_dynobench(path)


def test_a_result_ends_when_nothing_moves_any_more(tmp_path: Path) -> None:
    path, goal = tmp_path / "one.yaml", [2.7, 1.7, 1.8, 0, 0]
    robots = f"robots: [{{type: unicycle2_v0, start: [1, 2.5, 0, 0, 0], goal: {goal}}}]\n"
    path.write_text("environment: {min: [0, 0], max: [5, 5]}\n" + robots)
    make_planner().solve(load_dynobench(path), seed=0).to_dynobench(tmp_path / "result.yaml")
    (result,) = yaml.safe_load((tmp_path / "result.yaml").read_text())["result"]
    np.testing.assert_allclose(result["states"][-1], goal, atol=0.01)
    assert np.abs(result["actions"][-1]).max() > 0  # and not later


def test_a_result_ends_though_robots_creep_about_their_goals(tmp_path: Path) -> None:
    """Denoised plans never come to rest where robots may leave their goals."""
    box = {"type": "box", "center": [2.5] * 3, "size": [0.5] * 3}
    ends = ([1, 2.5, 2.5, 0, 0, 0], [4, 2.5, 2.5, 0, 0, 0])
    robots = [{"type": "integrator2_3d_v0", "start": list(a), "goal": list(b)} for a, b in (ends, ends[::-1])]
    environment = {"min": [0] * 3, "max": [5] * 3, "obstacles": [box]}
    path = tmp_path / "two.yaml"
    path.write_text(yaml.safe_dump({"environment": environment, "robots": robots}))
    problem = load_dynobench(path)
    plan = make_planner().solve(problem, seed=0)
    plan.to_dynobench(tmp_path / "result.yaml")
    for result, robot in zip(yaml.safe_load((tmp_path / "result.yaml").read_text())["result"], robots, strict=True):
        assert len(result["actions"]) * problem.dt <= plan.metrics["makespan"] + 1e-9
        np.testing.assert_allclose(result["states"][-1], robot["goal"], atol=0.01)


def test_a_start_is_written_as_it_was_read(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    robots = f"robots: [{{type: unicycle1_v0, start: [4, 2.5, {np.pi}], goal: [3, 2.5, 3.0]}}]\n"
    path.write_text("environment: {min: [0, 0], max: [5, 5]}\n" + robots)
    make_planner().solve(load_dynobench(path), seed=0).to_dynobench(tmp_path / "result.yaml")
    (result,) = yaml.safe_load((tmp_path / "result.yaml").read_text())["result"]
    np.testing.assert_allclose(result["states"][0], [4, 2.5, np.pi], atol=1e-5)


def test_headings_pass_pi_as_in_the_steps_of_their_checker(tmp_path: Path) -> None:
    """Which compares headings without turns, in float32. The first step ends at pi."""
    path, passed = tmp_path / "one.yaml", 0
    robots = "robots: [{type: unicycle2_v0, start: [1, 2.5, 3.14, 0, 0], goal: [4, 2.5, 0, 0, 0]}]\n"
    path.write_text("environment: {min: [-9, -9], max: [9, 9]}\n" + robots)
    problem, random = load_dynobench(path), np.random.default_rng(0)
    for _ in range(20):
        turns = np.append(100 * (np.pi - 3.14), np.repeat(random.uniform(-0.25, 0.25, 150), 4)[1:])
        trajectory = rollout(problem, np.stack([np.zeros(600), turns], axis=1)[:, None].astype(np.float32))
        (result,) = yaml.safe_load("\n".join(result_lines(problem, trajectory)))["result"]
        states, actions = (np.array(result[name], np.float32) for name in ("states", "actions"))
        assert np.abs(states[:, 2]).max() <= np.pi
        rate = states[:-1, 4] + 0.1 * actions[:, 1]
        heading = (states[:-1, 2] + 0.1 * rate + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(states[1:, 2], heading, rtol=0.01, atol=0.01)
        passed += int((np.abs(np.diff(states[:, 2])) > np.pi).sum())
    assert passed > 20


def test_a_unicycle_of_second_order_is_read(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    robots = "robots: [{type: unicycle_second_order_0, start: [1, 2.5, 0, 0.25, 0], goal: [4, 2.5, 3.14, 0, 0]}]\n"
    path.write_text("environment: {min: [0, 0], max: [5, 5]}\n" + robots)
    problem = load_dynobench(path)
    assert problem.team.models == ("unicycle2",)
    assert problem.start[0].tolist() == [1, 2.5, 0, 0.25, 0]
    assert problem.team.limits[0].tolist() == [0.5, 0.25, 0.5, 0.5, 0.5, 0.25]
    assert problem.goal_heading[0] == np.float32(3.14)


def test_other_models_have_no_result_file(tmp_path: Path) -> None:
    from d4orm_env import make_problem

    plan = make_planner("mapf").solve(make_problem("circle", num_robots=2, model="car"), max_iterations=1)
    with pytest.raises(ValueError, match="robot_0 is a car, which dynobench has no model for"):
        plan.to_dynobench(tmp_path / "result.yaml")
    assert not list(tmp_path.iterdir())


def test_a_trailer_ends_bent_where_its_goal_has_another_heading(tmp_path: Path) -> None:
    """Whichever way round the two headings of the goal are written."""
    goal = [2.0, 0.5, 3.0, 2.8 - 2 * np.pi]
    path = tmp_path / "bent.yaml"
    environment = {"min": [-3, -3], "max": [5, 5]}
    robot = {"type": "car1_v0", "start": [0, 0, 3.0, 3.0], "goal": goal}
    path.write_text(yaml.safe_dump({"environment": environment, "robots": [robot]}))
    problem = load_dynobench(path)
    np.testing.assert_allclose(problem.goal_hitches, [[0.2, np.nan, np.nan]], atol=1e-6)
    plan = make_planner().solve(problem, seed=0, time_limit=60)
    assert verify(problem, plan.controls).ok
    plan.to_dynobench(tmp_path / "result.yaml")
    result = yaml.safe_load((tmp_path / "result.yaml").read_text())
    missed = np.subtract(result["result"][0]["states"][-1], goal)
    missed[2:] = (missed[2:] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(missed).max() < 0.0101
