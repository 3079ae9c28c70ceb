"""What D4orm-C2F finds out while things go wrong: lateness, noise, weakness, who stands; and its last resort."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from env_support import slow
from hypothesis import given, settings
from hypothesis import strategies as st
from planner_support import hop_problem
from scipy.optimize import nnls

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import Bias, Delay, Dropout, LimitMismatch, Push, Stall, StateDelay
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_env.footprints import Box, Train
from d4orm_env.scenarios import make_problem
from d4orm_planners import make_policy, run_episode
from d4orm_planners.d4orm_c2f.barrier import Barriers, find_nearest, safe_velocities
from d4orm_planners.d4orm_c2f.deviation import Deviation, StateFilter
from d4orm_planners.d4orm_c2f.direct_final_approach import direct_final_approach
from d4orm_planners.d4orm_c2f.estimators import (
    BRAKING_STEPS,
    IDLE_STEPS,
    MAX_LATENCY,
    ActuatorGainEstimator,
    LatencyEstimator,
    PacketLossEstimator,
    StallEstimator,
)
from d4orm_planners.d4orm_c2f.receding_horizon import D4ormC2F
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.tracking.steering import NEAR_VIA, drives, limit_controls, track_velocities

ALL = np.ones(3, bool)


def controller(**config: Any) -> D4ormC2F:
    policy = make_policy("d4orm-c2f", **{"engine": "cpu", "refine": "off", **config})
    assert isinstance(policy, D4ormC2F)
    return policy


def joint(problem: Any, states: Any, **parts: Any) -> JointState:
    nothing = np.zeros((problem.num_robots, problem.control_size), np.float32)
    given = {"controls": nothing, "arrived": np.zeros(problem.num_robots, bool), "steps": 0}
    return JointState(**{"states": np.asarray(states, np.float32), "goals": problem.goal, **given, **parts})


@given(late=st.integers(0, MAX_LATENCY), noise=st.floats(0, 0.3), seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_how_late_commands_are_is_found_out(late: int, noise: float, seed: int) -> None:
    random, latency = np.random.default_rng(seed), LatencyEstimator(Team(("holonomic2d",) * 3), None)
    sent = [np.zeros((3, 2), np.float32)] * (late + 1)
    for _ in range(60):
        executed = sent[-1 - late] + random.normal(0, noise, (3, 2)) * (len(sent) > late + 1)
        latency.observe(executed.astype(np.float32), ALL)
        sent.append(random.normal(size=(3, 2)).astype(np.float32))
        np.testing.assert_array_equal(latency.send(sent[-1]), sent[-1 - latency.steps])
    assert latency.steps == late
    assert len(latency.under_way) == late
    under_way = np.reshape(latency.under_way, (late, 3, 2))
    np.testing.assert_array_equal(under_way, np.reshape(sent[len(sent) - late :], (late, 3, 2)))


def test_a_lateness_that_is_known_stays() -> None:
    latency = LatencyEstimator(Team(("holonomic2d",) * 3), 2)
    for number in range(5):
        latency.observe(np.full((3, 2), number - 1, np.float32), ALL)
        latency.send(np.full((3, 2), number, np.float32))
    assert latency.steps == 2


def drifting(walk: float, noise: float, steps: int = 300) -> tuple[Any, Any, StateFilter]:
    """True places, estimated ones of one coordinate, and the filter, of robots that drift and are measured."""
    random, filter_ = np.random.default_rng(3), StateFilter(hop_problem(3))
    truth = np.cumsum(random.normal(0, walk, (steps, 3, 4)), axis=0)
    seen = (truth + random.normal(0, noise, truth.shape)).astype(np.float32)
    estimates = [seen[0]]
    for before, now in pairwise(seen):
        estimates.append(filter_.update(now, before, estimates[-1], ALL))
    return truth, np.array(estimates), filter_


@pytest.mark.parametrize(("walk", "noise"), [(0.001, 0.02), (0.01, 0.02), (0.02, 0.02)])
def test_noise_on_states_is_told_from_motion_and_filtered(walk: float, noise: float) -> None:
    truth, estimates, filter_ = drifting(walk, noise)
    # The gain of the steady state, from the variances themselves (Bar-Shalom et al., section 5.2.5).
    ahead = (walk**2 + np.sqrt(walk**4 + 4 * walk**2 * noise**2)) / 2
    expected = max(ahead / (ahead + noise**2), 0.1)
    np.testing.assert_allclose(filter_.gains().mean(), expected, atol=0.15)
    error = np.sqrt(((estimates - truth)[50:] ** 2).mean())
    assert error < 0.95 * noise


def test_states_that_are_known_are_taken_as_they_are() -> None:
    """But for some that chance has look like noisy ones, of which nearly all is believed."""
    truth, estimates, filter_ = drifting(0.02, 0.0)
    assert np.median(filter_.gains()) == 1
    assert filter_.gains().min() > 0.8
    assert np.abs(estimates - truth).max() < 0.02


@pytest.mark.parametrize("share", [1.0, 0.8, 0.5])
@pytest.mark.parametrize("capped", [True, False])
def test_robots_that_do_less_than_asked_are_believed_to_be_weaker(share: float, capped: bool) -> None:
    """By that share, and not once more by what they do less: at the limit as they go, and below it."""
    problem, random = hop_problem(3), np.random.default_rng(0)
    actuator_gain = ActuatorGainEstimator(problem)
    for step in range(60):
        angle, size = random.uniform(0, 2 * np.pi, 3), 1.0 if step < 30 else 0.6
        told = size * np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
        actuator_gain.observe(told, min(1, share / size) * told if capped else share * told, ALL)
    for name in ("max_speed", "max_acceleration", "max_turn_rate"):
        believed = getattr(actuator_gain.problem.team, name) / getattr(problem.team, name)
        np.testing.assert_allclose(believed, share, rtol=1e-5)


@pytest.mark.parametrize("lost", [0.0, 0.4])
def test_what_is_added_to_commands_is_kept_back(lost: float) -> None:
    """Of what bounds the commands, not of the speed, and as much when some of them get lost."""
    problem, random = hop_problem(3), np.random.default_rng(0)
    actuator_gain = ActuatorGainEstimator(problem)
    for _ in range(60):
        told = random.uniform(-0.5, 0.5, (3, 2)).astype(np.float32)
        executed = told + np.array([[0, 0], [0.12, 0], [0, -0.22]], np.float32)
        actuator_gain.observe(told, executed, random.uniform(size=3) >= lost)
    np.testing.assert_allclose(actuator_gain.problem.team.max_acceleration, [1, 0.9, 0.8], rtol=1e-5)
    np.testing.assert_array_equal(actuator_gain.problem.team.max_speed, problem.team.max_speed)
    np.testing.assert_allclose(actuator_gain.added, [[0, 0], [0.12, 0], [0, -0.22]], atol=0.01)


def test_each_control_has_limits_of_its_own() -> None:
    """A robot that is weak in one of them is believed to be weak in that one, and no faster than it."""
    team = Team(("unicycle2",), own_limits={"max_reverse_speed": 0.5})
    problem = Problem(team, [[0, 0, 0, 0, 0]], [[5, 0]])
    actuator_gain, most = ActuatorGainEstimator(problem), team.control_limits
    for step in range(20):
        told = most * np.float32([[1, 0.9 if step % 2 else 0]])
        actuator_gain.observe(told, told * np.float32([0.6, 1]), np.array([True]))
    believed = actuator_gain.problem.team
    assert believed.control_limits[0] == pytest.approx(most[0] * [0.6, 1.0])
    assert believed.max_speed == pytest.approx(0.6 * team.max_speed)
    assert believed.own_limits["max_reverse_speed"] == pytest.approx(0.3)


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "unicycle", "car"])
def test_robots_weak_in_all_that_they_do_are_recognised(model: str) -> None:
    """Also those that are asked for the most of two controls at once, each of which has a limit of its own."""
    problem, random = make_problem("circle", num_robots=3, model=model), np.random.default_rng(0)
    actuator_gain, most = ActuatorGainEstimator(problem), problem.team.control_limits
    for _ in range(30):
        told = limit_controls(problem, most * random.choice([-1, 1], (3, 2)).astype(np.float32))
        actuator_gain.observe(told, np.float32(0.8) * told, ALL)
    believed = actuator_gain.problem.team
    np.testing.assert_allclose(believed.control_limits, 0.8 * most, rtol=1e-5)
    np.testing.assert_allclose(believed.max_speed, 0.8 * problem.team.max_speed, rtol=1e-5)


def test_commands_make_up_for_what_is_added_to_them() -> None:
    problem, random, engine = make_problem("circle", num_robots=3), np.random.default_rng(0), get_sampling_engine("cpu")
    deviation, now, off = Deviation(problem, engine, D4ormC2FConfig(), docks=True), joint(problem, problem.start), []
    added = np.array([[0, 0], [0.12, 0], [0, -0.22]], np.float32)
    for _ in range(60):
        now = deviation.observe(now)
        told = random.uniform(-0.3, 0.3, (3, 2)).astype(np.float32)
        step = engine.step(problem.arrays, now.states, now.arrived, deviation.send(told) + added)
        now = now._replace(states=step.states, controls=step.controls)
        off.append(step.controls - told)
    np.testing.assert_allclose(off[0], added, atol=1e-6)
    np.testing.assert_allclose(off[-1], 0, atol=0.005)


@pytest.mark.slow
def test_robots_that_lose_commands_start_gently_near_walls() -> None:
    """With eight losses in a row to be reckoned with, a full start next to a wall is none that is safe."""
    problem = make_problem("rooms", num_robots=8, seed=1004)
    env = navigation_v0.parallel_env(problem=problem, disturbances=[Dropout(0.3)])
    assert run_episode(env, make_policy("d4orm-c2f", refine="sync"), seed=1004).metrics["success"]


@pytest.mark.parametrize(("bias", "believed"), [(0.0, 1.0), (0.3, 0.7)])
def test_noise_that_is_added_to_commands_is_not_kept_back(bias: float, believed: float) -> None:
    problem, random, shares = hop_problem(3), np.random.default_rng(0), []
    actuator_gain = ActuatorGainEstimator(problem)
    for _ in range(400):
        told = random.uniform(-0.3, 0.3, (3, 2)).astype(np.float32)
        actuator_gain.observe(
            told, told + np.float32([bias, 0]) + random.normal(0, 0.15, (3, 2)).astype(np.float32), ALL
        )
        shares.append(actuator_gain.problem.team.max_acceleration / problem.team.max_acceleration)
    assert np.mean(shares[50:]) == pytest.approx(believed, abs=0.05 if bias else 0.005)


def test_noise_that_lasts_a_second_is_hardly_kept_back() -> None:
    """Its mean over a second is of the size of a bias, and as often against it."""
    problem, random, shares = hop_problem(3), np.random.default_rng(0), []
    actuator_gain, noise = ActuatorGainEstimator(problem), np.zeros((3, 2), np.float32)
    for _ in range(400):
        told = random.uniform(-0.3, 0.3, (3, 2)).astype(np.float32)
        noise = (0.905 * noise + 0.425 * random.normal(0, 0.2, (3, 2))).astype(np.float32)
        actuator_gain.observe(told, told + noise, ALL)
        shares.append(actuator_gain.problem.team.max_acceleration / problem.team.max_acceleration)
    assert np.mean(shares) > 0.97


def test_a_robot_that_does_more_than_it_was_believed_to_is_strong_again() -> None:
    """Though nobody asks it for all that it can do while it is taken for weak."""
    problem = hop_problem(3)
    actuator_gain, ahead = ActuatorGainEstimator(problem), np.tile(np.float32([1, 0]), (3, 1))
    for _ in range(10):
        actuator_gain.observe(ahead, 0.6 * ahead, ALL)
    np.testing.assert_allclose(actuator_gain.problem.team.max_acceleration, 0.6, rtol=1e-5)
    for _ in range(20):
        actuator_gain.observe(0.6 * ahead, ahead, np.array([True, False, False]))
    for _ in range(60):
        actuator_gain.observe(0.6 * ahead, 0.6 * ahead, ALL)
    np.testing.assert_allclose(actuator_gain.problem.team.max_acceleration, [1, 0.6, 0.6], rtol=1e-5)


def test_a_robot_taken_for_weak_keeps_its_shape_and_is_weaker_either_way() -> None:
    footprint = Train(Box(0.5, 0.2), [Box(0.3, 0.2)])
    first = Team(("car_with_1_trailer",), footprint=footprint, own_limits={"max_reverse_speed": 0.4})
    problem = Problem(first, [[0, 0, 0, 0]], [[5, 0]])
    actuator_gain, ahead = ActuatorGainEstimator(problem), np.float32([[1, 0]])
    for _ in range(10):
        actuator_gain.observe(ahead, 0.5 * ahead, np.array([True]))
    team = actuator_gain.problem.team
    assert team.shapes == (footprint,)
    assert team.radius == first.radius
    assert team.max_speed == pytest.approx(0.5 * first.max_speed)
    assert team.own_limits["max_reverse_speed"] == pytest.approx(0.2)
    assert team.own_limits["wheelbase"] == first.own_limits["wheelbase"]


@pytest.mark.parametrize(("share", "runs"), [(0.0, {0}), (0.1, {4, 5}), (0.3, {7, 8, 9}), (0.7, {10})])
def test_how_many_commands_may_get_lost_in_a_row_is_found_out(share: float, runs: set[int]) -> None:
    """So many that 0.1, 0.3 to that power are about one in ten thousand; ten at most."""
    random, packet_loss = np.random.default_rng(1), PacketLossEstimator(hop_problem(3))
    executed = np.zeros((3, 2), np.float32)
    for _ in range(300):
        told = random.uniform(-0.7, 0.7, (3, 2)).astype(np.float32)
        lost = random.uniform(size=3) < share
        executed = np.where(lost[:, None], executed, told)
        np.testing.assert_array_equal(packet_loss.observe(told, executed, ALL), lost)
    assert packet_loss.run in runs


def test_noise_and_robots_that_stand_tell_of_no_losses() -> None:
    random, packet_loss = np.random.default_rng(1), PacketLossEstimator(hop_problem(3))
    for _ in range(100):
        told = random.uniform(-0.7, 0.7, (3, 2)).astype(np.float32)
        noisy = told + random.normal(0, 0.1, (3, 2)).astype(np.float32)
        noisy[0] = 0
        assert packet_loss.observe(told, noisy, ALL).tolist() == [True, False, False]
    assert packet_loss.run == 0


def test_who_goes_on_with_its_last_command_is_not_weak() -> None:
    problem = make_problem("circle", num_robots=4)
    env, policy = navigation_v0.parallel_env(problem=problem, disturbances=[Dropout(0.4)]), controller()
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    for _ in range(30):
        observations, *_ = env.step(policy.act(observations, env.state()))
        np.testing.assert_array_equal(policy._deviation.problem.team.limits, problem.team.limits)
    assert policy._deviation.packet_loss is not None
    assert policy._deviation.packet_loss.run > 5


@pytest.mark.parametrize(("steps", "holds"), [(1, False), (6, True)])
def test_a_command_may_be_held_for_so_many_steps_before_robots_brake(steps: int, holds: bool) -> None:
    """From 0.4 m/s and 0.8 m before a wall; with an eye to the next step only, full speed ahead is fine."""
    problem = hop_problem(1, world=World(2, boxes=[[0.9, -5, 1, 5]]), dt=0.1)
    policy, env = controller(), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    states = np.array([[0, 2, 0.4, 0]], np.float32)
    ahead, nobody = np.array([[1, 0]], np.float32), np.zeros(1, bool)
    present = joint(problem, states, controls=ahead)
    held = policy._braking_in_time(present, ahead, 0.0, 0.0, steps)
    engine, gap = get_sampling_engine("cpu"), np.inf
    for step in range(20):
        braking = track_velocities(problem, states, np.zeros((1, 2), np.float32))
        states = engine.step(problem.arrays, states, nobody, held if step < 6 else braking).states
        gap = min(gap, 0.9 - float(problem.team.radius[0]) - states[0, 0])
    assert (gap >= -1e-3) == holds


def test_who_cannot_go_on_for_another_step_is_told_the_nearest_safe_velocity() -> None:
    """To the bit, however fast it is 10 cm before a wall."""
    world = World(2, boxes=[[1, -5, 2, 5]])
    problem = Problem(Team(("velocity2d",)), [[0.75, 2]], [[0, 2]], world, dt=0.1)
    policy, env = controller(), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    ahead = np.array([[0.9, 0.3]], np.float32)
    for speed in np.linspace(0.1, 0.9, 9, dtype=np.float32):
        present = joint(problem, problem.start, controls=np.float32([[speed, speed / 3]]))
        later = joint(problem, problem.start + np.float32(0.1) * ahead)
        safe = safe_velocities(problem, later, ahead, ALL[:1], 0.02)
        assert safe[0, 0] < 0.6
        np.testing.assert_array_equal(policy._braking_in_time(present, ahead, 0.02, 0.0, 1), safe)


@pytest.mark.parametrize(("run", "looked_at"), [(0, [1]), (5, [6, 3, 1] * 2)])
def test_so_many_steps_are_as_many_as_commands_may_be_lost(
    monkeypatch: pytest.MonkeyPatch, run: int, looked_at: list[int]
) -> None:
    policy, env = controller(), navigation_v0.parallel_env(problem=make_problem("circle", num_robots=2))
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    policy.act(observations, env.state())
    asked: list[int] = []

    def braking_in_time(joint: JointState, controls: Any, gap: float, speed_slack: float, steps: int) -> Any:
        asked.append(steps)
        return controls

    monkeypatch.setattr(policy._deviation, "packet_loss", SimpleNamespace(run=run))
    monkeypatch.setattr(policy._window, "touching", lambda *_: np.ones(2, bool))
    monkeypatch.setattr(policy, "_braking_in_time", braking_in_time)
    policy._evading(split_state(policy.problem, env.state()), policy._plan[0])
    assert asked == looked_at


def test_noise_on_measurements_sends_nobody_off_again() -> None:
    problem = hop_problem(2)
    policy, env = controller(), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    for away, goals, arrived in [
        (2.0, problem.goal, False),
        (0.5, problem.goal, True),
        (2.0, problem.goal, True),
        (2.0, problem.goal + np.float32(1), False),
    ]:
        states = problem.start.copy()
        states[:, :2] = problem.goal + np.float32([away * problem.goal_radius, 0])
        policy._note_arrivals(joint(problem, states, goals=goals, arrived=np.array([True, False])))
        assert policy._arrived.tolist() == [arrived, False]


def test_who_is_nearly_there_drives_straight_home() -> None:
    """Past the goal at full speed where that meets it, with a turn to stop there where it does not; or as sampled."""
    problem = hop_problem(4, dt=0.1, horizon=20)
    states = np.zeros((4, 4), np.float32)
    states[:, :2] = problem.goal
    states[:, 0] -= [0.9, 0.9, 0.9, 3.0]
    states[:, 1] += [0.1, 0.1, 0.1, 0.1]
    states[:, 2] = [1.0, 1.0, 1.0, 1.0]
    controls = np.zeros((20, 4, 2), np.float32)
    window, engine = problem.with_state(states, problem.goal), get_sampling_engine("cpu")
    nobody = np.zeros(4, bool)
    chosen, home = direct_final_approach(window, engine, controls, np.array([True, False, True, True]), nobody)
    assert home.tolist() == [True, False, True, False]
    np.testing.assert_array_equal(chosen[:, ~home], controls[:, ~home])
    missed, met = engine.rollout(window, controls).arrived, engine.rollout(window, chosen).arrived
    assert not missed[-1].any()
    assert met[-1].tolist() == home.tolist()
    assert np.argmax(met[:, 0]) == 9  # 0.9 m at 1 m/s, but for the goal's radius and the turn
    again, home = direct_final_approach(window, engine, chosen, np.array([True, False, False, False]), nobody)
    assert home.tolist() == [True, False, False, False]
    np.testing.assert_array_equal(again, chosen)


def parked_cars(*, beside: float) -> Problem:
    """A car at rest so far beside its goal [m], and one that has docked a metre further on that side."""
    start = np.zeros((2, 5), np.float32)
    start[1, 1] = -1
    return Problem(Team(("car", "car")), start, np.float32([[0, beside], [0, -1]]), horizon=100, margin=0.05)


@pytest.mark.parametrize("beside", [0.1, slow(0.3), 0.6])
def test_a_car_beside_its_goal_drives_away_and_comes_again(beside: float) -> None:
    """Within its turning circle there is no path home that does not lead away first."""
    problem, arrived = parked_cars(beside=beside), np.array([False, True])
    window, still = problem.replace(horizon=20), np.zeros((20, 2, 2), np.float32)
    controls, home = direct_final_approach(window, get_sampling_engine("cpu"), still, np.zeros(2, bool), arrived)
    assert home.tolist() == [True, False]
    positions = get_sampling_engine("cpu").rollout(window, controls).positions[:, 0]
    assert np.linalg.norm(positions - problem.goal[0], axis=1).max() > beside + 0.05
    env = navigation_v0.parallel_env(problem=problem, control_noise_std=0.2)
    assert run_episode(env, controller(), seed=0).metrics["success"]


@pytest.mark.parametrize(("beside", "steps"), [(0.1, 21), (0.6, 30)])
def test_of_manoeuvres_the_first_to_arrive_is_taken_however_far_is_predicted(beside: float, steps: int) -> None:
    """The longest that are tried have 55 steps."""
    window, arrived, engine = parked_cars(beside=beside), np.array([False, True]), get_sampling_engine("cpu")
    still = np.zeros((100, 2, 2), np.float32)
    controls, home = direct_final_approach(window, engine, still, np.zeros(2, bool), arrived)
    assert home.tolist() == [True, False]
    assert np.argmax(engine.rollout(window, controls).arrived[:, 0]) == steps
    sooner, _ = direct_final_approach(window.replace(horizon=20), engine, still[:20], np.zeros(2, bool), arrived)
    np.testing.assert_array_equal(sooner, controls[:20])


def test_manoeuvres_lead_by_points_all_around_a_quarter_one_and_two_turning_radii_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    window, tried = parked_cars(beside=0.1).replace(horizon=20), []

    def recorded(*arguments: Any) -> Any:
        tried.append(arguments[-1])
        return drives(*arguments)

    monkeypatch.setattr("d4orm_planners.d4orm_c2f.direct_final_approach.drives", recorded)
    nobody, still = np.zeros(2, bool), np.zeros((20, 2, 2), np.float32)
    direct_final_approach(window, get_sampling_engine("cpu"), still, nobody, np.array([False, True]))
    offsets = (tried[0][0, :, 0] - window.start[0, :2]).reshape(-1, 16, 2)
    directions = np.sort(np.arctan2(offsets[..., 1], offsets[..., 0]) % (2 * np.pi))
    np.testing.assert_allclose(np.diff(directions), np.pi / 8, rtol=1e-4)
    away = np.linalg.norm(offsets, axis=2)
    beyond = away - NEAR_VIA * window.team.largest_radius
    expected = np.array([[0.25], [1.0], [2.0]]) * window.team.turning_radius[0]
    np.testing.assert_allclose(beyond, np.broadcast_to(expected, (3, 16)), rtol=1e-5)


def test_no_manoeuvre_leads_through_what_stands() -> None:
    around = 2 * np.pi / 6 * np.arange(6)
    start = np.zeros((7, 5), np.float32)
    start[1:, :2] = 0.36 * np.stack([np.cos(around), np.sin(around)], axis=1)
    goal = start[:, :2].copy()
    goal[0] = [0, 1]
    problem = Problem(Team(("car",) * 7), start, goal, horizon=30)
    controls, arrived = np.zeros((problem.horizon, 7, 2), np.float32), np.arange(7) > 0
    chosen, home = direct_final_approach(problem, get_sampling_engine("cpu"), controls, ~arrived, arrived)
    assert not home.any()
    np.testing.assert_array_equal(chosen, controls)


@pytest.mark.parametrize(("aside", "home"), [(0.36, True), (0.34, False)])
def test_a_car_drives_home_past_who_has_docked_only_as_far_from_it_as_it_must_be(aside: float, home: bool) -> None:
    """At 1 m/s and in a straight line it is nearest to the other, 1 cm more or less than the margin, after a step."""
    start = np.float32([[0, 0, 0, 1, 0], [0.1, -aside, 0, 0, 0]])
    problem = Problem(Team(("car", "car")), start, [[4, 0], start[1, :2]], horizon=60, dt=0.1, margin=0.05)
    controls, first = np.zeros((60, 2, 2), np.float32), np.array([True, False])
    _, final = direct_final_approach(problem, get_sampling_engine("cpu"), controls, first, ~first)
    assert final.tolist() == [home, False]


@pytest.mark.parametrize(("model", "within"), [("unicycle", 0.1), ("differential_drive", 0.4)])
def test_robots_of_first_order_stray_until_their_next_command_only(model: str, within: float) -> None:
    policy, problem = controller(), make_problem("random", num_robots=2, seed=1, model=model)
    run_episode(navigation_v0.parallel_env(problem=problem, control_noise_std=0.2), policy, seed=0)
    deviation = policy._deviation
    assert deviation.margin_inflation(0.4) == pytest.approx(within * deviation.speed.max())
    assert 0 < deviation.margin_inflation(0.4) < 0.15
    deviation.speed = np.full(2, 9.0)
    assert deviation.margin_inflation(0.4) == problem.team.largest_radius


def unestimated(problem: Problem) -> Deviation:
    """Compares robots with a model of which nothing is found out."""
    config = D4ormC2FConfig(delay=0, filter_states=False, learn_limits=False, expect_losses=False, stalls=False)
    return Deviation(problem, get_sampling_engine("cpu"), config, docks=True)


@pytest.mark.parametrize(("filters", "lowest", "highest"), [(True, 0.0, 0.014), (False, 0.016, 0.024)])
def test_noisy_states_of_robots_are_filtered_if_asked_for(filters: bool, lowest: float, highest: float) -> None:
    """Robots stand, and are measured with errors of 2 cm and 2 cm/s."""
    problem, still, random = hop_problem(3), np.zeros((3, 2), np.float32), np.random.default_rng(0)
    config = D4ormC2FConfig(delay=0, filter_states=filters, learn_limits=False, expect_losses=False, stalls=False)
    deviation, errors = Deviation(problem, get_sampling_engine("cpu"), config, docks=True), []
    for _ in range(100):
        seen = deviation.observe(joint(problem, problem.start + random.normal(0, 0.02, (3, 4))))
        deviation.send(still)
        errors.append(seen.states - problem.start)
    assert lowest < np.std(errors[50:]) < highest


def test_pushes_of_five_steps_add_up() -> None:
    """Something makes a robot that is told to stay at rest faster by 2 cm/s in every step."""
    problem, still = hop_problem(1, dt=0.1), np.zeros((1, 2), np.float32)
    deviation, states, drifts = unestimated(problem), problem.start.copy(), []
    for _ in range(8):
        deviation.observe(joint(problem, states))
        deviation.send(still)
        drifts.append(deviation.drift)
        states[:, 0] += states[:, 2] * np.float32(problem.dt)
        states[:, 2] += np.float32(0.02)
    # A single push counts half as much again.
    np.testing.assert_allclose(drifts, [0, 0.03, 0.04, 0.06, 0.08, 0.1, 0.1, 0.1], atol=1e-6)


@pytest.mark.parametrize(("drift", "slack"), [(0.019, 0.0), (0.021, 0.021), (0.39, 0.39), (5.0, 0.4)])
def test_no_more_is_believed_than_two_fifths_of_the_speed_and_no_less_than_a_fiftieth(
    drift: float, slack: float
) -> None:
    deviation = unestimated(hop_problem(1))
    deviation.drift = drift
    assert deviation.speed_slack == pytest.approx(slack)


def test_who_stands_whatever_it_is_told_is_taken_for_docked_until_it_moves() -> None:
    problem = hop_problem(3)
    stall, states = StallEstimator(problem), problem.start.copy()
    told = np.array([[0.8, 0], [0.8, 0], [0.0, 0]], np.float32)
    executed = np.array([[0.8, 0], [0.0, 0], [0.0, 0]], np.float32)
    for step in range(IDLE_STEPS + 1):
        assert stall.robots.tolist() == [False, step >= IDLE_STEPS, False]
        seen = stall.observe(joint(problem, states, controls=executed), told)
    np.testing.assert_array_equal(seen.arrived, [False, True, False])
    np.testing.assert_array_equal(seen.goals[1], states[1, :2])
    np.testing.assert_array_equal(seen.goals[[0, 2]], problem.goal[[0, 2]])
    states[1, 0] += 0.2
    assert not stall.observe(joint(problem, states, controls=executed), told).arrived.any()


def test_who_brakes_whatever_it_is_told_is_taken_for_docked_where_it_will_come_to_rest() -> None:
    problem, engine = hop_problem(2), get_sampling_engine("cpu")
    stall, states = StallEstimator(problem), problem.start.copy()
    states[:, 2] = 0.9
    told = np.array([[0.0, 0.9], [0.0, -0.9]], np.float32)
    executed = np.zeros_like(told)
    for step in range(9):
        seen = stall.observe(joint(problem, states, controls=executed), told)
        assert stall.robots.tolist() == [step >= BRAKING_STEPS, False]
        executed = told.copy()
        executed[0] = track_velocities(problem, states, np.zeros((2, 2), np.float32))[0]
        states = engine.step(problem.arrays, states, np.zeros(2, bool), executed).states
    assert abs(states[0, 2]) < 0.05
    np.testing.assert_allclose(seen.states[0, :2], states[0, :2], atol=0.05)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_two_robots_that_follow_safe_velocities_never_touch(seed: int) -> None:
    """They want to go anywhere, mostly through each other."""
    random = np.random.default_rng(seed)
    start = np.zeros((2, 4), np.float32)
    start[:, :2] = np.array([[1, 0], [-1, 0]]) + random.uniform(-0.4, 0.4, (2, 2))
    # Nobody comes to its goal: who docks stands at once, whatever its speed, and so cannot be followed safely.
    problem = Problem(hop_problem(2).team, start, start[:, :2] + 50, horizon=60)
    engine, states, free = get_sampling_engine("cpu"), problem.start, np.ones(2, bool)
    for step in range(60):
        if step % 15 == 0:
            towards = states[::-1, :2] - states[:, :2] + random.uniform(-0.5, 0.5, (2, 2))
            wanted = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
        present = joint(problem, states)
        ahead = engine.step(problem.arrays, states, ~free, track_velocities(problem, states, wanted))
        safe = safe_velocities(problem, present._replace(states=ahead.states), ahead.states[:, 2:], free, 0.05)
        result = engine.step(problem.arrays, states, ~free, track_velocities(problem, states, safe))
        states = result.states
        assert not result.collided.any()


@given(seed=st.integers(0, 10**6), rows=st.integers(1, 12), d=st.sampled_from([2, 3]))
@settings(max_examples=60, deadline=None)
def test_the_nearest_velocities_are_those_of_least_squares(seed: int, rows: int, d: int) -> None:
    """Against non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, chapter 23)."""
    random = np.random.default_rng(seed)
    one, other = random.integers(0, 4, rows), random.integers(-1, 4, rows)
    other[other == one] = -1
    normals = random.normal(size=(rows, d))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wanted, kept = random.normal(size=(2, 4, d))
    # There are some: those kept.
    least = -Barriers(one, other, normals, np.zeros(rows)).missing(kept) - random.uniform(0, 1, rows)
    barriers = Barriers(one, other, normals, least)
    matrix = np.zeros((rows, 4, d))
    matrix[np.arange(rows), one] = normals
    matrix[other >= 0, other[other >= 0]] = -normals[other >= 0]
    system, target = np.vstack([matrix.reshape(rows, -1).T, barriers.missing(wanted)]), np.zeros(4 * d + 1)
    target[-1] = 1
    left = system @ nnls(system, target)[0] - target
    found = wanted.copy()
    if find_nearest(*barriers, found, 1e-6):
        np.testing.assert_allclose(found - wanted, (-left[:-1] / left[-1]).reshape(4, d), atol=1e-3)
    else:
        assert barriers.missing(found).max() < 0.05


def test_between_walls_that_close_in_there_are_no_velocities() -> None:
    normals = np.array([[1.0, 0], [-1, 0]])
    barriers = Barriers(np.zeros(2, np.int64), np.full(2, -1), normals, np.array([0.1, 0.1]))
    assert not find_nearest(*barriers, np.zeros((1, 2)), 1e-6)


def test_velocities_that_are_safe_are_left_alone() -> None:
    problem = hop_problem(3)
    wanted = np.array([[0.5, 0], [0.5, 0], [0.5, 0]], np.float32)
    np.testing.assert_array_equal(safe_velocities(problem, joint(problem, problem.start), wanted, ALL, 0.02), wanted)


def test_robots_with_room_between_them_may_stand_however_much_disturbs_them() -> None:
    """A centimetre beyond the gap, where they may come to be faster than they brake."""
    problem, states = hop_problem(2), np.zeros((2, 4), np.float32)
    states[1, 0] = 2 * problem.team.largest_radius + 0.02 + 0.01
    still = np.zeros((2, 2), np.float32)
    safe = safe_velocities(problem, joint(problem, states), still, np.ones(2, bool), 0.02, speed_slack=5.0)
    np.testing.assert_array_equal(safe, still)


def test_who_cannot_be_told_anything_is_driven_around() -> None:
    """Two robots face each other 4 cm apart; one of them stands."""
    problem, states = hop_problem(2), np.zeros((2, 4), np.float32)
    states[1, 0] = 0.34
    wanted = np.array([[0.5, 0], [0, 0]], np.float32)
    safe = safe_velocities(problem, joint(problem, states), wanted, np.array([True, False]), 0.02)
    np.testing.assert_allclose(safe, np.array([[np.sqrt(2 * 0.02), 0], [0, 0]]), atol=1e-4)
    states[1, 0] = 0.31
    parting = safe_velocities(problem, joint(problem, states), wanted, np.array([True, False]), 0.02)
    np.testing.assert_allclose(parting, [[-2 * 0.01, 0], [0, 0]], atol=1e-4)


@pytest.mark.parametrize(
    ("wide", "allowed"),  # sqrt(2 * 0.32 + 0.1**2) - 0.1 - 0.3 with an acceleration of 1 m/s^2 and steps of 0.1 s
    [(0.34, np.sqrt(0.65) - 0.4), (0.05, 0.0)],
)
def test_with_caution_robots_could_still_brake_a_step_later_and_faster(wide: float, allowed: float) -> None:
    world = World(2, boxes=[[-1, -5, -0.15 - wide, 5]])
    problem = hop_problem(1, world=world, dt=0.1)
    wanted = np.array([[-0.9, 0.2]], np.float32)
    safe = safe_velocities(problem, joint(problem, np.zeros((1, 4))), wanted, np.ones(1, bool), 0.02, 0.3)
    np.testing.assert_allclose(safe, [[-allowed, 0.2]], atol=1e-4)


@pytest.mark.parametrize(
    ("apart", "allowed"),  # sqrt(2 * 2 * 1.13 + 0.2**2) - 0.2 - 0.3 for both together, by 1 m/s^2 each
    [(1.45, (np.sqrt(4.56) - 0.5) / 2), (1.55, 1.0)],
)
def test_robots_mind_each_other_from_ten_thirds_of_a_radius_and_two_stops_on(apart: float, allowed: float) -> None:
    problem, states = hop_problem(2, dt=0.1), np.zeros((2, 4), np.float32)
    states[1, 0] = apart
    wanted = np.array([[1, 0], [-1, 0]], np.float32)
    safe = safe_velocities(problem, joint(problem, states), wanted, np.ones(2, bool), 0.02, 0.3)
    np.testing.assert_allclose(safe, [[allowed, 0], [-allowed, 0]], atol=1e-4)


def test_robots_of_first_order_stop_within_a_time_step() -> None:
    world = World(2, boxes=[[-1, -5, -0.25, 5]])
    problem = Problem(Team(("velocity2d",)), [[0, 0]], [[2, 0]], world, horizon=30)
    wanted, still = np.array([[-0.9, 0.2]], np.float32), np.zeros((1, 2), np.float32)
    safe = safe_velocities(problem, joint(problem, still), wanted, np.ones(1, bool), 0.02, 0.3)
    # As if by 1 m/s in 0.1 s: sqrt(2 * 10 * 0.08 + 1) - 1 - 0.3.
    np.testing.assert_allclose(safe, [[1.3 - np.sqrt(2.6), 0.2]], atol=1e-4)


def test_in_a_corner_both_walls_count() -> None:
    world = World(2, boxes=[[-1, -5, -0.25, 5], [-5, -1, 5, -0.3]])
    problem = hop_problem(1, world=world)
    wanted = np.array([[-0.9, -0.9]], np.float32)
    safe = safe_velocities(problem, joint(problem, np.zeros((1, 4))), wanted, np.ones(1, bool), 0.02)
    np.testing.assert_allclose(safe, [[-np.sqrt(2 * 0.08), -np.sqrt(2 * 0.13)]], atol=1e-4)


def test_an_intruder_is_made_way_for() -> None:
    problem = hop_problem(1)
    body = np.array([[0.32, 0, -0.5, 0, 0.15]], np.float32)
    present = joint(problem, problem.start, bodies=body)
    safe = safe_velocities(problem, present, np.zeros((1, 2), np.float32), np.ones(1, bool), 0.02)
    np.testing.assert_allclose(safe, [[-0.5, 0]], atol=1e-3)


@pytest.mark.parametrize(
    ("disturbance", "late"), [(Delay(2), 2), (Delay(0), 0), (StateDelay(1), 1)], ids=["delay", "none", "seen late"]
)
def test_an_episode_tells_how_late_commands_are(disturbance: Any, late: int) -> None:
    policy = controller()
    env = navigation_v0.parallel_env(problem=make_problem("circle", num_robots=4), disturbances=[disturbance])
    executed = run_episode(env, policy, seed=0)
    assert executed.metrics["success"], executed.metrics
    assert policy._deviation.latency.steps == late


@pytest.mark.parametrize("scenario", ["random", slow("circle")])
@pytest.mark.parametrize(
    "disturbance", [Push(0.4, 0.3), LimitMismatch(0.7), Bias(0.15)], ids=lambda one: type(one).__name__
)
def test_robots_come_home_disturbed(scenario: str, disturbance: Any) -> None:
    problem = make_problem(scenario, num_robots=6, seed=2)
    executed = run_episode(
        navigation_v0.parallel_env(problem=problem, disturbances=[disturbance]), controller(), seed=1
    )
    assert executed.metrics["success"], executed.metrics


def test_a_robot_that_has_stalled_is_driven_around() -> None:
    problem = make_problem("circle", num_robots=6)
    env = navigation_v0.parallel_env(problem=problem, disturbances=[Stall(1.0, robots=1)])
    policy = controller()
    executed = run_episode(env, policy, seed=2)
    assert policy._deviation.stall is not None
    assert policy._deviation.stall.robots.sum() == 1
    assert not executed.trajectory.collided.any()
    np.testing.assert_array_equal(executed.trajectory.arrived[-1], ~policy._deviation.stall.robots)


@pytest.mark.parametrize("lifelong", [False, True], ids=["once", "lifelong"])
@pytest.mark.parametrize("model", ["velocity2d", slow("holonomic2d"), slow("differential_drive")])
def test_finding_out_changes_nothing_while_all_is_as_believed(model: str, lifelong: bool) -> None:
    problem = make_problem("circle", num_robots=4, model=model)
    options: dict[str, Any] = {"problem": problem, "lifelong": lifelong, "max_cycles": 120 if lifelong else None}
    known = {"delay": 0, "filter_states": False, "learn_limits": False, "stalls": False, "last_resort": False}
    known["expect_losses"] = False
    assert controller().config.last_resort, "by default all of it is found out"
    plain, watchful = (
        run_episode(navigation_v0.parallel_env(**options), controller(**config), seed=0) for config in (known, {})
    )
    np.testing.assert_array_equal(watchful.trajectory.states, plain.trajectory.states)
    assert not lifelong or watchful.metrics["goals_reached"] > 4


def test_the_paper_preset_is_algorithm_4() -> None:
    policy = make_policy("d4orm-c2f", preset="paper", engine="cpu", refine="sync", num_steps=10, coarse_steps=30)
    assert isinstance(policy, D4ormC2F)
    executed = run_episode(navigation_v0.parallel_env(problem=make_problem("circle", num_robots=3)), policy, seed=0)
    assert executed.metrics["success"], executed.metrics
    config = policy.config
    assert (config.num_samples, config.coarse_samples, config.credit, config.penalty) == (1024, 1024, "team", 1.0)
    assert (config.max_lag, config.mean_of_all) == (None, True), "the team is where all of its robots are on average"
    planner = policy._tracker._planning.planner.config
    assert (planner.decoupling, planner.start, planner.credit, planner.weight_cutoff) == ("groups", "team", "team", 0.0)
    assert not any(loop.replanned for loop in policy.loops)
    # Line 7: one waypoint for the whole team.
    np.testing.assert_array_equal(policy.subgoals, policy.guidance.path[policy.loops[-1].subgoal_index])


def test_a_preset_of_a_policy_may_be_changed_and_must_exist() -> None:
    policy = make_policy("d4orm-c2f", preset="paper", penalty=3.0)
    assert (policy.config.penalty, policy.config.safe_mix) == (3.0, False)  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="preset 'nope' of policy 'd4orm-c2f' is unknown; choose one of paper"):
        make_policy("d4orm-c2f", preset="nope")
    with pytest.raises(TypeError, match="preset"):
        make_policy("orca", preset="paper")
