"""IPOPT's plans are what the engines execute, for every model and obstacle, and it ends in time when there are none."""

from __future__ import annotations

import os
import signal
import sys
import threading
from typing import Any

import numpy as np
import pytest
from planner_support import assert_solves, hop_problem, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios import make_problem
from d4orm_planners import Plan, make_planner
from d4orm_planners.baselines.collocation import CollocatedMotion, TeamProgram
from d4orm_planners.baselines.ipopt import solve_program
from d4orm_planners.engine.sampling_types import get_sampling_engine

MODELS = ("holonomic2d", "holonomic3d", "velocity2d", "differential_drive", "unicycle", "car")

PLANAR_WORLDS = {
    "circle": {"circles": [[0, 0.05, 0.3]]},
    "box": {"boxes": [[-0.3, -0.25, 0.3, 0.35]]},
    "bounds": {"lower": [-1.5, -0.6], "upper": [1.5, 0.6]},
}
SPATIAL_WORLDS = {
    "sphere": {"spheres": [[0, 0.05, 0.02, 0.3]]},
    "cylinder": {"cylinders": [[0, 0.05, 0.3]]},
    "box": {"boxes": [[-0.3, -0.25, -0.2, 0.3, 0.35, 0.3]]},
    "bounds": {"lower": [-1.5, -0.6, -0.6], "upper": [1.5, 0.6, 0.6]},
}


def swap_problem(models: tuple[str, str] = ("holonomic2d", "holonomic2d"), **changes: Any) -> Problem:
    """Two robots 2 m apart that change places, wheels turned towards the goal."""
    team = Team(models)
    start = np.zeros((2, team.state_size))
    start[:, 0] = [-1, 1]
    heading = team.robot_models[1].heading_index
    if heading is not None:
        start[1, heading] = np.pi
    return Problem(team, start, -start[:, : team.dimension], **({"horizon": 45} | changes))


@pytest.mark.parametrize("preset", [None, "paper"])
@pytest.mark.parametrize("model", MODELS)
def test_two_robots_change_places(model: str, preset: str | None) -> None:
    assert_solves("ipopt", swap_problem((model, model)), preset=preset)


def test_models_mix() -> None:
    assert_solves("ipopt", swap_problem(("differential_drive", "holonomic2d")))
    assert_solves("ipopt", swap_problem(("velocity2d", "differential_drive")))


@pytest.mark.parametrize("kind", PLANAR_WORLDS)
def test_obstacles_of_the_plane(kind: str) -> None:
    assert_solves("ipopt", swap_problem(world=World(2, **PLANAR_WORLDS[kind]), horizon=60))


@pytest.mark.parametrize("kind", SPATIAL_WORLDS)
def test_obstacles_of_space(kind: str) -> None:
    world = World(3, **SPATIAL_WORLDS[kind])
    assert_solves("ipopt", swap_problem(("holonomic3d", "holonomic3d"), world=world, horizon=60))


@pytest.mark.slow
@pytest.mark.parametrize("preset", [None, "paper"])
@pytest.mark.parametrize("seed", [0, 1])
def test_four_robots_cross_a_circle(seed: int, preset: str | None) -> None:
    assert_solves("ipopt", make_problem("circle", num_robots=4), seed=seed, preset=preset)


@pytest.mark.parametrize("model", ["differential_drive", "car_with_1_trailer"])
def test_goal_headings_are_met(model: str) -> None:
    problem = swap_problem(("holonomic2d", model), goal_heading=[np.nan, 2.0], horizon=80)
    if model == "car_with_1_trailer":
        problem = problem.replace(goal_hitches=[[np.nan], [0.3]])
    assert_solves("ipopt", problem)


def test_a_goal_speed_is_kept() -> None:
    plan = assert_solves("ipopt", swap_problem(goal_speed=0.1))
    before = plan.trajectory.arrived.argmax(axis=0) - 1
    # One step before it docks a robot at 1 m/s^2 is at most a tenth faster than when it does.
    assert (np.linalg.norm(plan.trajectory.states[before, [0, 1], 2:], axis=1) < 0.21).all()


def test_a_robot_that_starts_at_its_goal_stays_there() -> None:
    problem = swap_problem()
    start = np.concatenate([problem.start, [[0, 0.2, 0, 0]]])
    crowded = Problem(Team(("holonomic2d",) * 3), start, [[1, 0], [-1, 0], [0, 0.2]], horizon=60)
    plan = assert_solves("ipopt", crowded)
    assert plan.trajectory.arrived[1].tolist() == [False, False, True]


def test_robots_stand_where_they_dock() -> None:
    # The first docks on the way of the second, who passes as near as it may.
    start = [[-0.6, 0, 0, 0], [-1.5, 0.05, 0, 0]]
    problem = Problem(Team(("holonomic2d",) * 2), start, [[0, 0], [1.5, 0.05]], horizon=60)
    for seed in range(3):
        assert_solves("ipopt", problem, seed=seed, max_iterations=2)


