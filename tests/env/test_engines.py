"""The two engines: the same steps and rollouts, the same refusals, and the machinery around the CPU kernels."""

from __future__ import annotations

import os
import threading
from dataclasses import fields
from typing import Any

import numba
import numpy as np
import pytest
from engine_support import ENGINE_NAMES, MODEL_NAMES, NUMPY_OPS, open_problem, random_controls, toward_goals
from env_support import mixed_problem, scenario_params, trains

from d4orm_env import rollout
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.transition import TimeStep, advance
from d4orm_env.engine import cpu, elementary
from d4orm_env.engine.choice import ENGINES, get_engine
from d4orm_env.engine.cpu import CpuEngine
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_env.engine.types import StepResult
from d4orm_env.jax.jax_engine import JaxEngine
from d4orm_env.scenarios import make_problem

CPU, JAX = CpuEngine(), JaxEngine()
HORIZON = 20


def test_engines_by_name() -> None:
    assert ENGINES == ("auto", "cpu", "jax")
    assert get_engine("cpu").name == "cpu"
    assert get_engine("jax").name == "jax"


@pytest.mark.parametrize(("backend", "name"), [("cpu", "cpu"), ("gpu", "jax"), ("tpu", "jax")])
def test_auto_is_jax_where_it_sees_an_accelerator(monkeypatch: pytest.MonkeyPatch, backend: str, name: str) -> None:
    monkeypatch.setattr("jax.default_backend", lambda: backend)
    assert get_engine("auto").name == name
    assert get_engine().name == name


@pytest.mark.parametrize("name", ["gpu", "CPU", "", "numba"])
def test_an_unknown_engine_is_named_with_those_there_are(name: str) -> None:
    with pytest.raises(ValueError, match=f"engine {name!r} is unknown; choose one of auto, cpu, jax"):
        get_engine(name)


def test_an_unknown_engine_is_refused_by_rollout() -> None:
    with pytest.raises(ValueError, match="engine 'gpu' is unknown"):
        rollout(open_problem(1), np.zeros((100, 1, 2)), engine="gpu")


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("shape", [(4, 2, 2), (5, 1, 2), (5, 2, 3), (5, 4), (1, 5, 2, 2)])
def test_controls_of_another_shape_are_refused(engine: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"controls have shape .*; expected \(H, K, m\) = \(5, 2, 2\)"):
        rollout(open_problem(2, horizon=5), np.zeros(shape), engine=engine)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_controls_that_are_not_finite_are_refused_by_place(engine: str, value: float) -> None:
    controls = np.zeros((5, 2, 2))
    controls[3, 1, 0] = value
    with pytest.raises(ValueError, match=r"controls\[3, 1, 0\] is not finite; every control must be"):
        rollout(open_problem(2, horizon=5), controls, engine=engine)


