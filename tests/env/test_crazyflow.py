"""Teams as drones in crazyflow: the same interface, and flights by another's physics and controller."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from d4orm_env import Problem, Team, World, make_problem, navigation_v0
from d4orm_env.footprints import Ellipsoid
from d4orm_planners import make_planner, run_episode
from d4orm_planners.base.episode import open_env
from d4orm_planners.base.policy import OpenLoop

# At once, for crazyflow must come before SciPy.
crazyflow: Any = importlib.import_module("d4orm_env.crazyflow") if importlib.util.find_spec("crazyflow") else None
needs_crazyflow = pytest.mark.skipif(
    crazyflow is None, reason="crazyflow is not installed: make integrations, or pip install 'd4orm-env[drones]'"
)


@pytest.fixture(autouse=True)
def _as_crazyflow_needs() -> Iterator[None]:
    """JAX broadcasts in its functions."""
    with jax.numpy_rank_promotion("allow"):
        yield


def swap(**changes: Any) -> Problem:
    start, goal = np.zeros((2, 6), np.float32), np.array([[0.8, 0.5, 1], [0, 0, 1]], np.float32)
    start[:, :3] = [[0, 0.5, 1], [0.8, 0, 1]]
    settings = {"team": Team(("holonomic3d",) * 2, radius=0.07, max_acceleration=2.0), "start": start, "goal": goal}
    return Problem(**(settings | {"margin": 0.1, "horizon": 40} | changes))


def test_a_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("d4orm_env.crazyflow")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"need crazyflow; install it with: pip install 'd4orm-env\[drones\]'$"):
        open_env(swap(), "crazyflow")


def test_another_physics_in_place_of_an_environments_own() -> None:
    env = navigation_v0.parallel_env("random", num_robots=2, seed=3, max_cycles=5)
    own, other = run_episode(env, "go-to-goal", seed=4), run_episode(env, "go-to-goal", seed=4, physics="mujoco")
    assert own.problem == other.problem
    np.testing.assert_array_equal(own.trajectory.states[0], other.trajectory.states[0])
    assert not np.array_equal(own.trajectory.states, other.trajectory.states)
    with pytest.raises(ValueError, match="physics is 'bullet'; choose one of model, mujoco, crazyflow"):
        run_episode(env, "go-to-goal", physics="bullet")


@needs_crazyflow
def test_its_libraries_print_nothing_and_leave_no_file(tmp_path: Path) -> None:
    program = (
        "from d4orm_env.crazyflow import DronePhysics\n"
        "from d4orm_env.crazyflow.flight import Flight\n"
        "Flight(2, DronePhysics().drone, 1.0, 1.0)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    assert not list(tmp_path.iterdir())


@needs_crazyflow
def test_a_plan_is_flown_and_gusts_are_felt() -> None:
    problem = swap()
    plan = make_planner("hybrid").solve(problem, seed=0)
    assert plan.solved
    calm = run_episode(navigation_v0.parallel_env(problem=problem), OpenLoop(plan=plan), physics="crazyflow")
    assert calm.metrics["success"] == 1
    assert np.abs(calm.trajectory.positions - plan.trajectory.positions[: len(calm.trajectory.positions)]).max() < 0.15
    records = []
    for seed in (1, 1, 2):
        env = crazyflow.parallel_env(problem=problem, physics=crazyflow.DronePhysics(gust=0.03, mass_factor=1.05))
        assert run_episode(env, OpenLoop(plan=plan), seed=seed).metrics["collided"] == 0
        records.append(env.flight)
    assert not records[0].fallen.any()
    assert (records[0].least_gap > 0).all()
    np.testing.assert_array_equal(records[0].largest_error, records[1].largest_error)
    assert (records[0].largest_error != records[2].largest_error).all()


@needs_crazyflow
@pytest.mark.slow
def test_a_policy_that_sees_the_drones_brings_them_to_their_goals() -> None:
    problem = swap(horizon=80, start=[[0, 0.5, 1, 0, 0, 0], [2, 0, 1, 0, 0, 0]], goal=[[2, 0.5, 1], [0, 0, 1]])
    env = crazyflow.parallel_env(problem=problem, physics=crazyflow.DronePhysics(gust=0.02, mass_factor=1.05))
    episode = run_episode(env, "d4orm-c2f", seed=0)
    assert episode.metrics["success"] == 1
    assert not env.flight.fallen.any()
    env.reset(seed=1)
    np.testing.assert_array_equal(env.state(), env.unwrapped.true_state())
    for _ in range(5):
        env.step({agent: np.ones(3, np.float32) for agent in env.agents})
    assert 0 < np.abs(env.state() - env.unwrapped.true_state()).max() < 0.5


@needs_crazyflow
def test_contacts_between_steps_and_falls_count() -> None:
    problem = swap(world=World(3, spheres=[[0.4, 0.5, 1, 0.1]]))
    env = crazyflow.parallel_env(problem=problem)
    env.reset(seed=0)
    for _ in range(14):
        env.step({agent: np.float32([2, 0, 0] if agent == "robot_0" else [0, 0, 0]) for agent in env.agents})
    assert env.metrics()["collided"] == 1
    assert env.flight.least_clearance[0] < 0
    bodies = crazyflow.DroneBodies(problem, np.zeros(0, np.float32), crazyflow.DronePhysics())
    bodies.begin(0)
    down = np.array([[0, 0.5, 0], [0.8, 0, 1]]) + np.zeros((100, 2, 3))
    touched = bodies.follow(down, 0 * down, 0 * down)
    assert touched.tolist() == bodies.record.fallen.tolist() == [True, False]


@needs_crazyflow
def test_the_air_that_ellipsoids_keep_free_is_no_body() -> None:
    team = Team(("holonomic3d",) * 2, footprint=Ellipsoid(0.07, 0.07, 0.25))
    problem = swap(team=team, start=[[0, 0.5, 1, 0, 0, 0], [0.3, 0.5, 1, 0, 0, 0]], goal=[[0, 0, 1], [0.8, 0, 1]])
    env = crazyflow.parallel_env(problem=problem)
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, np.zeros(3, np.float32)))
    assert env.metrics()["collided"] == 0
    assert env.flight.least_gap == pytest.approx([0.16] * 2, abs=0.02)


@needs_crazyflow
def test_drones_are_where_they_are_put() -> None:
    env = crazyflow.parallel_env(problem=swap())
    env.reset(seed=0)
    states = swap().start.copy()
    states[0, :3] = [0.2, 0.9, 1.5]
    env.set_state(states)
    env.step(dict.fromkeys(env.agents, np.zeros(3, np.float32)))
    np.testing.assert_allclose(env._simulation.states[0], states[0], atol=0.06)


@needs_crazyflow
@pytest.mark.parametrize(
    ("problem", "complaint"),
    [
        (lambda: make_problem("circle", 2), "robot_0 is a holonomic2d, which is no drone in crazyflow"),
        (lambda: make_problem("sphere", 2, model="holonomic3d"), "the floor is at 0; give the scenario a height"),
        (lambda: swap(dt=0.125), "dt is 0.125 s; in crazyflow it must be a multiple of 0.01 s"),
    ],
)
def test_what_does_not_fly_is_named(problem: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        open_env(problem(), "crazyflow")


@needs_crazyflow
def test_drones_with_a_low_battery_hang_lower() -> None:
    heights = []
    for physics in ("crazyflow", "crazyflow:thrust_factor=0.9", "crazyflow:mass_factor=1.05,thrust_factor=0.9"):
        env = open_env(swap(), physics)
        env.reset(seed=0)
        env.step(dict.fromkeys(env.agents, np.zeros(3, np.float32)))
        heights.append(env.unwrapped.true_state()[2])
    assert 1 > heights[0] > heights[1] > heights[2] > 0.85


@needs_crazyflow
def test_scipy_without_its_array_api_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("d4orm_env.crazyflow")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delenv("SCIPY_ARRAY_API", raising=False)
    with pytest.raises(ImportError, match="in use without it already; set the environment variable SCIPY_ARRAY_API=1"):
        open_env(swap(), "crazyflow")


@needs_crazyflow
def test_bad_physics_is_named() -> None:
    for make, complaint in (
        (lambda: crazyflow.DronePhysics(drone="dji"), "drone is 'dji'; choose one of"),
        (lambda: crazyflow.DronePhysics(gust=-1), "gust"),
        (
            lambda: crazyflow.parallel_env(problem=swap(), physics="windy"),
            "physics is 'windy'; give d4orm_env.crazyflow",
        ),
    ):
        with pytest.raises(ValueError, match=complaint):
            make()
