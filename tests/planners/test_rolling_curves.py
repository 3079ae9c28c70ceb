"""Curves along which robots on wheels roll: without slip, and within what they can steer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from env_support import slow
from hypothesis import given, settings
from hypothesis import strategies as st

from d4orm_env import Problem, Team, make_problem
from d4orm_env.dynamics.models import MODELS
from d4orm_planners import make_planner
from d4orm_planners.tracking import rolling_curves
from d4orm_planners.tracking.rolling_curves import Wheeled, groups_on_wheels, on_wheels, roll
from d4orm_planners.tracking.smoothing import MotionLimits, smooth_motion

WHEELED = [
    slow(name) if len(model.trailers) > 1 else name for name, model in MODELS.items() if model.heading_index is not None
]
NO_SLIP = 1e-5
"""Speed across the heading that rounding leaves [m/s]."""


def slip(poses: Any, velocities: Any) -> Any:
    return velocities[..., 1] * np.cos(poses[..., 2]) - velocities[..., 0] * np.sin(poses[..., 2])


@pytest.mark.parametrize("name", WHEELED)
def test_sampled_robots_on_wheels_do_not_slip_and_steer_within_their_limits(name: str) -> None:
    problem = make_problem("circle", num_robots=3, model=name)
    plan = make_planner().solve(problem, seed=0, time_limit=30)
    assert plan.solved
    motion = smooth_motion(problem, plan.trajectory, limits := MotionLimits.of(problem))
    times = np.linspace(0, motion.duration, 2000)
    velocity, heading = motion.position(times, 1), motion.heading(times)
    assert np.abs(slip(np.dstack([motion.position(times), heading]), velocity)).max() < NO_SLIP
    turning_radius = problem.team.turning_radius
    turning = np.abs(motion.heading(times, 1)) * turning_radius
    assert (turning <= np.linalg.norm(velocity, axis=2) + NO_SLIP).all() or not turning_radius.any()
    assert (motion.peaks.steering_rate <= limits.steering_rate).all()
    assert motion.report.ok


def wheeled(poses: Any, **changes: Any) -> Wheeled:
    poses = np.asarray(poses, np.float64)
    usual = Wheeled(poses, *(np.full(len(poses), value) for value in (0.0, 0.15, np.inf, np.nan)))
    return usual._replace(**{name: np.array(value) for name, value in changes.items()})


@given(
    radius=st.floats(0.5, 3), turn=st.floats(-1.5, 1.5), heading=st.floats(-3, 3), steers=st.booleans(),
    smoothness=st.sampled_from([1e-2, 1.0, 1e2]), moving=st.booleans(),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_an_arc_that_is_driven_is_met(
    radius: float, turn: float, heading: float, steers: bool, smoothness: float, moving: bool
) -> None:
    """From rest or at speed, to rest, with the largest curvature just above the arc's."""
    share = np.clip(np.linspace(-0.5 * (not moving), 1.5, 31), 0, 1)
    angle, side = heading + turn * share, np.sign(turn) or 1.0
    x, y = radius * side * (np.sin(angle) - np.sin(heading)), -radius * side * (np.cos(angle) - np.cos(heading))
    poses = np.stack([x, y, angle], axis=1)[None]
    speed = radius * abs(turn) / 15 / 0.1 if moving else 0.0
    curvature = 1.05 / radius if steers else np.inf
    spline, steered = roll(wheeled(poses, speed=[speed], curvature=[curvature]), 0.1, smoothness)
    times = np.linspace(0, 3, 500)
    found, velocity = spline(times)[:, 0], spline(times, 1)[:, 0]
    assert np.abs(slip(found, velocity)).max() < NO_SLIP
    assert np.abs(steered(times)).max() <= (curvature if steers else 0)
    np.testing.assert_allclose(found[[0, -1]], poses[0, [0, -1]], atol=2e-3)
    np.testing.assert_allclose(velocity[0, :2], speed * np.array([np.cos(heading), np.sin(heading)]), atol=1e-6)


@pytest.mark.parametrize("curvature", [np.inf, 2.0])
def test_robots_that_stand_stay(curvature: float) -> None:
    poses = np.tile([1.0, 2.0, 0.7], (2, 12, 1))
    spline, steered = roll(wheeled(poses, curvature=[curvature] * 2), 0.1, 1.0)
    np.testing.assert_allclose(spline(np.linspace(0, 1.1, 40)), np.broadcast_to(poses[0, 0], (40, 2, 3)), atol=1e-9)
    np.testing.assert_allclose(steered(0.5), 0, atol=1e-9)


def test_a_robot_turns_on_the_spot() -> None:
    poses = np.zeros((1, 21, 3))
    poses[0, :, 2] = np.clip(np.linspace(-0.5, 1.5, 21), 0, 1)
    spline, _ = roll(wheeled(poses), 0.1, 1.0)
    times = np.linspace(0, 2, 100)
    np.testing.assert_allclose(spline(times)[..., :2], 0, atol=1e-9)
    np.testing.assert_allclose(
        spline(times)[..., 0, 2], np.interp(times, np.arange(21) * 0.1, poses[0, :, 2]), atol=0.1
    )


def test_a_car_steers_no_more_than_it_can() -> None:
    """A corner that its plan takes too sharply is taken as sharply as it can, and missed for that."""
    along = np.linspace(0, 1, 15)
    corner = np.concatenate([np.stack([along, 0 * along], 1), np.stack([0 * along[1:] + 1, along[1:]], 1)])
    poses = np.column_stack([corner, np.repeat([0, np.pi / 2], [15, 14])])[None]
    spline, steered = roll(wheeled(poses, curvature=[1.5]), 0.1, 1.0)
    times = np.linspace(0, 2.8, 500)
    assert 1.4 < np.abs(steered(times)).max() <= 1.5
    assert np.abs(slip(spline(times), spline(times, 1))).max() < NO_SLIP
    assert np.linalg.norm(spline(times[-1])[0, :2] - [1, 1]) < 0.01


def test_robots_are_grouped_by_how_they_turn() -> None:
    team = Team(("car", "unicycle", "holonomic2d", "differential_drive"))
    problem = Problem(
        team, [[0, 0, 0, 0, 0], [0, 2, 0, 0, 0], [0, 4, 0, 0, 0], [0, 6, 0, 0, 0]], [[1, 0], [1, 2], [1, 4], [1, 6]]
    )
    assert groups_on_wheels(problem) == [[0], [1, 3]]


def test_a_robot_that_moves_sideways_does_not_roll() -> None:
    unicycle = MODELS["unicycle"]
    functions = unicycle.functions._replace(velocity=lambda x, u, limits, ops: (u[0], u[1]))
    assert not rolling_curves._rolls(replace(unicycle, functions=functions))
    assert rolling_curves._rolls(unicycle)


def test_a_car_begins_with_the_steering_angle_that_it_has() -> None:
    """Of 0.4 rad, with a wheelbase of 0.3 m."""
    problem = Problem(Team(("car",)), [[0, 0, 0, 0.5, 0.4]], [[2, 0]])
    rolling = on_wheels(problem, [0], np.zeros((4, 1, 3)), np.array([[0.5, 0]]))
    assert rolling.steered == pytest.approx(np.tan(0.4) / 0.3)
    poses = np.stack([np.linspace(0, 1, 21), np.zeros(21), np.zeros(21)], axis=1)[None]
    _, steered = roll(wheeled(poses, speed=[0.5], curvature=[2.28], steered=[1.4]), 0.1, 1.0)
    assert steered(0.0) == pytest.approx(1.4)
