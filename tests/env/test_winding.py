"""Headings do not wind up: one rule, whatever moves the robots and wherever their states come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from engine_support import ENGINE_NAMES, NUMPY_OPS, PYTHON_OPS
from hypothesis import given
from hypothesis import strategies as st
from registry_support import forgetting

from d4orm_env import make_problem, mujoco, navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.winding import MAX_ANGLE, unwound
from d4orm_env.dynamics.models import MODELS, get_model, register_model
from d4orm_env.engine.choice import rollout
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.jax import functional
from d4orm_env.verify import verify

STEPS, RATE = 12, 1.5


def spinning(heading: float, model: str = "differential_drive", **changes: Any) -> Problem:
    """A robot that has nearly made eight turns; its goal is far away."""
    team = Team((model,))
    start = np.zeros((1, team.state_size), np.float32)
    start[0, 2] = heading
    return Problem(team, start, [[0, 20]], **{"horizon": STEPS, **changes})


def controls(model: str = "differential_drive") -> np.ndarray:
    """``(T, 1, 2)`` that turn a robot to the left as it drives."""
    return np.tile(np.float32([RATE, 0.5] if model == "differential_drive" else [0.5, RATE]), (STEPS, 1, 1))


def apart(one: Any, other: Any) -> Any:
    """By how much angles differ, whole turns aside [rad]."""
    difference = np.asarray(one, np.float64) - np.asarray(other, np.float64)
    return np.abs((difference + np.pi) % (2 * np.pi) - np.pi)


@given(st.floats(-2 * float(MAX_ANGLE), 2 * float(MAX_ANGLE), width=32))
def test_an_angle_is_taken_back_where_it_is_beyond_eight_turns(angle: float) -> None:
    value = np.float32(angle)
    result = unwound(np.array([value]), NUMPY_OPS)
    assert result.dtype == np.float32
    assert abs(result[0]) <= MAX_ANGLE
    assert apart(result[0], value) <= 1e-7 + np.spacing(abs(result[0])) / 2
    if abs(value) <= MAX_ANGLE:
        assert result.tobytes() == value.tobytes()
        assert unwound(angle, PYTHON_OPS) is angle


def test_literal_angles() -> None:
    given_angles = np.float32([50.0, 50.265483, 51.0, -51.0, 100.0, -0.0, np.inf])
    expected = [50.0, 50.265483, 0.7345175, -0.7345175, 49.734516, 0.0, np.inf]
    assert unwound(given_angles, NUMPY_OPS).tolist() == np.float32(expected).tolist()
    assert np.signbit(unwound(given_angles, NUMPY_OPS)[5])
    assert np.isnan(unwound(np.float32(np.nan), NUMPY_OPS))


def stepped(problem: Problem) -> Any:
    env = navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    return [own_state(env, problem, {"robot_0": control[0]}) for control in controls()]


def own_state(env: Any, problem: Problem, action: Any) -> Any:
    """The heading after a step; the state is one of the space, and may be set."""
    env.step(action)
    state, states = env.unwrapped.state(), split_state(problem, env.unwrapped.state()).states
    if (space := getattr(env.unwrapped, "state_space", None)) is not None:
        assert space.contains(state)
    env.unwrapped.set_state(states)
    np.testing.assert_array_equal(split_state(problem, env.unwrapped.state()).states, states)
    return states[0, 2]


def jointly(problem: Problem) -> Any:
    env = gymnasium.make("d4orm/Navigation-v0", problem=problem)
    env.reset(seed=0)
    return [own_state(env, problem, control[0]) for control in controls()]


def batched(problem: Problem) -> Any:
    env, headings = NavigationVectorEnv(2, problem=problem), []
    env.reset(seed=0)
    for control in controls():
        env.step(np.tile(control, (2, 1)))
        states = np.stack([split_state(problem, state).states for state in env.state()])
        env.set_state(states)
        headings.append(states[1, 0, 2])
    return headings


def purely(problem: Problem) -> Any:
    state, step, headings = functional.reset(problem, jax.random.key(0)), jax.jit(functional.step), []
    for control in controls():
        state, _ = step(problem, state, control)
        headings.append(float(state.states[0, 2]))
    return headings


FORMS: dict[str, Callable[[Problem], Any]] = {
    "env.step": stepped,
    "joint": jointly,
    "batched": batched,
    "functional": purely,
    **{f"rollout {engine}": lambda problem, engine=engine: rollout(problem, controls(), engine=engine).states[1:, 0, 2]
       for engine in ENGINE_NAMES},
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_all_wind_alike(form: str) -> None:
    headings = np.asarray(FORMS[form](spinning(50.0)))
    expected = 50.0 + 0.1 * RATE * np.arange(1, STEPS + 1)
    np.testing.assert_allclose(headings, np.where(expected > MAX_ANGLE, expected - 16 * np.pi, expected), atol=2e-5)
    np.testing.assert_allclose(FORMS[form](spinning(-50.0))[0], -49.85, atol=1e-5)


@given(st.floats(-50.25, 50.25, width=32))
def test_a_start_of_some_turns_leads_where_the_same_angle_leads(heading: float) -> None:
    problem = spinning(heading)
    start = problem.start[0, 2]
    assert start == heading
    near = spinning(float(np.remainder(np.float64(start) + np.pi, 2 * np.pi) - np.pi))
    assert problem.replace() == problem
    one, other = (rollout(each, controls(), engine="cpu") for each in (problem, near))
    np.testing.assert_allclose(one.positions, other.positions, atol=2e-5)


def test_a_state_that_is_set_is_unwound() -> None:
    env = navigation_v0.parallel_env(problem=spinning(0.0))
    env.reset(seed=0)
    env.set_state([[0, 0, 999.0, 0.5]])
    assert split_state(env.problem, env.state()).states[0, 2] == pytest.approx(999 - 19 * 16 * np.pi, abs=1e-5)
    with pytest.raises(ValueError, match="state heading of robot_0 is 1001 rad; it must be at most 1000"):
        env.set_state([[0, 0, 1001.0, 0.5]])


def test_a_plan_that_winds_up_is_verified() -> None:
    problem = spinning(50.0, horizon=60, goal_radius=0.2)
    # On a circle of a third of a metre; the goal is on it, after the ninth turn has begun.
    wanted = np.tile(np.float32([RATE, 1.0]), (60, 1, 1))
    goal = rollout(problem, wanted, engine="cpu").positions[55, 0]
    problem = problem.replace(goal=goal[None])
    motion = rollout(problem, wanted, engine="cpu")
    assert np.abs(motion.states[..., 2]).max() <= MAX_ANGLE < 50 + 6.0
    assert verify(problem, wanted).ok == bool(motion.arrived[-1].all())


def test_bodies_of_mujoco_wind_alike() -> None:
    problem = spinning(50.0)
    env = mujoco.parallel_env(problem=problem)
    env.reset(seed=0)
    headings = [own_state(env, problem, {"robot_0": control[0]}) for control in controls()]
    assert max(headings) <= MAX_ANGLE
    assert apart(headings[-1], 50.0 + 0.1 * RATE * STEPS) < 0.1
    assert headings[-1] < 3


def test_more_turns_in_a_step_than_are_taken_back_are_refused() -> None:
    with pytest.raises(ValueError, match=r"robot_0 may turn by 60 rad in a step of 1 s, more than 8 turns; use"):
        Problem(Team(("unicycle",), max_turn_rate=60, max_speed=1e-6), [[0, 0, 0]], [[1e-4, 0]], dt=1.0, margin=1e-7,
                goal_radius=1e-6)  # fmt: skip


def _derivative(x: Any, u: Any, limits: Any, ops: Any) -> Any:
    turn = u[0] * ops.sin(x[2] - x[3])
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]), u[1], turn)


def _rest(x: Any, zero: Any) -> Any:
    return x


def _limit_state(x: Any, limits: Any, ops: Any) -> Any:
    return x


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_model_names_angles_of_its_own(engine: str) -> None:
    unicycle = get_model("unicycle")
    tractor = replace(
        unicycle,
        name="tractor",
        state_names=("px", "py", "heading", "trailer"),
        own_angles=(3,),
        start_angles=(3,),
        functions=unicycle.functions._replace(
            derivative=_derivative, limit_state=_limit_state, rest=_rest, integrate=None
        ),
    )
    assert tractor.angles == (2, 3)
    assert (
        replace(tractor, own_angles=(), start_angles=()).functions.limit_state((0, 0, 51.0, 51.0), (), PYTHON_OPS)[3]
        == 51.0
    )
    with forgetting(MODELS):
        register_model(tractor)
        team = Team(("tractor",))
        problem = Problem(team, [[0, 0, 50, 49]], [[0, 20]], horizon=STEPS)
        states = rollout(problem, np.tile(np.float32([0.5, RATE]), (STEPS, 1, 1)), engine=engine).states
        env = navigation_v0.parallel_env(problem=problem)
        assert env.state_space.high[3] == pytest.approx(MAX_ANGLE, rel=0.01)
        starts = make_problem("circle", num_robots=3, model="tractor").start
        np.testing.assert_array_equal(starts[:, 3], starts[:, 2])
        with pytest.raises(ValueError, match="start_angles has an index that own_angles lacks"):
            register_model(replace(tractor, name="other", start_angles=(2,)))
    assert np.abs(states[..., 2:]).max() <= MAX_ANGLE
    assert states[-1, 0, 2] == pytest.approx(50 + 0.1 * RATE * STEPS - 16 * np.pi, abs=1e-4)
    assert 49 < states[-1, 0, 3] < 50.2
