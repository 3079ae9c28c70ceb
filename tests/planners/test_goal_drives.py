"""Cars drive to goal headings by curves, whatever policy steers them."""

from __future__ import annotations

import numpy as np
import pytest

from d4orm_env import Problem, Team, World, navigation_v0
from d4orm_env.core.bodies import body_poses
from d4orm_env.core.gaps import world_gap
from d4orm_env.engine.choice import get_engine
from d4orm_env.footprints import Box, Train
from d4orm_planners import run_episode
from d4orm_planners.d4orm_c2f.direct_final_approach import direct_final_approach
from d4orm_planners.tracking.free_curves import free_curves
from d4orm_planners.tracking.goal_drives import CUSP, STRAIGHT, curves, drive_to_goal, first_stretches
from d4orm_planners.tracking.steering import advanced, preferred_velocities, track_velocities

CARS = ("car", "car_first_order", "car_with_1_trailer", "car_with_3_trailers")
FOOTPRINTS = {
    "car_first_order": Box(0.36, 0.24, 0.1),
    "car_with_1_trailer": Train(Box(0.36, 0.24, 0.1), [Box(0.3, 0.2)]),
    "car_with_2_trailers": Train(Box(0.36, 0.24, 0.1), [Box(0.3, 0.2), Box(0.2, 0.2)]),
}
TURNS = {"ahead": 0.0, "opposite": np.pi, "sideways": np.pi / 2}


