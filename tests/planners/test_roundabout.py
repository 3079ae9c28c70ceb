"""Everybody round the middle on the same side."""

from __future__ import annotations

import numpy as np
import pytest

from d4orm_env import Problem, Team, make_problem, rollout, verify
from d4orm_env.dynamics.models import MODELS
from d4orm_planners import make_planner
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.mapf.roundabout import drive_roundabout

# Cars with trailers do not fit on the circle, and robots whose jerk is limited swing out of it.
PLANAR = [
    name for name, model in MODELS.items() if model.dimension == 2 and not model.trailers and name != "holonomic2d_jerk"
]


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("num_robots", "steps"), [(3, 55), (8, 56), (16, 58)])
def test_a_circle_crosses_in_it_in_the_least_time_that_its_symmetry_allows(
    num_robots: int, steps: int, side: int
) -> None:
    """Steps of the fastest path past a disc that leaves room for all, from a nonlinear program (see docs)."""
    problem = make_problem("circle", num_robots=num_robots, goal_speed=np.inf)
    controls = drive_roundabout(problem, get_sampling_engine("cpu"), side)
    assert controls is not None
    trajectory = rollout(problem, controls)
    assert (trajectory.arrived.argmax(axis=0) == steps).all()
    assert verify(problem, controls).ok
    # On the side that was asked for: the middle lies to the right of who passes it to the left.
    halfway = trajectory.positions[steps // 2]
    along = problem.goal - problem.start[:, :2]
    turned = along[:, 0] * halfway[:, 1] - along[:, 1] * halfway[:, 0]
    assert (np.sign(turned) == side).all()


@pytest.mark.parametrize("model", PLANAR)
def test_robots_of_any_planar_model_drive_in_it(model: str) -> None:
    problem = make_problem("circle", num_robots=6, model=model)
    controls = drive_roundabout(problem, get_sampling_engine("cpu"), 1)
    assert controls is not None
    assert np.isfinite(controls).all()
    assert (np.abs(controls) <= problem.team.control_limits).all()


def test_there_is_none_where_ways_do_not_cross() -> None:
    states = np.zeros((3, 4))
    states[:, :2] = [[-3, 0], [3, 1], [-3, 2]]
    problem = Problem(Team(("holonomic2d",) * 3), states, [[3, 0], [-3, 1], [3, 2]])
    assert drive_roundabout(problem, get_sampling_engine("cpu"), 1) is None


def test_there_is_none_in_space_nor_where_somebody_begins_within() -> None:
    engine = get_sampling_engine("cpu")
    assert drive_roundabout(make_problem("sphere", num_robots=6), engine, 1) is None
    states = np.zeros((3, 4))
    states[:, :2] = [[0, 0.1], [2, 0], [-1, 2]]
    team = Team(("holonomic2d",) * 3)
    assert drive_roundabout(Problem(team, states, [[0, -2], [-2, 0], [1, -2]]), engine, 1) is None


def test_improving_a_crossing_ends_in_it_or_better() -> None:
    problem = make_problem("circle", num_robots=6)
    plan = make_planner("hybrid", improve=True).solve(problem, seed=1, max_iterations=3)
    controls = drive_roundabout(problem, get_sampling_engine("cpu"), 1)
    assert controls is not None
    assert plan.metrics["reward"] >= rollout(problem, controls).rewards.mean() - 1e-6
    assert verify(problem, plan.controls).ok
