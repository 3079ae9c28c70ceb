"""One step of one robot: the integrator's order, exact motions, the speed limit, and docking at the goal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, NUMPY_OPS, rk4
from hypothesis import given
from hypothesis import strategies as st

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.transition import TimeStep, advance, arrives
from d4orm_env.engine.choice import get_engine
from d4orm_env.engine.types import StepResult

DIFFERENTIAL_DRIVE = MODELS["differential_drive"].functions
HOLONOMIC = MODELS["holonomic2d"].functions


def time_step(dt: float) -> TimeStep:
    return TimeStep(dt, dt / 2, dt / 3, dt / 6)


def integrate(x: tuple[float, ...], u: tuple[float, ...], duration: float, steps: int) -> np.ndarray:
    for _ in range(steps):
        x = DIFFERENTIAL_DRIVE.integrate(x, u, (), time_step(duration / steps), NUMPY_OPS)
    return np.array(x)


def exact_drive(x: tuple[float, ...], u: tuple[float, ...], t: float) -> np.ndarray:
    """Turning at a constant rate while accelerating constantly, integrated by hand.

    The integral of ``(v + a t) cos(h + w t)`` is ``(v + a t) sin(h + w t) / w + a cos(h + w t) / w^2``.
    """
    px, py, h, v = x
    w, a = u
    angle, speed = h + w * t, v + a * t
    along = (speed * math.sin(angle) - v * math.sin(h)) / w + a * (math.cos(angle) - math.cos(h)) / w**2
    across = (v * math.cos(h) - speed * math.cos(angle)) / w + a * (math.sin(angle) - math.sin(h)) / w**2
    return np.array([px + along, py + across, angle, speed])


def test_the_step_converges_at_order_four() -> None:
    x, u, duration = (0.3, -0.2, 0.4, 0.5), (1.5, 0.7), 2.0
    exact = exact_drive(x, u, duration)
    steps = np.array([4, 8, 16, 32, 64])
    errors = np.array([np.linalg.norm(integrate(x, u, duration, n) - exact) for n in steps])
    orders = np.log2(errors[:-1] / errors[1:])
    assert errors[0] > 1e-6  # else there would be nothing to see but rounding
    np.testing.assert_allclose(orders, 4, atol=0.1)
    assert orders[-1] == pytest.approx(4, abs=0.02)


@pytest.mark.parametrize("name", MODELS)
@given(data=st.data())
def test_a_step_is_runge_kutta_on_the_derivative(name: str, data: st.DataObject) -> None:
    model, number = MODELS[name], st.floats(-3, 3)
    bounded = dict(model.state_limits)  # a steering angle, whose tangent has no bounds
    x = data.draw(st.tuples(*(st.floats(-0.6, 0.6) if i in bounded else number for i in range(model.state_size))))
    u = data.draw(st.tuples(*[number] * model.control_size))
    limits = (1.0, 1.0, 1.0, *(limit.default for limit in model.own_limits))
    dt = data.draw(st.floats(1e-3, 1.0))
    textbook = rk4(lambda x, u, ops: model.functions.derivative(x, u, limits, ops), x, u, dt, NUMPY_OPS)
    after = model.functions.integrate(x, u, limits, time_step(dt), NUMPY_OPS)
    np.testing.assert_allclose(after, textbook, rtol=1e-11, atol=1e-13)


def test_a_double_integrator_moves_exactly() -> None:
    # p + v t + a t^2 / 2 after half a second from (1, 2) at (0.5, -0.25) under (0.2, 0.4).
    x = HOLONOMIC.integrate((1.0, 2.0, 0.5, -0.25), (0.2, 0.4), (), time_step(0.5), NUMPY_OPS)
    assert x == pytest.approx((1.275, 1.925, 0.6, -0.05), abs=1e-14)


def test_the_speed_limit_comes_after_the_integration() -> None:
    # The step is integrated at up to 1.1 m/s and the speed is brought to 1 m/s afterwards.
    x = advance(HOLONOMIC, (0.0, 0.0, 1.0, 0.0), (1.0, 0.0), (1.0, 1.0, 1.0), time_step(0.1), NUMPY_OPS)
    assert x == pytest.approx((0.105, 0.0, 1.0, 0.0), abs=1e-14)


def test_arrival_needs_both_position_and_speed() -> None:
    assert arrives(0.25, 0.04, 0.25, 0.04)
    assert not arrives(0.2501, 0.04, 0.25, 0.04)
    assert not arrives(0.25, 0.0401, 0.25, 0.04)
    assert arrives(0.25, 1e30, 0.25, math.inf)


def one_robot(model: str, **changes: Any) -> Problem:
    team = Team((model,))
    goal = np.eye(team.dimension)[:1] * 2
    return Problem(
        team, np.zeros((1, team.state_size)), goal, **({"goal_radius": 0.25, "goal_speed": np.inf} | changes)
    )


def step(engine: str, problem: Problem, state: Any, control: Any, arrived: bool = False) -> StepResult:
    states, controls = np.array([state], np.float32), np.array([control], np.float32)
    return get_engine(engine).step(problem.arrays, states, np.array([arrived]), controls)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(
    ("x", "arrived"),
    [(2.0, True), (1.75, True), (np.nextafter(np.float32(1.75), np.float32(0)), False), (2.25, True), (2.26, False)],
)
def test_a_robot_docks_within_the_goal_radius(engine: str, x: float, arrived: bool) -> None:
    result = step(engine, one_robot("velocity2d"), [x, 0], [0, 0])
    assert result.arrived[0] == arrived


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(("goal_speed", "arrived"), [(np.inf, True), (0.5, True), (0.49, False), (0.0, False)])
def test_a_robot_docks_at_no_more_than_the_goal_speed(engine: str, goal_speed: float, arrived: bool) -> None:
    problem = one_robot("holonomic2d", goal_speed=goal_speed)
    result = step(engine, problem, [2, 0, 0.5, 0], [0, 0])
    assert result.arrived[0] == arrived
    np.testing.assert_allclose(result.states[0], [2.05, 0, 0 if arrived else 0.5, 0], atol=1e-6)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(
    ("model", "state", "control", "arrived"),
    [
        ("holonomic2d", [1.7, 0, 1, 0], [0, 0], [1.8, 0, 0, 0]),
        ("holonomic3d", [1.7, 0, 0, 1, 0, 0], [0, 0, 0], [1.8, 0, 0, 0, 0, 0]),
        ("velocity2d", [1.7, 0], [1, 0], [1.8, 0]),
        ("differential_drive", [1.7, 0, 0, 1], [0.5, 0], [1.79996, 0.0025, 0.05, 0]),
        ("unicycle", [1.7, 0, 0], [1, 0.5], [1.79996, 0.0025, 0.05]),
        ("car", [1.7, 0, 0, 1, 0.1], [0, 0], [1.79998, 0.00167, 0.03345, 0, 0.1]),
    ],
)
def test_a_docked_robot_stays_at_rest_whatever_it_is_told(
    engine: str, model: str, state: Any, control: Any, arrived: Any
) -> None:
    problem = one_robot(model)
    first = step(engine, problem, state, control)
    assert first.arrived[0]
    # The step that docks is still driven; the velocity is gone after it.
    np.testing.assert_allclose(first.controls[0], control, atol=1e-6)
    np.testing.assert_allclose(first.states[0], arrived, atol=2e-5)
    full_throttle = np.full(problem.control_size, 5.0)
    later = step(engine, problem, first.states[0], full_throttle, arrived=True)
    assert later.arrived[0]
    np.testing.assert_array_equal(later.states, first.states)
    np.testing.assert_array_equal(later.controls, np.zeros_like(later.controls))
    np.testing.assert_array_equal(later.rewards, first.rewards)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_passing_the_goal_too_fast_is_no_arrival_until_slowed_down(engine: str) -> None:
    # From rest at 0 m, goal at 0.5 m, goal speed 0.3 m/s: accelerating through it does not dock.
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[0.5, 0]], goal_speed=0.3, horizon=20)
    controls = np.zeros((20, 1, 2))
    controls[:, 0, 0] = 1
    assert not get_engine(engine).rollout(problem, controls).arrived.any()
    # p = t^2 / 2 up to 0.5 s, then braking: 0.125 m at 0.5 m/s; after 0.7 s 0.205 m at 0.3 m/s; then coasting.
    controls[5:7, 0, 0] = -1
    controls[7:, 0, 0] = 0
    arrived = get_engine(engine).rollout(problem, controls).arrived[:, 0]
    # At 0.3 m/s the 0.22 m that are left to the goal radius of 0.075 m take 0.733 s: docked at the step of 1.5 s.
    assert int(arrived.argmax()) == 15


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_start_at_the_goal_docks_with_the_first_step(engine: str) -> None:
    problem = Problem(Team(("velocity2d",)), [[1, 1]], [[1, 1]], horizon=3)
    trajectory = get_engine(engine).rollout(problem, np.zeros((3, 1, 2)))
    assert trajectory.arrived[:, 0].tolist() == [False, True, True, True]
