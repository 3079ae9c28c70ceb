"""Robots that fail find paths around all others: waiting, turning off, in space and among obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engine_support import MODEL_NAMES

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine import cpu
from d4orm_env.engine.threads import Threads
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import make_planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine import path_index
from d4orm_planners.hybrid.planner import reroute
from d4orm_planners.mapf import beam_search
from d4orm_planners.tracking.steering import straight_drives


def rerouted(problem: Problem, seed: int = 0) -> WorkingPlan:
    """A team that sets off straight, after one call."""
    planner: Any = make_planner("hybrid", engine="cpu")
    search = SolveRun(planner, problem, seed, straight_drives(problem).controls[:, :, 0])
    team = WorkingPlan(search, search.current.trajectory)
    reroute(team)
    return team


def assert_executed(team: WorkingPlan) -> None:
    """What the team says of itself is what the engine makes of its controls."""
    rollout = cpu.CpuEngine().rollout(team.problem, team.controls)
    np.testing.assert_allclose(rollout.states, team.states, atol=1e-4)
    np.testing.assert_array_equal(rollout.arrived[-1], team.arrived)
    faults, _ = team.faults(np.arange(team.problem.num_robots))
    failing = rollout.margin_violated[1:].any(axis=0) | ~rollout.arrived[-1]
    assert not failing[faults == 0].any()


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_a_crossing_is_resolved(model: str) -> None:
    problem = make_problem("random", num_robots=10, model=model, seed=1)
    assert WorkingPlan.faults(rerouted(problem), np.arange(10))[0].tolist() == [0] * 10
    assert_executed(rerouted(problem))


def test_a_mixed_team_is_rerouted_model_by_model() -> None:
    team = rerouted(make_problem("heterogeneous", num_robots=6))
    assert_executed(team)
    assert team.arrived.all()


def test_a_path_costs_what_it_costs_whichever_paths_it_is_compared_with() -> None:
    """What a robot does at present, the same again, standing still, another robot's path, and that again."""
    team = rerouted(make_problem("random", num_robots=10, seed=1))
    own, other = (team.positions[:, robot] for robot in (3, 4))
    still, arrived = np.repeat(own[:1], len(own), axis=0), np.array([1, 1, 0, 1, 1], bool)
    paths, different = np.stack([own, own, still, other, other]), np.array([0, 0, 1, 1, 1], bool)
    alone = [team._costs([3], path[None, None], arrived[None, [i]])[0][0, 0] for i, path in enumerate(paths)]
    own_faults, share, _ = team._alone([3], paths[None], arrived[None])
    assert (team._path_faults(3, paths, different, own_faults[0]) + share[0]).tolist() == alone
    assert len(set(alone)) == 3
    assert team._path_faults(3, paths[:2], different[:2], own_faults[0, :2]).tolist() == [0, 0]


def test_who_cannot_pass_waits() -> None:
    """In a lane too narrow to pass in, one robot docks on the way of another, and so must come after it."""
    start = [[0, 0, 0, 0], [2.0, -2.0, 0, 0]]
    walls = [[-1, 0.3, 4, 0.6], [-1, -0.6, 1.5, -0.3], [2.5, -0.6, 4, -0.3]]
    world = World(boxes=walls)
    problem = Problem(Team(("holonomic2d",) * 2), start, [[3.5, 0], [2.0, 0.0]], world, horizon=200)
    team = rerouted(problem)
    assert_executed(team)
    assert team.faults([0, 1])[0].tolist() == [0, 0]


@pytest.mark.parametrize("seed", [4, 8])
def test_those_that_have_docked_for_long_dock_otherwise(seed: int) -> None:
    """From where they rest they go nowhere any more, and there they leave the last one no room at its goal."""
    start = [[0, -2, 0, 0], [0, 2.72, 0, 0], [24, 0.36, 0, 0]]
    problem = Problem(Team(("holonomic2d",) * 3), start, [[0, 0], [0, 0.72], [0, 0.36]], horizon=384)
    straight = straight_drives(problem).positions[:, :, 0]
    assert (straight[60:, :2] == straight[60, :2]).all()
    assert np.linalg.norm(straight[60, 1] - straight[60, 0]) < 0.65, "the last one needs 0.7 m"
    team = rerouted(problem, seed)
    assert_executed(team)
    assert team.faults([0, 1, 2])[0].tolist() == [0, 0, 0]


def test_two_that_face_each_other_make_way_together() -> None:
    """Robots 0 and 1 start 4 mm apart: nothing that one of them does helps while the other comes on at once."""
    problem = make_problem("random", num_robots=16, model="differential_drive", seed=4)
    plan = make_planner("hybrid", engine="cpu").solve(problem, seed=4, max_iterations=10)
    assert plan.solved


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem("random", num_robots=40, size=7.0, seed=0)
    teams = []
    for threads in (1, 3):
        for module in (path_index, beam_search):
            monkeypatch.setattr(module, "Threads", lambda _, threads=threads: Threads(threads))
        teams.append(rerouted(problem))
    np.testing.assert_array_equal(teams[0].controls, teams[1].controls)
    np.testing.assert_array_equal(teams[0].states, teams[1].states)


@pytest.mark.parametrize("num_robots", [100, pytest.param(500, marks=pytest.mark.slow)])
def test_a_big_team_is_solved_without_sampling(num_robots: int) -> None:
    problem = make_problem("random", num_robots=num_robots, seed=0)
    plan = make_planner("hybrid").solve(problem, seed=0, max_iterations=4)
    assert plan.solved
    assert verify(problem, plan.controls).ok
    assert plan.denoising_steps <= 100


@pytest.mark.slow
def test_eight_pass_a_window_in_space() -> None:
    """A wall of four boxes leaves a window of half a metre, wide enough for two at a time."""
    positions = np.array([[-1.5, y, z] for y in (-0.75, -0.25, 0.25, 0.75) for z in (-0.4, 0.4)])
    wall = [(-3.0, -3.0, -0.25, 3.0), (0.25, -3.0, 3.0, 3.0), (-0.25, -3.0, 0.25, -0.25), (-0.25, 0.25, 0.25, 3.0)]
    boxes = [[-0.1, left, low, 0.1, right, high] for left, low, right, high in wall]
    world = World(3, boxes=boxes, lower=(-3.0,) * 3, upper=(3.0,) * 3)
    start, goal = np.pad(positions, ((0, 0), (0, 3))), positions[::-1] * (-1, 1, 1)
    problem = Problem(Team(("holonomic3d",) * 8, radius=0.08), start, goal, world, horizon=250, margin=0.03)
    plan = make_planner("hybrid", engine="cpu").solve(problem, seed=0)
    assert plan.solved
    assert plan.verified