def assert_same_motion(first: Trajectory, second: Trajectory) -> None:
    for name in ("states", "positions", "rewards", "controls"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), atol=1e-5, err_msg=name)
    for name in ("arrived", "collided", "margin_violated"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


@pytest.mark.parametrize("case", scenario_params(4))
def test_engines_roll_out_alike(case: dict[str, Any]) -> None:
    problem = make_problem(**case, horizon=HORIZON, dt=0.3)
    # Not at full throttle, under which some stand at exactly the margin of each other.
    for controls in (random_controls(problem, 5), 0.97 * toward_goals(problem)):
        first, second = CPU.rollout(problem, controls), JAX.rollout(problem, controls)
        assert_same_motion(first, second)
    # Six seconds toward the goals: everyone has moved.
    assert (np.linalg.norm(first.positions[-1] - first.positions[0], axis=-1) > 0.5).all()


BUSY = make_problem("circle", num_robots=6, diameter=1.6, model="velocity2d", horizon=30, goal_radius=0.2)


def test_what_is_compared_includes_contacts_and_arrivals() -> None:
    first, second = (engine.rollout(BUSY, 0.95 * toward_goals(BUSY)) for engine in (CPU, JAX))
    assert_same_motion(first, second)
    for flags in (first.collided, first.arrived):
        assert flags.any()
        assert not flags.all()
    assert (first.margin_violated & ~first.collided).any()


def assert_same_step(first: StepResult, second: StepResult) -> None:
    for name in ("states", "controls", "rewards"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), atol=1e-5, err_msg=name)
    for name in ("arrived", "collided", "margin_violated"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


TEAMS = {
    **{
        name: make_problem("circle", num_robots=5, model=name, diameter=3.0, num_obstacles=1, horizon=HORIZON)
        for name in MODEL_NAMES
    },
    "mixed": mixed_problem(),
    "trains": trains(),
}


@pytest.mark.parametrize("name", TEAMS)
def test_engines_step_alike_from_anywhere(name: str) -> None:
    problem = TEAMS[name]
    generator = np.random.default_rng(0)
    for controls in random_controls(problem, 1)[:10]:
        states = (problem.start + generator.uniform(-1, 1, problem.start.shape)).astype(np.float32)
        for robot, model in enumerate(problem.team.robot_models):
            states[robot, model.state_size :] = 0
        arrived = generator.random(problem.num_robots) < 0.3
        first, second = (engine.step(problem.arrays, states, arrived, controls) for engine in (CPU, JAX))
        assert_same_step(first, second)
        assert (first.arrived >= arrived).all()


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_samples_are_scored_as_they_are_rolled_out(engine: str) -> None:
    physics, samples = get_engine(engine), np.stack([random_controls(BUSY, seed) for seed in range(5)])
    expected = [physics.rollout(BUSY, controls).rewards.mean(axis=0) for controls in samples]
    np.testing.assert_allclose(physics.score(BUSY, samples), expected, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match=r"expected \(M, H, K, m\) = \(M, 30, 6, 2\)"):
        physics.score(BUSY, samples[0])
    samples[2, 3, 1, 0] = np.nan
    with pytest.raises(ValueError, match=r"controls\[2, 3, 1, 0\] is not finite"):
        physics.score(BUSY, samples)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("name", TEAMS)
def test_a_rollout_is_its_steps(engine: str, name: str) -> None:
    problem, physics = TEAMS[name], get_engine(engine)
    controls = random_controls(problem, 2)
    trajectory = physics.rollout(problem, controls)
    states, arrived = problem.start, np.zeros(problem.num_robots, bool)
    for t, control in enumerate(controls):
        result = physics.step(problem.arrays, states, arrived, control)
        states, arrived = result.states, result.arrived
        np.testing.assert_allclose(states, trajectory.states[t + 1], atol=1e-6)
        np.testing.assert_allclose(result.controls, trajectory.controls[t], atol=1e-6)
        np.testing.assert_allclose(result.rewards, trajectory.rewards[t], rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(arrived, trajectory.arrived[t + 1])
        np.testing.assert_array_equal(result.collided, trajectory.collided[t + 1])
        np.testing.assert_array_equal(result.margin_violated, trajectory.margin_violated[t + 1])


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_shapes_types_and_the_first_row(engine: str) -> None:
    problem = mixed_problem()
    trajectory = rollout(problem, random_controls(problem, 0).tolist(), engine=engine)
    steps, robots = problem.horizon, problem.num_robots
    assert trajectory.states.shape == (steps + 1, robots, 4)
    assert trajectory.positions.shape == (steps + 1, robots, 2)
    assert trajectory.controls.shape == (steps, robots, 2)
    assert trajectory.rewards.shape == (steps, robots)
    for name in ("states", "positions", "controls", "rewards"):
        assert getattr(trajectory, name).dtype == np.float32
    for name in ("arrived", "collided", "margin_violated"):
        assert getattr(trajectory, name).shape == (steps + 1, robots)
        assert getattr(trajectory, name).dtype == bool
    np.testing.assert_array_equal(trajectory.states[0], problem.start)
    np.testing.assert_array_equal(trajectory.positions, trajectory.states[..., :2])
    assert not trajectory.arrived[0].any()


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_padding_stays_zero(engine: str) -> None:
    problem = mixed_problem()  # robot 0 is a velocity2d among states of four
    trajectory = rollout(problem, random_controls(problem, 0), engine=engine)
    np.testing.assert_array_equal(trajectory.states[:, 0, 2:], 0)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_arguments_are_left_alone(engine: str) -> None:
    problem = mixed_problem()
    states, arrived = problem.start.copy(), np.array([False, True, False])
    controls = random_controls(problem, 0)
    before = states.copy(), arrived.copy(), controls.copy()
    physics = get_engine(engine)
    physics.step(problem.arrays, states, arrived, controls[0])
    physics.rollout(problem, controls)
    for old, new in zip(before, (states, arrived, controls), strict=True):
        np.testing.assert_array_equal(old, new)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_robots_on_their_own_move_as_in_a_team(engine: str) -> None:
    """Nobody's motion depends on who else is there; team size and lane do not matter."""
    problem = TEAMS["mixed"]
    controls = random_controls(problem, 3)
    together = rollout(problem, controls, engine=engine)
    for robot in range(problem.num_robots):
        alone = problem.select([robot])
        trajectory = rollout(alone, controls[:, [robot]], engine=engine)
        np.testing.assert_allclose(trajectory.positions[:, 0], together.positions[:, robot], atol=1e-6)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_goals_may_change_on_the_way(engine: str) -> None:
    problem = open_problem(2)
    start = problem.start[:, :2]
    arrays = problem.arrays._replace(
        goal=start + np.array([[0.05, 0], [0, 2]], np.float32), inverse_initial_distance=np.array([1, 0.25], np.float32)
    )
    result = get_engine(engine).step(arrays, problem.start, np.zeros(2, bool), np.zeros((2, 2), np.float32))
    assert result.arrived.tolist() == [True, False]
    np.testing.assert_allclose(result.rewards, [0.95, 0.5], atol=1e-5)


@numba.njit
def _sine(x: Any) -> Any:
    return elementary.sine(x)


@numba.njit
def _cosine(x: Any) -> Any:
    return elementary.cosine(x)


def test_the_vectorised_sine_and_cosine() -> None:
    # Headings wind up by at most a few turns.
    angles = np.linspace(-30, 30, 20_001, dtype=np.float32)
    exact = angles.astype(np.float64)
    np.testing.assert_allclose([_sine(x) for x in angles], np.sin(exact), atol=1e-6)
    np.testing.assert_allclose([_cosine(x) for x in angles], np.cos(exact), atol=1e-6)
    near = np.abs(exact) < 2 * np.pi
    np.testing.assert_allclose([_sine(x) for x in angles[near]], np.sin(exact[near]), atol=2e-7)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_float32_stays_close_to_float64_over_a_whole_horizon(model: str) -> None:
    problem = Problem(
        Team((model,)), np.zeros((1, MODELS[model].state_size)), np.full((1, MODELS[model].dimension), 99.0)
    )
    controls = random_controls(problem, 8, scale=0.4)
    functions = MODELS[model].functions
    limits, h = tuple(problem.team.limits[0].astype(np.float64)), TimeStep(0.1, 0.05, 0.1 / 3, 0.1 / 6)
    x = tuple(problem.start[0].astype(np.float64))
    for control in controls[:, 0].astype(np.float64):
        x = advance(functions, x, functions.limit_control(tuple(control), limits, NUMPY_OPS), limits, h, NUMPY_OPS)
    for engine in (CPU, JAX):
        np.testing.assert_allclose(engine.rollout(problem, controls).states[-1, 0], x, atol=2e-5)


@pytest.mark.parametrize("name", ["circle", "four_obstacles"])
def test_threads_that_share_a_rollout_find_the_same(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    problem = make_problem(name, num_robots=6, horizon=150)
    controls = toward_goals(problem)
    alone = CPU.rollout(problem, controls)
    assert alone.collided.any()
    shared, over = list[int](), Threads.over
    monkeypatch.setattr(cpu, "SHARED", 0)
    monkeypatch.setattr(Threads, "over", lambda self, count, work: shared.append(count) or over(self, count, work))
    together = CpuEngine(3).rollout(problem, controls)
    assert shared == [3]
    for field in fields(Trajectory):
        np.testing.assert_array_equal(getattr(together, field.name), getattr(alone, field.name))


class TestThreads:
    @pytest.mark.parametrize("num_threads", [1, 2, 3, 7])
    @pytest.mark.parametrize("count", [0, 1, 2, 3, 5, 16, 33])
    def test_parts_make_up_the_range(self, num_threads: int, count: int) -> None:
        seen, lock = np.zeros(count, int), threading.Lock()

        def work(part: Any) -> None:
            first, last = part
            with lock:
                seen[first:last] += 1

        Threads(num_threads).over(count, work)
        assert (seen == 1).all()

    def test_parts_run_at_the_same_time(self) -> None:
        meeting = threading.Barrier(3, timeout=30)
        met = []
        # Whoever waits alone breaks the barrier, which raises.
        Threads(3).over(3, lambda part: met.append(meeting.wait()))
        assert sorted(met) == [0, 1, 2]

    @pytest.mark.parametrize("failing", [0, 2])
    def test_an_error_in_any_part_is_raised(self, failing: int) -> None:
        def work(part: Any) -> None:
            if part[0] == failing:
                raise RuntimeError("a part failed")

        with pytest.raises(RuntimeError, match="a part failed"):
            Threads(3).over(3, work)

    def test_parts_that_share_their_work_do_not_wait_for_each_other(self) -> None:
        seen: list[int] = []

        def work(part: Any) -> None:
            Threads(3).over(3, lambda inner: seen.extend(range(*inner)))

        caller = threading.Thread(target=Threads(3).over, args=(3, work), daemon=True)
        caller.start()
        caller.join(30)
        assert sorted(seen) == [0, 0, 0, 1, 1, 1, 2, 2, 2]

    def test_the_number_comes_from_the_environment(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("D4ORM_NUM_THREADS", "3")
        assert available_cores() == 3
        monkeypatch.delenv("D4ORM_NUM_THREADS")
        assert 1 <= available_cores() <= (os.cpu_count() or 1)

    @pytest.mark.parametrize("value", ["0", "-1", "two", "1.5", ""])
    def test_a_bad_number_is_refused(self, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
        monkeypatch.setenv("D4ORM_NUM_THREADS", value)
        with pytest.raises(ValueError, match=f"D4ORM_NUM_THREADS is {value!r}; it must be a positive whole number"):
            get_engine("cpu")