@pytest.mark.parametrize("model", MODELS)
def test_the_motion_is_what_the_engine_rolls_out(model: str) -> None:
    problem = swap_problem((model, model))
    program = TeamProgram(problem, clearance=2e-3)
    still = CollocatedMotion(
        np.repeat(problem.start[None].astype(float), 46, axis=0), np.zeros((45, 2, problem.control_size))
    )
    motion, note = solve_program(program, still, {}, np.array([45, 45]), {"tol": 1e-3}, lambda: False)
    assert note == "Solve_Succeeded"
    rolled_out = get_sampling_engine("cpu").rollout(problem, motion.controls)
    moving = ~rolled_out.arrived
    np.testing.assert_allclose(motion.states[moving], rolled_out.states[moving], atol=1e-3)
    assert rolled_out.arrived[-1].all()


def test_contacts_are_those_that_come_near() -> None:
    problem = hop_problem(3, world=World(2, circles=[[0.25, -1.0, 0.1]]))
    program = TeamProgram(problem, clearance=0.0)
    motion = CollocatedMotion(np.repeat(problem.start[None].astype(float), 31, axis=0), np.zeros((30, 3, 2)))
    everything = program.contacts(motion, None)
    assert set(everything) == {(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)}
    assert all(steps.tolist() == list(range(1, 31)) for steps in everything.values())
    # Robots stand 1 m apart, 0.65 m beyond the distance to keep; the circle is 0.73 m beyond it from the first.
    assert set(program.contacts(motion, 0.6)) == set()
    assert set(program.contacts(motion, 0.7)) == {(0, 1), (1, 2)}
    assert set(program.contacts(motion, 0.75)) == {(0, 1), (1, 2), (0, 3)}


def test_without_a_margin_robots_do_not_touch_between_the_steps_either() -> None:
    assert_solves("ipopt", swap_problem(margin=0.0))


def test_the_same_seed_gives_the_same_plan() -> None:
    problem = swap_problem(goal_speed=np.inf)
    first, again = (assert_solves("ipopt", problem, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.controls, again.controls)
    other = assert_solves("ipopt", problem, seed=4)
    assert not np.allclose(first.controls, other.controls, atol=1e-3)


def test_an_infeasible_problem_ends_cleanly() -> None:
    plan = make_planner("ipopt", engine="cpu").solve(swap_problem(horizon=10), max_iterations=2)
    assert plan.status == "iteration_limit"
    assert not plan.solved
    assert all(record.note == "Infeasible_Problem_Detected" for record in plan.history)
    walled_in = make_planner("ipopt", engine="cpu", solver_iterations=100).solve(walled_in_problem(), max_iterations=1)
    assert not walled_in.solved
    assert walled_in.history[0].note


def test_ctrl_c_stops_ipopt(monkeypatch: pytest.MonkeyPatch) -> None:
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))

    def solve_and_be_interrupted(*arguments: Any) -> Any:
        if timer.ident is None:  # not started yet
            timer.start()
        return solve_program(*arguments)

    monkeypatch.setattr("d4orm_planners.baselines.ipopt.solve_program", solve_and_be_interrupted)
    problem = make_problem("circle", num_robots=16)
    plan = make_planner("ipopt", engine="cpu", perturbation=2.0).solve(problem, time_limit=60)
    timer.join()
    assert plan.status == "interrupted"


def test_initial_controls_replace_the_warm_start() -> None:
    problem = swap_problem()
    given = assert_solves("ipopt", problem)
    middle = given.trajectory.positions[20, :, 1]
    mirrored = 0.99 * given.controls * [1, -1]
    planner = make_planner("ipopt", engine="cpu", perturbation=1e-3)
    for controls, side in ((0.99 * given.controls, 1), (mirrored, -1)):
        plan = planner.solve(problem, initial_controls=controls)
        assert plan.solved
        assert (np.sign(plan.trajectory.positions[20, :, 1]) == side * np.sign(middle)).all()


def test_a_plan_with_notes_is_saved_and_loaded(tmp_path: Any) -> None:
    plan = assert_solves("ipopt", swap_problem())
    plan.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").history == plan.history
    assert plan.history[-1].note == "Solve_Succeeded"


def test_without_casadi_the_planner_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r"planner 'ipopt' needs casadi; .*pip install 'd4orm-env\[ipopt\]'"):
        make_planner("ipopt")


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("perturbation", -0.1, "perturbation is -0.1"),
        ("lookout", float("nan"), "lookout is nan"),
        ("rounds", 0, "rounds is 0.*at least 1"),
        ("clearance", -1, "clearance is -1"),
        ("tolerance", 0, "tolerance is 0"),
        ("barrier", 0, "barrier is 0"),
        ("solver_iterations", 1.5, "solver_iterations must be a whole number"),
        ("max_iterations", 0, "max_iterations is 0"),
        ("num_samples", 64, "'num_samples' is no setting of planner 'ipopt'"),
    ],
)
def test_a_bad_setting_is_refused_by_name(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_planner("ipopt", **{setting: value})


def test_the_paper_preset_solves_once_with_everything() -> None:
    config: Any = make_planner("ipopt", preset="paper").config
    assert (config.lookout, config.rounds) == (None, 1)