def poses(count: int, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return random.uniform(-reach, reach, count), random.uniform(-reach, reach, count), random.uniform(-4, 4, count)


def off(ends: np.ndarray, x: np.ndarray, y: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """How far poses ``(..., 3)`` are from others, radians as metres."""
    turned = (ends[..., 2] - turns + np.pi) % (2 * np.pi) - np.pi
    return np.abs(ends[..., 0] - x) + np.abs(ends[..., 1] - y) + np.abs(turned)


def driven(ends: np.ndarray, side: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Poses ``(..., 3)`` in turning radii after stretches."""
    x, y, before = np.moveaxis(ends, -1, 0)
    bent, after = side != STRAIGHT, before + side * length
    radius = np.where(bent, side, 1)
    x = x + np.where(bent, radius * (np.sin(after) - np.sin(before)), length * np.cos(before))
    y = y - np.where(bent, radius * (np.cos(after) - np.cos(before)), -length * np.sin(before))
    return np.stack([x, y, after], axis=-1)


@pytest.mark.parametrize("reach", [0.1, 1.0, 4.0, 30.0])
def test_curves_lead_to_the_goal(reach: float) -> None:
    x, y, turns = poses(500, reach)
    sides, lengths = curves(x, y, turns, np.zeros(500))
    exists = np.isfinite(lengths).all(axis=-1)
    assert exists.any(axis=0).all()
    assert (lengths[exists] >= 0)[sides[exists] == STRAIGHT].all()  # straights are driven forwards
    ends = np.zeros((*exists.shape, 3))
    for side, length in zip(np.moveaxis(sides, -1, 0), np.moveaxis(np.where(exists[..., None], lengths, 0), -1, 0)):
        ends = driven(ends, side, length)
    assert off(ends, x, y, turns)[exists].max() < 1e-6 * max(reach, 1)


def test_no_curve_is_longer_than_it_needs_be() -> None:
    # A turn on the spot, nearly: forwards, back and forwards again, each by a third of it.
    side, length, _ = first_stretches(np.zeros(1), np.zeros(1), np.array([0.3]), np.full(1, 1e-3), np.full(1, np.nan))
    _, lengths = curves(np.zeros(1), np.zeros(1), np.array([0.3]), np.full(1, 1e-3))
    assert np.abs(lengths).sum(axis=-1).min() == pytest.approx(0.3, rel=1e-3)
    assert abs(length[0]) < 0.3
    assert side[0] != STRAIGHT
    assert CUSP > 0


@pytest.mark.parametrize("model", CARS)
@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_cars_arrive_with_their_headings(model: str, turn: float) -> None:
    random, size = np.random.default_rng(1), 12
    team = Team((model,) * size)
    apart, start = 30.0 * np.arange(size), np.zeros((size, team.robot_models[0].state_size))
    bearing = random.uniform(-np.pi, np.pi, size)
    goal = np.stack([np.cos(bearing), np.sin(bearing)], axis=1) * random.uniform(0, 3, (size, 1))
    start[:, 0], start[:, 2] = apart, random.uniform(-np.pi, np.pi, size)
    goal[:, 0] += apart
    heading = (bearing + turn + np.pi) % (2 * np.pi) - np.pi
    problem = Problem(team, start, goal, goal_heading=heading, horizon=400)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), "go-to-goal")
    assert episode.trajectory.arrived[-1].all()


@pytest.mark.parametrize(("policy", "model"), [("go-to-goal", "car_with_2_trailers"), ("orca", "car_with_1_trailer")])
def test_trailers_are_pulled_into_line_before_goals(model: str, policy: str) -> None:
    random, size, count = np.random.default_rng(3), 3, len(FOOTPRINTS[model].trailers)
    team, apart = Team((model,) * size, footprint=FOOTPRINTS[model]), 30.0 * np.arange(size)
    start, goal = np.zeros((size, 3 + count)), random.uniform(-3, 3, (size, 2))
    start[:, 0], start[:, 2], start[:, 3:] = apart, random.uniform(-3, 3, size), 0.5
    goal[0], goal[:, 0] = 0, goal[:, 0] + apart
    headings = np.append(start[0, 2], random.uniform(-3, 3, size - 1))
    options = {"goal_heading": headings, "goal_hitches": np.zeros((size, count)), "horizon": 200}
    problem = Problem(team, start, goal, **options)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), policy)
    assert episode.trajectory.arrived[-1].all()
    assert not episode.trajectory.collided.any()


def test_curves_to_goal_hitch_angles_keep_clear_or_else_come_as_near_as_they_can() -> None:
    """Of two ways to the goal the shorter does not straighten the trailer; where only that is free, it is taken."""
    team = Team(("car_with_1_trailer",), footprint=FOOTPRINTS["car_with_1_trailer"])
    pose, radius = np.array([0, 0, 0, 0.5]), float(team.turning_radius[0])
    problem = Problem(team, [pose], [[0.3, 0]], goal_heading=0.0, goal_hitches=[[0.0]])
    ways = np.array([[[0.3 / radius]], [[2.0 / radius]], [[np.inf]]])
    taken = free_curves(problem, np.zeros(1, np.int64), pose[None], np.zeros((3, 1, 1)), ways)
    assert taken == 1
    walled = problem.replace(world=World(2, boxes=[[0.8, -1, 1, 1]]))
    assert free_curves(walled, np.zeros(1, np.int64), pose[None], np.zeros((3, 1, 1)), ways) == 0


def gap_along(problem: Problem, pose: np.ndarray, sides: np.ndarray, lengths: np.ndarray) -> float:
    """Least gap of a car and its trailers to the world on a curve, as its model drives in fine steps."""
    radius, least, steps = float(problem.team.turning_radius[0]), np.inf, 60
    fine, states = problem.replace(dt=1 / steps), pose[None].astype(np.float32)
    for side, length in zip(sides, lengths):
        controls = np.float32([[length * radius, side * problem.team.own_limits["max_steering"][0]]])
        for _ in range(steps if length else 0):
            states = advanced(fine, states, controls)
            bodies = zip(problem.team.bodies, body_poses(problem.team.bodies, states, 2))
            least = min(least, *(world_gap(problem.world, body.footprint, end) for body, end in bodies))
    return least


@pytest.mark.parametrize("model", ["car_first_order", "car_with_2_trailers"])
def test_the_shortest_free_curve_is_taken(model: str) -> None:
    world = World(2, boxes=[[-3, -2, 3, -0.3]], lower=[-3, -3], upper=[3, 3])
    team, chosen = Team((model,), footprint=FOOTPRINTS[model]), []
    hitches = [-0.3, 0.5][: len(team.robot_models[0].trailers)]
    radius, none = float(team.turning_radius[0]), np.zeros(1)
    for x, y, heading in zip(*poses(10, 1.5)):
        pose = np.array([x, abs(y), heading, *hitches])
        problem = Problem(team, [[0, 0, 0, *hitches]], [[0, 0]], goal_heading=0.0, world=world)
        away, turned = (
            -pose[:2] / radius,
            np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]]),
        )
        sides, lengths = curves(*(turned @ away)[:, None], -np.array([heading]), none)
        order = np.abs(lengths).sum(axis=2)[:, 0].argsort(kind="stable")
        sides, lengths = sides[order], lengths[order]
        found = free_curves(problem, np.zeros(1, np.int64), pose[None], sides, lengths)[0]
        looked_at = sorted({0, max(found - 1, 0), max(found, 0)})
        gaps = [gap_along(problem, pose, sides[w, 0], lengths[w, 0]) for w in looked_at]
        chosen.append(found)
        if found >= 0:
            assert gaps[-1] > 0
            assert max(gaps[:-1], default=-1) < problem.margin + 1e-3
    assert max(chosen) > 0


def test_a_car_that_has_driven_past_the_end_of_an_arc_goes_on() -> None:
    """It does not turn back for another curve, again and again."""
    start = [-0.9536, 1.1582, 1.9743, 0, 0]
    problem = Problem(Team(("car",)), [start], [[0, 0]], goal_heading=np.pi / 2, horizon=300)
    assert run_episode(navigation_v0.parallel_env(problem=problem), "go-to-goal").trajectory.arrived[-1].all()


@pytest.mark.parametrize("policy", ["go-to-goal", "orca"])
def test_cars_beside_a_wall_take_another_curve(policy: str) -> None:
    """By the shortest one this car would run into the wall; `orca` would stop before."""
    start, wall = [1.7722, 1.4136, 2.9923], World(2, boxes=[[-4, -2, 4, -0.25]])
    problem = Problem(Team(("car_first_order",)), [start], [[0, 0]], goal_heading=0.0, world=wall, horizon=200)
    assert run_episode(navigation_v0.parallel_env(problem=problem), policy, seed=4).metrics["success"]


def test_orca_alone_does_too() -> None:
    problem = Problem(Team(("car_first_order",)), [[0, 0, 0]], [[2, 0]], goal_heading=np.pi, horizon=200)
    for seed in range(3):
        assert run_episode(navigation_v0.parallel_env(problem=problem), "orca", seed).trajectory.arrived[-1].all()


def test_others_drive_straight() -> None:
    team = Team(("car", "differential_drive", "car_first_order"))
    start = [[0, 0, 1, 0.3, 0.1], [3, 0, 1, 0.2, 0], [6, 0, 2, 0, 0]]
    goals, headings = np.float32([[1, 1], [4, 1], [7, 1]]), [np.nan, 1.0, np.nan]
    problem = Problem(team, start, goals, goal_heading=headings)
    straight = track_velocities(problem, problem.start, preferred_velocities(problem, problem.start, goals))
    np.testing.assert_array_equal(drive_to_goal(problem, problem.start, goals), straight)
    curving = problem.replace(goal_heading=[3.0, 1.0, np.nan])
    np.testing.assert_array_equal(drive_to_goal(curving, problem.start, goals)[1:], straight[1:])
    assert (drive_to_goal(curving, problem.start, goals)[0] != straight[0]).any()


@pytest.mark.parametrize(
    ("model", "start", "hitches"),
    [("car", [0, 0, 0.3, 0, 0], None), ("car_with_1_trailer", [0, 0, 0, 0.5], [[0.0]])],
)
def test_the_final_approach_mends_a_heading(model: str, start: list[float], hitches: list[list[float]] | None) -> None:
    # At its goal, but 0.3 rad off, or its trailer is: further than samples look it has to drive away and come back.
    problem = Problem(Team((model,)), [start], [[0, 0]], goal_heading=0.0, goal_hitches=hitches, horizon=20)
    engine, everyone, states = get_engine("cpu"), np.ones(1, bool), problem.start
    for _ in range(200):
        window = problem.with_state(states, problem.goal)
        nothing = np.zeros((20, 1, 2), np.float32)
        controls, _ = direct_final_approach(window, engine, nothing, everyone, ~everyone)
        states, _, arrived, *_ = engine.step(problem.arrays, states, ~everyone, controls[0])
        if arrived.all():
            return
    pytest.fail(f"it is still at {states.tolist()}")
