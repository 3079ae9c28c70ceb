"""Robot models: derivatives and limits in numbers, and the same results from every library that compiles them."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from engine_support import ENGINE_NAMES, NUMPY_OPS, PYTHON_OPS
from hypothesis import given
from hypothesis import strategies as st

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import MODEL_CODES, MODELS, get_model
from d4orm_env.dynamics.robot_model import Ops
from d4orm_env.dynamics.transition import TimeStep, advance
from d4orm_env.engine.choice import get_engine

JAX_OPS = Ops(jnp.cos, jnp.sin, jnp.sqrt, jnp.minimum, jnp.maximum, jnp.arctan2, jnp.where)
LIMITS = (2.0, 1.0, 0.5)
"""Speed, acceleration, turn rate: all different, so that none can stand for another."""
CAR_LIMITS = (*LIMITS, 0.6, 1.5, 0.25, 0.5, 0.4, 0.6, 0.45, 0.7, 0.5)
"""And steering, steering rate and wheelbase; what other models have for themselves takes the same numbers."""


def test_the_registry_is_consistent() -> None:
    # A code is part of what a problem's digest says.
    sizes = {name: (model.dimension, model.state_size, model.control_size) for name, model in MODELS.items()}
    assert sizes == {
        "holonomic2d": (2, 4, 2),
        "holonomic3d": (3, 6, 3),
        "velocity2d": (2, 2, 2),
        "differential_drive": (2, 4, 2),
        "unicycle": (2, 3, 2),
        "car": (2, 5, 2),
        "unicycle1": (2, 3, 2),
        "unicycle2": (2, 5, 2),
        "holonomic2d_jerk": (2, 6, 2),
        "holonomic3d_drag": (3, 6, 3),
        "car_with_1_trailer": (2, 4, 2),
        "car_with_2_trailers": (2, 5, 2),
        "car_with_3_trailers": (2, 6, 2),
        "car_first_order": (2, 3, 2),
    }
    assert tuple(MODELS) == tuple(MODEL_CODES) == tuple(sizes)
    assert list(MODEL_CODES.values()) == list(range(len(sizes)))
    for name, model in MODELS.items():
        assert get_model(name) is model
        assert model.name == name
        assert model.state_names[: model.dimension] == ("px", "py", "pz")[: model.dimension]
        assert len(model.control_limits) == model.control_size
        x, u = (0.25,) * model.state_size, (0.25,) * model.control_size
        assert len(model.functions.derivative(x, u, CAR_LIMITS, PYTHON_OPS)) == model.state_size
        assert len(model.functions.velocity(x, u, CAR_LIMITS, PYTHON_OPS)) == model.dimension


def test_heading_and_speed_are_where_the_model_says() -> None:
    assert [model.heading_index for model in MODELS.values()][:6] == [None, None, None, 2, 2, 2]
    assert [model.speed_indices for model in MODELS.values()][:6] == [(2, 3), (3, 4, 5), (), (3,), (), (3,)]


def test_an_unknown_model_is_named_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"model 'hovercraft' is unknown; choose one of holonomic2d, .*differential"):
        get_model("hovercraft")


@pytest.mark.parametrize(
    ("name", "x", "u", "derivative", "velocity"),
    [
        ("holonomic2d", (1, 2, 3, 4), (5, 6), (3, 4, 5, 6), (3, 4)),
        ("holonomic3d", (1, 2, 3, 4, 5, 6), (7, 8, 9), (4, 5, 6, 7, 8, 9), (4, 5, 6)),
        ("velocity2d", (1, 2), (3, 4), (3, 4), (3, 4)),
        # cos and sin of pi / 6.
        (
            "differential_drive",
            (1, 2, math.pi / 6, 4),
            (5, 6),
            (4 * math.sqrt(0.75), 2, 5, 6),
            (4 * math.sqrt(0.75), 2),
        ),
        ("differential_drive", (1, 2, math.pi, 4), (5, 6), (-4, 0, 5, 6), (-4, 0)),
        ("unicycle", (1, 2, math.pi / 6), (4, 5), (4 * math.sqrt(0.75), 2, 5), (4 * math.sqrt(0.75), 2)),
        # It turns at v tan(steering) / wheelbase, here 2 * 1 / 0.25.
        ("car", (1, 2, math.pi / 2, 2, math.pi / 4), (5, 6), (0, 2, 8, 5, 6), (0, 2)),
        ("car", (1, 2, 0, -2, math.pi / 4), (5, 6), (-2, 0, -8, 5, 6), (-2, 0)),
        ("unicycle1", (1, 2, math.pi / 6), (4, 5), (4 * math.sqrt(0.75), 2, 5), (4 * math.sqrt(0.75), 2)),
        ("unicycle2", (1, 2, math.pi / 2, 3, 4), (5, 6), (0, 3, 4, 5, 6), (0, 3)),
        ("holonomic2d_jerk", (1, 2, 3, 4, 5, 6), (7, 8), (3, 4, 5, 6, 7, 8), (3, 4)),
        ("car_first_order", (1, 2, math.pi / 2), (-0.5, math.pi / 4), (0, -0.5, -2), (0, -0.5)),
        # Backwards at 0.5 m/s with sin(pi / 6) = 1/2, over 0.4 m.
        ("car_with_1_trailer", (1, 2, 0, math.pi / 6), (-0.5, 0), (-0.5, 0, 0, 0.625), (-0.5, 0)),
        ("car_with_1_trailer", (1, 2, 0, 0), (0.5, math.pi / 4), (0.5, 0, 2, 2), (0.5, 0)),
        # A drag of 0.6 / s.
        ("holonomic3d_drag", (1, 2, 3, 10, 20, -5), (7, 8, 9), (10, 20, -5, 1, -4, 12), (10, 20, -5)),
    ],
)
def test_derivatives_and_velocities(name: str, x: Any, u: Any, derivative: Any, velocity: Any) -> None:
    functions = MODELS[name].functions
    assert functions.derivative(x, u, CAR_LIMITS, PYTHON_OPS) == pytest.approx(derivative, abs=1e-12)
    assert functions.velocity(x, u, CAR_LIMITS, PYTHON_OPS) == pytest.approx(velocity, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "u", "limited"),
    [
        ("holonomic2d", (3.0, 4.0), (0.6, 0.8)),  # by norm, to the acceleration limit of 1
        ("holonomic2d", (0.6, -0.8), (0.6, -0.8)),
        ("holonomic2d", (0.3, 0.1), (0.3, 0.1)),
        ("holonomic2d", (0.0, 0.0), (0.0, 0.0)),
        ("holonomic3d", (2.0, 3.0, -6.0), (2 / 7, 3 / 7, -6 / 7)),
        ("holonomic3d", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
        ("velocity2d", (-6.0, 8.0), (-1.2, 1.6)),  # by norm, to the speed limit of 2
        ("velocity2d", (1.0, 1.0), (1.0, 1.0)),
        ("differential_drive", (0.7, -3.0), (0.5, -1.0)),  # each component to its own limit
        ("differential_drive", (-0.7, 0.9), (-0.5, 0.9)),
        ("differential_drive", (0.4, 3.0), (0.4, 1.0)),
        ("unicycle", (-3.0, 0.7), (-2.0, 0.5)),  # speed and turn rate
        ("car", (-3.0, 2.0), (-1.0, 1.5)),  # acceleration and steering rate
        ("unicycle1", (-3.0, 0.7), (-0.6, 0.5)),  # backwards it has limits of its own
        ("unicycle1", (3.0, -2.0), (2.0, -1.5)),
        ("unicycle2", (-3.0, 2.0), (-1.0, 0.25)),
        ("car_with_2_trailers", (-3.0, 2.0), (-1.5, 0.6)),
        ("holonomic2d_jerk", (3.0, 4.0), (0.36, 0.48)),
    ],
)
def test_control_limits(name: str, u: Any, limited: Any) -> None:
    assert MODELS[name].functions.limit_control(u, CAR_LIMITS, PYTHON_OPS) == pytest.approx(limited, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "x", "limited"),
    [
        ("holonomic2d", (7.0, 8.0, 3.0, -4.0), (7.0, 8.0, 1.2, -1.6)),
        ("holonomic2d", (7.0, 8.0, 1.0, 1.0), (7.0, 8.0, 1.0, 1.0)),
        ("holonomic3d", (7.0, 8.0, 9.0, 2.0, 3.0, 6.0), (7.0, 8.0, 9.0, 4 / 7, 6 / 7, 12 / 7)),
        ("velocity2d", (70.0, 80.0), (70.0, 80.0)),
        ("differential_drive", (7.0, 8.0, 9.0, 2.5), (7.0, 8.0, 9.0, 2.0)),
        ("differential_drive", (7.0, 8.0, 9.0, -2.5), (7.0, 8.0, 9.0, -0.6)),  # backwards it has a limit of its own
        ("unicycle", (7.0, 8.0, 9.0), (7.0, 8.0, 9.0)),
        ("car", (7.0, 8.0, 9.0, -2.5, 0.7), (7.0, 8.0, 9.0, -0.5, 0.6)),
        ("car", (7.0, 8.0, 9.0, 1.5, -0.7), (7.0, 8.0, 9.0, 1.5, -0.6)),
        ("unicycle2", (7.0, 8.0, 9.0, -2.5, 0.7), (7.0, 8.0, 9.0, -0.6, 0.5)),
        ("unicycle2", (7.0, 8.0, 9.0, 2.5, -1.6), (7.0, 8.0, 9.0, 2.0, -1.5)),
        ("car_with_3_trailers", (7.0, 8.0, 9.0, 1.0, -1.0, 0.3), (7.0, 8.0, 9.0, 0.5, -0.6, 0.3)),
        ("holonomic2d_jerk", (7.0, 8.0, 3.0, -4.0, 3.0, 4.0), (7.0, 8.0, 1.2, -1.6, 0.6, 0.8)),
    ],
)
def test_speed_limits(name: str, x: Any, limited: Any) -> None:
    assert MODELS[name].functions.limit_state(x, CAR_LIMITS, PYTHON_OPS) == pytest.approx(limited, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "x", "rest"),
    [
        ("holonomic2d", (1, 2, 3, 4), (1, 2, 0, 0)),
        ("holonomic3d", (1, 2, 3, 4, 5, 6), (1, 2, 3, 0, 0, 0)),
        ("velocity2d", (1, 2), (1, 2)),
        ("differential_drive", (1, 2, 3, 4), (1, 2, 3, 0)),
        ("unicycle", (1, 2, 3), (1, 2, 3)),
        ("car", (1, 2, 3, 4, 5), (1, 2, 3, 0, 5)),
        ("unicycle2", (1, 2, 3, 4, 5), (1, 2, 3, 0, 0)),
        ("car_with_2_trailers", (1, 2, 3, 4, 5), (1, 2, 3, 4, 5)),
        ("holonomic2d_jerk", (1, 2, 3, 4, 5, 6), (1, 2, 0, 0, 0, 0)),
    ],
)
def test_rest_keeps_position_and_heading(name: str, x: Any, rest: Any) -> None:
    assert MODELS[name].functions.rest(x, 0) == rest


@pytest.mark.parametrize("name", MODELS)
@given(data=st.data())
def test_limited_controls_keep_the_limits_and_the_direction(name: str, data: st.DataObject) -> None:
    model = MODELS[name]
    number = st.floats(-1e3, 1e3)
    u = tuple(data.draw(number) for _ in range(model.control_size))
    limited = model.functions.limit_control(u, CAR_LIMITS, PYTHON_OPS)
    again = model.functions.limit_control(limited, CAR_LIMITS, PYTHON_OPS)
    assert again == pytest.approx(limited, rel=1e-12, abs=1e-300)
    lower = model.lower_bounds(list(CAR_LIMITS))
    bounds = [(-lower[column], CAR_LIMITS[column]) for column in model.control_limits]
    assert all(a * (1 + 1e-12) <= v <= b * (1 + 1e-12) for v, (a, b) in zip(limited, bounds))
    assert all(v * w >= 0 and abs(v) <= abs(w) * (1 + 1e-12) for v, w in zip(limited, u))
    if len(set(model.control_limits)) == 1:
        assert math.hypot(*limited) <= CAR_LIMITS[model.control_limits[0]] * (1 + 1e-12)
        # Parallel to what was asked for.
        assert math.hypot(*u) * math.hypot(*limited) == pytest.approx(sum(v * w for v, w in zip(limited, u)), abs=1e-9)


def cases(name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """States and controls of one robot, inside and outside its limits."""
    model, generator = MODELS[name], np.random.default_rng(1)
    reach = np.full(model.state_size, 3.0)
    for index, column in model.state_limits:
        reach[index] = CAR_LIMITS[column] / 2
    return [(generator.uniform(-reach, reach), generator.uniform(-2, 2, model.control_size)) for _ in range(20)]


def next_state(name: str, x: Any, u: Any, ops: Ops, number: Any) -> np.ndarray:
    """The state after one step of 0.1 s, in the precision and with the functions of one library."""
    functions = MODELS[name].functions
    limits = tuple(number(limit) for limit in CAR_LIMITS)
    h = TimeStep(*(number(0.1 / part) for part in (1, 2, 3, 6)))
    x, u = tuple(number(value) for value in x), tuple(number(value) for value in u)
    return np.array(advance(functions, x, functions.limit_control(u, limits, ops), limits, h, ops), np.float64)


@pytest.mark.parametrize("name", MODELS)
def test_the_same_source_gives_the_same_step_in_every_library(name: str) -> None:
    for x, u in cases(name):
        python = next_state(name, x, u, PYTHON_OPS, float)
        np.testing.assert_allclose(next_state(name, x, u, NUMPY_OPS, np.float64), python, rtol=1e-14, atol=1e-14)
        np.testing.assert_allclose(next_state(name, x, u, NUMPY_OPS, np.float32), python, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(next_state(name, x, u, JAX_OPS, jnp.float32), python, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("name", MODELS)
def test_the_engines_compile_that_very_step(engine: str, name: str) -> None:
    own = {limit.name: value for limit, value in zip(MODELS[name].own_limits, CAR_LIMITS[3:])}
    team = Team((name,), 0.15, *LIMITS, own)
    problem = Problem(team, np.zeros((1, team.state_size)), np.full((1, team.dimension), 50.0))
    physics = get_engine(engine)
    for x, u in cases(name):
        result = physics.step(problem.arrays, x[None].astype(np.float32), np.zeros(1, bool), u[None].astype(np.float32))
        functions = MODELS[name].functions
        np.testing.assert_allclose(result.states[0], next_state(name, x, u, PYTHON_OPS, float), rtol=1e-6, atol=2e-6)
        np.testing.assert_allclose(
            result.controls[0], functions.limit_control(tuple(u), CAR_LIMITS, PYTHON_OPS), rtol=1e-6, atol=1e-6
        )
