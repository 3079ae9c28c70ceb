"""Robots that change places close by: what is sampled there, and that it is found."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from d4orm_env import World, make_problem
from d4orm_env.core.problem import Problem
from d4orm_planners import SolveRun, make_planner
from d4orm_planners.base.names import PLANNERS
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.sampling.loop import drive_times, on_short_paths

CLOSE = {
    "circle 0.6": ("circle", {"num_robots": 2, "diameter": 0.6}),
    "circle 0.8": ("circle", {"num_robots": 2, "diameter": 0.8}),
    "circle of three": ("circle", {"num_robots": 3, "diameter": 0.8}),
    "swap 1.0": ("swap", {"num_robots": 2, "distance": 1.0}),
    "two rows": ("swap", {"num_robots": 4, "distance": 0.8}),
}


def looked_at(problem: Problem, iterations: int = 0) -> tuple[SamplingTask, SamplingTask]:
    """The task of the whole problem, and what is made of it."""
    search = SolveRun(make_planner("d4orm", engine="cpu"), problem, 0)
    search.iteration = iterations
    task = SamplingTask(problem, search.current.planned)
    return task, on_short_paths(task, search)


@pytest.mark.parametrize("planner", ["d4orm", "d4orm-d", "mppi", "cem"])
@pytest.mark.parametrize("case", CLOSE)
def test_robots_change_positions_close_by(planner: str, case: str) -> None:
    scenario, arguments = CLOSE[case]
    problem = make_problem(scenario, **arguments)
    assert make_planner(planner, engine="cpu").solve(problem, seed=0, max_iterations=10).solved


@pytest.mark.parametrize(
    ("scenario", "arguments"),
    [
        ("circle", {"num_robots": 8}),
        ("circle", {"num_robots": 2, "diameter": 1.76}),
        ("random", {"num_robots": 16}),
        ("circle", {"num_robots": 1, "diameter": 0.8}),
        ("circle", {"num_robots": 2, "diameter": 0.8, "arrival": "stay"}),
    ],
)
def test_other_robots_are_sampled_as_ever(scenario: str, arguments: dict[str, Any]) -> None:
    task, same = looked_at(make_problem(scenario, **arguments))
    assert same is task


def test_paths_around_a_wall_are_not_short() -> None:
    short = make_problem("circle", num_robots=2, diameter=0.8)
    wall = World(boxes=[[-2.0, -0.02, 2.0, 0.02]])
    arguments = {name: value for name, value in short.__getstate__().items() if name not in ("start", "goal", "world")}
    start, goal = np.array([[0, 0.4, 0, 0], [1, 0.4, 0, 0]]), np.array([[0, -0.4], [1, -0.4]])
    for world, is_short in ((World(), True), (wall, False)):
        task, looked = looked_at(Problem(start=start, goal=goal, world=world, **arguments))
        assert (looked is not task) == is_short


def test_samples_look_ahead_over_twice_the_drive_and_more_with_every_iteration() -> None:
    problem = make_problem("circle", num_robots=2, diameter=0.8)
    for iterations, horizon in ((0, 36), (5, 54), (500, 100)):  # 1.79 s from rest to rest
        _, looked = looked_at(problem, iterations)
        assert looked.problem.horizon == len(looked.base) == horizon
        assert looked.reference_distance == pytest.approx(5 * 0.35)


@pytest.mark.parametrize(
    ("model", "times"),
    [
        ("holonomic2d", [2 * 0.8**0.5, 6.0]),  # speeds up to 1 m/s in 1 s, and brakes in as much
        ("velocity2d", [0.8, 5.0]),
        ("unicycle", [1.8, 6.0]),  # a quarter turn takes 1 s
        ("differential_drive", [0.8**0.5 + 1, 6.0]),
    ],
)
def test_the_time_that_a_drive_takes(model: str, times: list[float]) -> None:
    problem = make_problem("circle", num_robots=2, model=model)
    np.testing.assert_allclose(drive_times(problem, np.array([0.8, 5.0])), times, rtol=1e-6)
    assert drive_times(problem, np.zeros(2)).tolist() == pytest.approx(
        [1.0 * (model in ("unicycle", "differential_drive"))] * 2
    )


@pytest.mark.parametrize("exponent", [-6, 6])
def test_lengths_are_measured_by_the_robots(exponent: int) -> None:
    scale = 2.0**exponent
    sizes = {name: value * scale for name, value in {"radius": 0.15, "margin": 0.05, "goal_radius": 0.075}.items()}
    limits = {"max_speed": scale, "max_acceleration": scale}
    problem = make_problem("circle", num_robots=2, diameter=0.8 * scale, **sizes, **limits)
    _, looked = looked_at(problem)
    assert looked.problem.horizon == 36
    assert looked.reference_distance == pytest.approx(5 * 0.35 * scale)


@pytest.mark.parametrize(
    "name", [name for name in PLANNERS if "short_paths" in PLANNERS[name].config_class.setting_names()]
)
@pytest.mark.parametrize("preset", ["paper", "tuned"])
def test_the_papers_methods_sample_all_steps(name: str, preset: str) -> None:
    if preset in PLANNERS[name].presets:
        assert make_planner(name, preset=preset).config.keywords()["short_paths"] is False
