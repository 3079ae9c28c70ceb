"""AMSwarm: its polynomials, its alternation against a plain one, and what it plans among every kind of obstacle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planner_support import assert_solves, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios import make_problem
from d4orm_planners import make_planner
from d4orm_planners.baselines.alternation import MotionSamples, Neighbourhood, alternate
from d4orm_planners.baselines.amswarm import AMSwarmConfig, first_coefficients, make_method, sample_basis

# The polynomials.


@given(st.integers(5, 15), st.integers(4, 40), st.floats(0.02, 0.5))
def test_the_derivatives_are_those_of_the_positions(degree: int, steps: int, dt: float) -> None:
    duration = steps * dt
    cubic = np.polynomial.Polynomial([1.0, -2.0, 3.0, 0.5])
    # The coefficients of t^k in the Bernstein basis are products of k factors (i - j) / (n - j).
    index = np.arange(degree + 1)
    powers = [np.prod([(index - j) / (degree - j) for j in range(k)], axis=0) * np.ones(degree + 1) for k in range(4)]
    coefficients = sum(c * duration**k * power for k, (c, power) in enumerate(zip(cubic.coef, powers, strict=True)))
    times = dt * np.arange(1, steps + 1)
    for order, samples in enumerate(sample_basis(degree, steps, dt)):
        expected = cubic.deriv(order)(times) if order else cubic(times)
        np.testing.assert_allclose(samples @ coefficients, expected, rtol=1e-6, atol=1e-6 * max(1, dt**-order))


def test_the_first_coefficients_are_the_present_state() -> None:
    degree, duration = 8, 2.0
    position, velocity, acceleration = np.array([1.0, 2.0]), np.array([0.3, -0.5]), np.array([-0.7, 0.1])
    motion = np.random.default_rng(0).normal(size=(degree + 1, 2))
    motion[:3] = first_coefficients(degree, duration, position, velocity, acceleration)
    basis = sample_basis(degree, 10**5, duration / 10**5)
    for samples, expected in zip(basis[:3], (position, velocity, acceleration), strict=True):
        np.testing.assert_allclose(samples[0] @ motion, expected, atol=0.01)


# The alternation.


def plainly(
    config: AMSwarmConfig, dt: float, bodies: Neighbourhood, limits: Any, goal: Any, begin: Any, guess: MotionSamples
) -> Any:
    """The coefficients of robot 0 among discs, with all constraints as rows of one matrix, one axis at a time."""
    basis = sample_basis(config.degree, config.lookahead, dt)
    late = basis[0][-config.goal_steps :]
    hessian = config.goal_weight * late.T @ late + config.smoothness * basis[3].T @ basis[3]
    linear = config.goal_weight * late.sum(axis=0)[:, None] * goal
    centres = [*bodies.paths[1:], *(np.tile(box[:2], (config.lookahead, 1)) for box in bodies.boxes)]
    reach = [bodies.radius[0] + r + bodies.margin for r in (*bodies.radius[1:], *bodies.boxes[:, 4])]
    rows = np.concatenate([basis[0]] * (1 + len(centres)) + [basis[1], basis[2]])

    def projected(position: Any, velocity: Any, acceleration: Any) -> Any:
        parts = [position]
        for centre, least in zip(centres, reach, strict=True):
            before = np.linalg.norm(begin[0] - centre[0])
            part = []
            for now, middle in zip(position, centre, strict=True):
                distance = np.linalg.norm(now - middle)
                bound = least + (1 - config.barrier) * max(before - least, 0)
                part.append(middle + (now - middle) / distance * max(distance, bound))
                before = distance
            parts.append(np.array(part))
        for vectors, most in ((velocity, limits[0]), (acceleration, limits[1])):
            parts.append(vectors * np.minimum(1, most / np.linalg.norm(vectors, axis=1))[:, None])
        return np.concatenate(parts)

    motion = np.concatenate([begin, np.zeros((config.degree - 2, 2))])
    multiplier, penalty, targets = np.zeros_like(motion), config.penalty, projected(*guess)
    for _ in range(config.alternations):
        matrix = hessian + penalty * rows.T @ rows
        right = linear + multiplier + penalty * rows.T @ targets
        motion[3:] = np.linalg.solve(matrix[3:, 3:], right[3:] - matrix[3:, :3] @ motion[:3])
        targets = projected(*(samples @ motion for samples in basis[:3]))
        multiplier -= penalty * rows.T @ (rows @ motion - targets)
        penalty *= config.growth
    return motion


def test_the_alternation_is_the_publications() -> None:
    config = AMSwarmConfig(lookahead=12, goal_steps=5, alternations=7, tolerance=1e-12, lookout=50.0)
    dt, goal, limits = 0.2, np.array([3.0, 0.4]), np.array([1.0, 1.0])
    others = np.linspace([2.0, 0.3], [0.5, 0.1], 12)
    boxes = np.array([[0.9, -0.4, 0.9, -0.4, 0.25]])
    bodies = Neighbourhood(
        np.stack([others, others]), np.array([0.2, 0.3]), 0.05, boxes, np.full((2, 2), np.inf) * [[-1], [1]]
    )
    begin = first_coefficients(config.degree, 12 * dt, np.zeros(2), np.array([0.5, 0.1]), np.array([0.1, 0.0]))
    guess = MotionSamples(np.linspace([0.1, 0.02], [2.0, 0.2], 12), np.full((12, 2), 0.8), np.full((12, 2), 0.01))
    expected = plainly(config, dt, bodies, limits, goal, begin, guess)
    motion = np.zeros((config.degree + 1, 2))
    motion[:3] = begin
    violation = alternate(make_method(config, dt, 1.0), bodies, 0, limits, goal, 3, motion, guess)
    np.testing.assert_allclose(motion, expected, atol=1e-7)
    # What it hands back is the motion's, and the violation what the samples say.
    basis = sample_basis(config.degree, 12, dt)
    for samples, values in zip(basis[:3], guess, strict=True):
        np.testing.assert_allclose(values, samples @ motion, atol=1e-10)
    gaps = [
        np.linalg.norm(guess.position - others, axis=1) - 0.55,
        np.linalg.norm(guess.position - boxes[0, :2], axis=1) - 0.5,
    ]
    speeds = [np.linalg.norm(part, axis=1) - 1 for part in (guess.velocity, guess.acceleration)]
    assert violation == pytest.approx(max(0, *(-gap.min() for gap in gaps), *(speed.max() for speed in speeds)))


def test_the_weight_of_constraints_stops_growing_before_it_overflows() -> None:
    plan = make_planner("amswarm", engine="cpu", growth=10.0, alternations=400, tolerance=1e-12).solve(
        swap_problem(horizon=10), max_iterations=1
    )
    assert plan.status == "iteration_limit"
    assert np.isfinite(float(plan.history[0].note.split()[-1]))


# What it plans.


def swap_problem(model: str = "holonomic2d", **changes: Any) -> Problem:
    """Two robots 3 m apart that change places."""
    team = Team((model,) * 2)
    start = np.zeros((2, team.state_size))
    start[:, 0] = [-1.5, 1.5]
    return Problem(team, start, -start[:, : team.dimension], **({"horizon": 80} | changes))


@pytest.mark.parametrize("model", ["holonomic2d", "holonomic3d", "velocity2d"])
def test_two_robots_change_places(model: str) -> None:
    assert_solves("amswarm", swap_problem(model))


WORLDS = {
    "circle": World(2, circles=[[0, 0.05, 0.3]]),
    "box": World(2, boxes=[[-0.3, -0.25, 0.3, 0.35]]),
    "bounds": World(2, lower=[-2, -0.8], upper=[2, 0.8]),
    "sphere": World(3, spheres=[[0, 0.05, 0.02, 0.3]]),
    "cylinder": World(3, cylinders=[[0, 0.05, 0.3]]),
    "box in space": World(3, boxes=[[-0.3, -0.25, -0.2, 0.3, 0.35, 0.3]]),
}


@pytest.mark.parametrize("kind", WORLDS)
def test_obstacles_are_gone_round(kind: str) -> None:
    world = WORLDS[kind]
    assert_solves(
        "amswarm", swap_problem("holonomic2d" if world.dimension == 2 else "holonomic3d", world=world, horizon=120)
    )


def test_a_guess_within_a_box_leaves_it_by_the_nearest_side() -> None:
    # The straight path to the goal leads through the box, nearer to its upper side.
    problem = Problem(
        Team(("holonomic2d",)), [[-1.5, 0.2, 0, 0]], [[1.5, 0.2]], World(boxes=[[-0.2, -0.8, 0.2, 0.4]]), horizon=100
    )
    plan = assert_solves("amswarm", problem)
    assert plan.trajectory.positions[:, 0, 1].max() > 0.55


@pytest.mark.parametrize("name", ["amswarm_1", "amswarm_3", "amswarm_4"])
def test_the_environments_that_the_publication_solves(name: str) -> None:
    plan = assert_solves("amswarm", make_problem(name))
    # The smoothness that the paper reports: less than a quarter of D4orm's 43 to 47.
    assert plan.metrics["mean_squared_jerk"] < 11


def test_who_shows_no_way_ends_unsolved() -> None:
    plan = make_planner("amswarm", engine="cpu").solve(walled_in_problem(), max_iterations=2)
    assert plan.status == "iteration_limit"
    assert not plan.trajectory.collided.any()


def test_polygons_are_refused() -> None:
    world = World(polygons=[[[0, 0], [0.3, 0], [0, 0.3]]])
    with pytest.raises(ValueError, match=r"the world has 1 polygons, and planner 'amswarm' knows circles.*give boxes"):
        make_planner("amswarm", engine="cpu").solve(swap_problem(world=world))


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("lookahead", 1, "lookahead is 1.*at least 2"),
        ("degree", 4, "degree is 4.*at least 5"),
        ("goal_steps", 0, "goal_steps is 0"),
        ("goal_weight", 0, "goal_weight is 0"),
        ("smoothness", -1, "smoothness is -1"),
        ("barrier", 1.5, "barrier is 1.5.*at most 1"),
        ("lookout", float("nan"), "lookout is nan"),
        ("growth", 0.5, "growth is 0.5.*at least 1"),
        ("alternations", 0, "alternations is 0"),
        ("num_samples", 64, "'num_samples' is no setting of planner 'amswarm'"),
    ],
)
def test_a_bad_setting_is_refused_by_name(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_planner("amswarm", **{setting: value})
