"""Plans become shorter and never worse: groups of robots find faster paths around all others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engine_support import MODEL_NAMES

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.engine.threads import Threads
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import make_planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine import path_index
from d4orm_planners.mapf import beam_search
from d4orm_planners.mapf.beam import BeamRules, OtherAgents
from d4orm_planners.mapf.beam_search import find_paths
from d4orm_planners.mapf.lns import improve_paths
from d4orm_planners.mapf.motion_primitives import MotionPrimitives
from d4orm_planners.tracking.steering import straight_drives

STRAIGHT, STRICT = MotionPrimitives((45.0, 90.0), (1.0, 0.5, 0.0)), BeamRules(32, 1e6, 0.1)


def solved_team(problem: Problem, seed: int = 0) -> WorkingPlan:
    """A first solution, as it was found."""
    search = SolveRun(make_planner("hybrid", engine="cpu", improver="denoising"), problem, seed)
    while not search.best.solved:
        search.advance()
    return WorkingPlan(search, search.best.trajectory)


def travel_time(team: WorkingPlan) -> float:
    arrived = team.search.engine.rollout(team.problem, team.controls).arrived
    assert arrived[-1].all()
    return float((~arrived).sum(axis=0).mean() * team.problem.dt)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_paths_become_shorter_and_stay_free(model: str) -> None:
    team = solved_team(make_problem("random", num_robots=10, model=model, seed=1))
    before = travel_time(team)
    improve_paths(team, seed=0, rounds=6, temperature=0.0)
    assert travel_time(team) <= before
    assert verify(team.problem, team.controls).ok


def test_paths_among_obstacles_become_shorter() -> None:
    team = solved_team(make_problem("four_obstacles", num_robots=12))
    before = travel_time(team)
    improve_paths(team, seed=0, rounds=6, temperature=0.0)
    assert travel_time(team) < before - 0.1
    assert verify(team.problem, team.controls).ok


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, found = make_problem("heterogeneous", num_robots=6), []
    for threads in (1, 3):
        for module in (path_index, beam_search):
            monkeypatch.setattr(module, "Threads", lambda _, threads=threads: Threads(threads))
        team = solved_team(problem)
        found.append(improve_paths(team, seed=0, rounds=4))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("planner", ["d4orm", "hybrid"])
def test_a_plan_is_never_worse_than_what_it_began_with(planner: str) -> None:
    problem = make_problem("circle", num_robots=8, goal_speed=np.inf)
    first = make_planner(planner, engine="cpu").solve(problem, seed=0)
    better = make_planner(planner, engine="cpu", improve=True).solve(
        problem, seed=0, max_iterations=first.iterations + 1
    )
    assert first.solved
    assert verify(problem, better.controls).ok
    assert better.metrics["reward"] >= first.metrics["reward"]
    assert better.metrics["travel_time"] <= first.metrics["travel_time"]


def crossing() -> WorkingPlan:
    """Robot 0 drives to the right, and robot 1 stands in its way."""
    start = [[0, 0, 0, 0], [1.5, 0, 0, 0]]
    problem = Problem(Team(("holonomic2d",) * 2), start, [[3, 0], [1.5, 2.0]], horizon=80)
    search = SolveRun(make_planner("hybrid", engine="cpu"), problem, 0)
    return WorkingPlan(search, search.current.trajectory)


def arrival(found: Any) -> int:
    """Steps that the only robot's only path takes, or -1 for none."""
    moves = (np.diff(found.positions[:, 0, 0], axis=0) != 0).any(axis=1)
    return int(np.flatnonzero(moves).max()) + 1 if found.arrived[0, 0] else -1


def test_a_robot_minds_whom_it_is_told_to() -> None:
    team, me = crossing(), np.array([0])
    straight = straight_drives(team.problem.select([0]))
    nobody = np.zeros((1, 0, 81, 2), np.float32)
    nobody_else = OtherAgents(np.array([[0, 1]]), nobody, np.zeros((1, 0)))
    alone = find_paths(team, me, 0, STRAIGHT, STRICT, others=nobody_else)
    around = find_paths(team, me, 0, STRAIGHT, STRICT)
    assert arrival(alone) == arrival(straight)
    assert arrival(around) > arrival(alone)
    # Somebody who is not in the team stands where robot 1 does.
    there = np.broadcast_to(np.float32([1.5, 0]), (1, 1, 81, 2)).copy()
    others = OtherAgents(np.array([[0, 1]]), there, np.array([[0.15]]))
    np.testing.assert_array_equal(find_paths(team, me, 0, STRAIGHT, STRICT, others=others).states, around.states)


def test_a_path_that_costs_too_much_is_not_found() -> None:
    team, me = crossing(), np.array([0])
    time = arrival(find_paths(team, me, 0, STRAIGHT, STRICT)) * team.problem.dt
    assert find_paths(team, me, 0, STRAIGHT, STRICT, time + 0.1).arrived.all()
    found = find_paths(team, me, 0, STRAIGHT, STRICT, time - 0.15)
    assert not found.arrived.any()
    np.testing.assert_array_equal(found.states[:, :, 0], team.states[:, me])
