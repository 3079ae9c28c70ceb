"""Robots that have arrived and may be moved again, ``arrival="stay"``, beside those that dock for ever."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from d4orm_env import load_problem, make_problem, navigation_v0, rollout, save_problem, verify
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import arrival_steps, arrival_times, trajectory_metrics
from d4orm_planners import OpenLoop, make_planner, make_policy, run_episode
from d4orm_planners.tracking.steering import straight_drives

ENGINES = pytest.mark.parametrize("engine", ["cpu", "jax"])


def way_there_and_back(arrival: Any = "stay", horizon: int = 60) -> tuple[Problem, Any]:
    """A robot that drives through its goal at 1 m, on to 1.5 m, and back to it."""
    problem = Problem(Team(("velocity2d",)), [(0.0, 0.0)], [(1.0, 0.0)], horizon=horizon, arrival=arrival)
    controls = np.zeros((horizon, 1, 2), np.float32)
    controls[:15, 0, 0], controls[20:25, 0, 0] = 1.0, -1.0
    return problem, controls


@ENGINES
def test_who_stays_may_be_moved_on(engine: str) -> None:
    problem, controls = way_there_and_back()
    trajectory = rollout(problem, controls, engine=engine)
    x = trajectory.positions[:, 0, 0]
    np.testing.assert_allclose(x[[10, 15, 20, 25, 60]], [1.0, 1.5, 1.5, 1.0, 1.0], atol=1e-5)
    np.testing.assert_array_equal(np.flatnonzero(trajectory.arrived[:, 0]), [10, *range(25, 61)])
    np.testing.assert_array_equal(arrival_steps(trajectory.arrived), [25])
    np.testing.assert_array_equal(arrival_times(trajectory.arrived, problem.dt), [2.5])
    assert trajectory_metrics(problem, trajectory)["success"] == 1.0
    np.testing.assert_array_equal(trajectory.controls, controls)
    # Under the paper's rule the same controls end where they first arrive.
    arrived = rollout(problem.replace(arrival="dock"), controls, engine=engine)
    np.testing.assert_allclose(arrived.positions[10:, 0, 0], 1.0, atol=1e-5)
    np.testing.assert_array_equal(arrival_times(arrived.arrived, problem.dt), [1.0])


def test_verify_wants_everyone_at_the_goal_at_the_end() -> None:
    problem, controls = way_there_and_back()
    report = verify(problem, controls)
    assert report.ok
    np.testing.assert_allclose(report.arrival_times, [2.5])
    short, controls = way_there_and_back(horizon=20)
    report = verify(short, controls)
    assert not report.ok
    assert [violation.kind for violation in report.violations] == ["not arrived"]
    assert verify(short.replace(arrival="dock"), controls).ok
    # On the very goal radius, rounding decides: that is not good enough.
    edge = problem.replace(goal_radius=0.5, start=[(0.5 - 4e-6, 0.0)])
    assert not verify(edge, 0 * controls[:1].repeat(60, axis=0)).ok


def test_verify_sees_contact_after_arrival() -> None:
    problem = Problem(Team(("velocity2d",) * 2), [(0, 0), (3, 0.0)], [(1, 0), (2, 0)], horizon=40, arrival="stay")
    controls = np.zeros((40, 2, 2), np.float32)
    controls[:19, 0, 0], controls[19:28, 0, 0] = 1.0, -1.0
    controls[:10, 1, 0] = -1.0
    report, trajectory = verify(problem, controls), rollout(problem, controls)
    assert trajectory.arrived[-1].all()
    assert {violation.kind for violation in report.violations} == {"robot contact"}
    assert trajectory.collided.any()
    assert verify(problem.replace(arrival="dock"), controls).ok


def test_environments_end_when_everyone_is_there() -> None:
    problem, controls = way_there_and_back()
    far = problem.replace(team=Team(("velocity2d",) * 2), start=[(0, 0), (0, 3.0)], goal=[(1, 0), (2, 3.0)])
    both = np.repeat(controls, 2, axis=1)
    both[:, 1] = 0
    both[:20, 1, 0] = 1.0
    env = navigation_v0.parallel_env(problem=far)
    joint = gymnasium.make("d4orm/Navigation-v0", problem=far)
    batch = gymnasium.make_vec("d4orm/Navigation-v0", num_envs=3, vectorization_mode="vector_entry_point", problem=far)
    for single in (env, joint, batch):
        single.reset(seed=0)
    for step in range(25):
        _, _, terminations, truncations, infos = env.step(dict(zip(env.agents, both[step], strict=True)))
        _, _, ended, _, found = joint.step(both[step].ravel())
        _, _, many, _, flags = batch.step(np.repeat(both[step].ravel()[None], 3, axis=0))
        here = [infos[agent]["arrived"] for agent in infos]
        assert here == [found["agents"][agent]["arrived"] for agent in found["agents"]] == flags["arrived"][1].tolist()
        assert here[0] == (step in (9, 24))
        assert not any(truncations.values())
        assert set(terminations.values()) == {ended} == set(many.tolist()) == {step == 24}
    assert env.agents == []
    np.testing.assert_allclose(found["metrics"]["makespan"], 2.5)
    np.testing.assert_allclose(found["metrics"]["travel_time"], (2.5 + 2.0) / 2)
    assert found["metrics"]["success"] == 1.0
    assert {name: flags["metrics"][name][1] for name in found["metrics"]} == pytest.approx(found["metrics"])


def test_conformance() -> None:
    parallel_api_test(navigation_v0.parallel_env("circle", num_robots=3, arrival="stay"), num_cycles=150)


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
def test_straight_drives_are_what_the_engine_rolls_out(model: str) -> None:
    problem = make_problem("circle", num_robots=3, model=model, arrival="stay", horizon=150)
    drives = straight_drives(problem)
    trajectory = rollout(problem, drives.controls[:, :, 0])
    np.testing.assert_allclose(trajectory.positions, drives.positions[:, :, 0], atol=2e-4)
    np.testing.assert_array_equal(trajectory.arrived[-1], drives.arrived[:, 0])
    assert trajectory.arrived[-1].all()


@pytest.mark.parametrize("name", ["d4orm", "d4orm-d", "d-d4orm", "mppi", "cem"])
def test_planners_solve_it(name: str) -> None:
    problem = make_problem("circle", num_robots=4, arrival="stay", horizon=120)
    plan = make_planner(name, engine="cpu").solve(problem, seed=0, max_iterations=30)
    assert plan.solved, plan.status
    assert verify(problem, plan.controls).ok
    env = navigation_v0.parallel_env(problem=problem)
    assert run_episode(env, OpenLoop(plan=plan)).metrics["success"] == 1.0


@pytest.mark.parametrize("name", ["d4orm-c2f", "go-to-goal"])
def test_policies_arrive(name: str) -> None:
    env = navigation_v0.parallel_env(
        "circle",
        num_robots=2 if name == "go-to-goal" else 4,
        arrival="stay",
        diameter=6.0,
        horizon=150,
        num_obstacles=0,
    )
    episode = run_episode(env, make_policy(name), seed=0)
    assert episode.metrics["arrived"] == env.unwrapped.problem.num_robots


def test_files_and_equality(tmp_path: Path) -> None:
    problem, _ = way_there_and_back()
    save_problem(problem, tmp_path / "stay.yaml")
    again = load_problem(tmp_path / "stay.yaml")
    assert again == problem
    assert again.arrival == "stay"
    assert problem != problem.replace(arrival="dock")
    assert make_problem("circle", num_robots=2, arrival="stay").arrival == "stay"


@pytest.mark.parametrize("value", ["park", "", 1])
def test_another_arrival_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match=r"arrival is .*; choose one of dock, stay"):
        make_problem("circle", arrival=value)
