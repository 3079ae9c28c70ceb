"""Manoeuvres of teams in tight places: robots that wait on their way for others, or go somewhere to let them by."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from env_support import slow

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.footprints import Box, Train
from d4orm_env.verify import verify
from d4orm_planners import make_planner
from d4orm_planners.manoeuvres import rounds as team_rounds
from d4orm_planners.manoeuvres import team as team_motions
from d4orm_planners.manoeuvres.detours import on_fixed_path
from d4orm_planners.manoeuvres.team import TeamMotions
from d4orm_planners.mapf.lns import search_neighbourhoods


def test_a_car_waits_for_another_one_to_leave_the_gap_that_it_parks_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes run out before those near to the gap, all with the same cost, have been followed to when it is free."""
    monkeypatch.setattr(team_motions, "FIRST_NODES", 20_000)
    world = World(boxes=[[1, -0.45, 2.02, 0], [2.98, -0.45, 4, 0]], lower=(1, -0.45), upper=(4, 1.5))
    street, gap, ahead = [1.4, 0.6, 0.0], [2.5, -0.225, 0.0], [3.6, 0.6]
    team = Team(("car_first_order",) * 2, footprint=Box(0.6, 0.3))
    problem = Problem(
        team, [street, gap], [gap[:2], ahead], world, goal_heading=0.0, margin=0.02, horizon=300, arrival="stay"
    )
    motions = TeamMotions.prepared(problem, lambda: False)
    assert motions is not None
    motions.plan_all()
    assert motions.missing == 0
    motion, alone = motions.motions[0], motions.alone[0]
    assert motion is not None
    assert alone is not None
    # It drives as it would alone, and stands in between.
    assert motion.steps > alone.steps
    moving = np.abs(motion.controls).sum(axis=1) > 0
    np.testing.assert_array_equal(motion.controls[moving], alone.controls)
    assert verify(problem, motions.controls()).ok


def test_a_motion_on_its_fixed_path_ends_where_it_does() -> None:
    """Its stops are all that is left of it: a car with a trailer swings from one to the next."""
    team = Team(
        ("car_with_1_trailer",), footprint=Train(Box(0.5, 0.25), [Box(0.3, 0.25)]), own_limits={"wheelbase": 0.25}
    )
    problem = Problem(team, [[1.0, 2.5, 0.0, 0.2]], [[4.0, 3.0]], goal_heading=0.5, horizon=400, arrival="stay")
    motions = TeamMotions.prepared(problem, lambda: False)
    assert motions is not None
    (alone,), (robot,) = motions.alone, motions.robots
    assert alone is not None
    fixed = on_fixed_path(robot, alone)
    again = motions._search(0, motions._traffic((), {}), motions._nodes, 1000, 1000, fixed)
    assert again is not None
    np.testing.assert_allclose(again.poses, alone.poses, atol=1e-5)
    np.testing.assert_array_equal(again.controls, alone.controls)


@pytest.mark.parametrize("model", ["unicycle", slow("differential_drive"), "car_first_order"])
def test_one_of_two_that_change_places_beside_a_bay_goes_into_it(model: str) -> None:
    """The bay is on nobody's way: whoever is planned first drives straight to where the other one stands."""
    boxes = [[0.0, -0.6, 1.95, 0.0], [2.85, -0.6, 3.4, 0.0]]
    world = World(boxes=boxes, lower=(0.0, -0.6), upper=(3.4, 0.5))
    ends = np.array([[0.4, 0.25], [1.2, 0.25]])
    team = Team((model,) * 2, footprint=Box(0.5, 0.25))
    start = np.zeros((2, team.state_size))
    start[:, :2] = ends
    problem = Problem(team, start, ends[::-1], world, margin=0.02, goal_heading=0.0, horizon=600, arrival="stay")
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.verified
    assert (plan.iterations, plan.denoising_steps) == (1, 0)
    assert plan.trajectory.positions[..., 0].max() > 1.95


@pytest.mark.parametrize("model", ["unicycle", slow("car_first_order")])
def test_two_pass_each_other_in_a_corridor_soon(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both drive in its middle, where nobody passes: one has to keep to a side, which is on nobody's way either."""
    rounds: list[int] = []

    def search(motions: TeamMotions, random: np.random.Generator, count: int, should_stop: Callable[[], bool]) -> None:
        rounds.append(motions.missing)
        search_neighbourhoods(motions, random, count, should_stop)

    monkeypatch.setattr(team_rounds, "search_neighbourhoods", search)
    world = World(boxes=[[-0.5, -0.3, 8.5, 0.0], [-0.5, 0.7, 8.5, 1.0]], lower=(-0.5, -0.3), upper=(8.5, 1.0))
    start = np.array([[0.2, 0.35, 0.0], [7.8, 0.35, np.pi]])
    team = Team((model,) * 2, footprint=Box(0.5, 0.25))
    problem = Problem(
        team, start, start[::-1, :2], world, goal_heading=start[:, 2], margin=0.02, horizon=400, arrival="stay"
    )
    assert make_planner(engine="cpu").solve(problem, seed=0).verified
    assert 0 < len(rounds) < 100


@pytest.mark.parametrize(
    ("model", "share"), [("unicycle2", 0.75), ("unicycle", 0.9), slow("car", 0.6), ("car_with_1_trailer", 0.9)]
)
def test_robots_that_change_places_turn_as_they_drive(
    model: str, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The moves of a search turn, drive or stand: joined to a motion they take much longer than what is left of it."""
    front = Box(0.5, 0.25)
    team = Team((model,) * 3, footprint=Train(front, [Box(0.3, 0.25)]) if "trailer" in model else front)
    start = np.zeros((3, team.state_size))
    start[:, :3] = [[1.0, 1.0, 0.5], [4.0, 1.0, 2.5], [2.5, 3.0, 0.0]]
    goal = start[[1, 0, 2], :2]  # the last one is there
    problem = Problem(team, start, goal, goal_heading=start[:, 2], margin=0.02, horizon=400, arrival="stay")
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.verified
    assert (plan.iterations, plan.denoising_steps) == (1, 0)
    monkeypatch.setattr(TeamMotions, "shorten", lambda *arguments: None)
    joined = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.metrics["travel_time"] < share * joined.metrics["travel_time"]
