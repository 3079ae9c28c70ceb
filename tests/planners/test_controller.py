"""Controllers of robots: what they do in a loop without an environment, and what sensors may say."""

from __future__ import annotations

import gc
import itertools
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from env_support import slow
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from d4orm_env import Problem, Team, make_problem, navigation_v0, rollout
from d4orm_env.disturbances import Bias, ControlNoise, Gain, Lag, StateNoise
from d4orm_env.envs.joint_state import split_state
from d4orm_planners import Controller, make_planner, make_policy, run_episode
from d4orm_planners.base import policy_threads
from d4orm_planners.base.disturbance_observer import MOST, DisturbanceObserver
from d4orm_planners.base.policy import GoToGoal, OpenLoop
from d4orm_planners.tracking.reference_feedback import ControlSetpoint
from d4orm_planners.tracking.steering import advanced, integrated, present_velocities

MODELS = ("holonomic2d", "velocity2d", "differential_drive", "unicycle", "holonomic3d")


def team(model: str, count: int = 4, **changes: Any) -> Problem:
    return make_problem("sphere" if model == "holonomic3d" else "circle", num_robots=count, model=model, **changes)


def driven(controller: Controller, problem: Problem, disturbances: Any = (), seed: int = 0) -> tuple[Any, list[Any]]:
    """A plant that does what the controller says, and all setpoints."""
    plant, said = navigation_v0.parallel_env(problem=problem, disturbances=list(disturbances)), []
    plant.reset(seed=seed)
    time = 3.0
    controller.begin(problem, plant.unwrapped.problem.start, time, seed)
    while plant.agents:
        measured = split_state(problem, plant.state()).states
        said.append(controller.step(measured, time))
        plant.step({agent: said[-1].control[int(agent.removeprefix("robot_"))] for agent in plant.agents})
        time += problem.dt
    controller.close()
    return plant, said


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("mode", ["nominal", slow("measured")])
def test_a_perfect_robot_drives_as_in_the_environment(mode: Any, model: str) -> None:
    problem = team(model)
    policy, same = ("d4orm", {}) if model == "unicycle" else ("d4orm-c2f", {"refine": "sync"})
    plant, said = driven(Controller(policy, mode=mode, reserve=0.0, **same), problem)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), make_policy(policy, **same), seed=0)
    assert plant.metrics()["success"] == episode.metrics["success"] == 1
    positions = np.stack([s.position for s in said])
    states = episode.trajectory.positions[1:]
    steps = min(len(positions), len(states))
    # In mode nominal a robot is some millimetres off its reference, and may arrive a step or two later.
    assert (0 if mode == "nominal" else -1) <= len(positions) - len(states) <= 2
    # What float32 leaves of a measured velocity is a push, but a small one. At the speed limit a model gains half of
    # dt^2 times the control a step, which the controller does not ask of a robot.
    gained = 0.02 if problem.team.robot_models[0].first_order else 0.2
    np.testing.assert_allclose(positions[:steps], states[:steps], atol=2e-5 if mode == "nominal" else gained)
    speeds = np.linalg.norm([s.velocity for s in said], axis=2)
    at_limit = (speeds >= 0.999 * problem.team.max_speed).any(axis=1)
    before = int(at_limit.argmax()) if at_limit.any() else steps
    np.testing.assert_allclose(positions[:before], states[:before], atol=0.02)
    np.testing.assert_array_equal(said[-1].arrived, True)
    assert not any(s.held for s in said)
    assert speeds.max() <= problem.team.max_speed.max() * (1 + 1e-5)


@pytest.mark.parametrize("mode", ["nominal", "measured"])
@pytest.mark.parametrize("model", ["holonomic2d", slow("differential_drive"), slow("car")])
def test_a_lag_that_nobody_told_is_found(model: str, mode: Any) -> None:
    problem = team(model)
    lags = np.array([0.0, 0.15, 0.15, 0.3], np.float32)
    with Controller("d4orm-c2f", mode=mode, refine="sync") as controller:
        _, gap, setpoint = lagging(controller, problem, lags, 160)
        np.testing.assert_allclose(controller.lag, lags, atol=0.06)
        assert setpoint.arrived.all()
        assert gap > 0
        controller.begin(problem, problem.start, time=1e3)
        np.testing.assert_allclose(controller.lag, lags, atol=0.06, err_msg="the team goes on")


@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_no_lag_is_found_where_there_is_none(mode: Any) -> None:
    for disturbances in ([StateNoise(0.01, 0.1)], [ControlNoise(0.2)], [Bias(0.1)]):
        controller = Controller("d4orm-c2f", mode=mode, refine="sync")
        driven(controller, team("holonomic2d"), disturbances)
        np.testing.assert_array_equal(controller.lag, 0)


@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_a_controller_is_a_policy_of_the_environments(mode: Any) -> None:
    problem = team("holonomic2d")
    env = navigation_v0.parallel_env(problem=problem, disturbances=[Bias(0.05)])
    episode = run_episode(env, Controller("d4orm-c2f", mode=mode, refine="sync"), seed=0)
    assert episode.metrics["success"] == 1
    plant, _ = driven(Controller("d4orm-c2f", mode=mode, refine="sync"), problem, [Bias(0.05)])
    assert plant.metrics()["travel_time"] == episode.metrics["travel_time"], "as in a loop of one's own"


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", slow("car"), slow("unicycle2")])
def test_robots_that_nothing_but_controls_limits_keep_to_their_speed(model: str) -> None:
    problem = team(model)
    states, fastest = problem.start.copy(), 0.0
    states[:, problem.dimension + (model != "holonomic2d")] = 1.1 * problem.team.max_speed  # too fast when it begins
    with Controller("d4orm-c2f", mode="measured", refine="sync") as controller:
        controller.begin(problem, states)
        for step in range(95):
            states = integrated(problem, states, controller.step(states, step * problem.dt).control)
            speed = np.linalg.norm(present_velocities(problem, states, np.zeros((4, 2), np.float32)), axis=1)
            fastest = max(fastest, (speed / problem.team.max_speed).max() if step else 0.0)
        assert controller.arrived.all()
    assert fastest < 1.01


@pytest.mark.parametrize(
    "policy", ["go-to-goal", "random", "orca", "ppo", "mppi", lambda o, s: {each: [9, 9] for each in o}]
)
def test_any_policy_is_within_each_robots_limits(policy: Any) -> None:
    if policy == "orca":
        pytest.importorskip("pyrvo")
    settings = {"num_samples": 64, "num_steps": 5, "max_iterations": 2} if policy == "mppi" else {}
    problem = team("holonomic2d", max_acceleration=[1.0, 0.5, 0.2, 1.0])
    _, said = driven(Controller(policy, mode="measured", **settings), problem, [StateNoise(0.01, 0.02)])
    sizes = np.linalg.norm([s.control for s in said], axis=2)
    assert (sizes <= problem.team.max_acceleration * (1 + 1e-6)).all()
    assert all(s.control.dtype == np.float32 for s in said)


@pytest.mark.parametrize(
    ("mode", "disturbances"),
    [
        ("measured", [Bias(0.25)]), slow("measured", [ControlNoise(0.2)]), slow("measured", [Gain(0.1)]),
        ("measured", [StateNoise(0.01, 0.02)]), ("nominal", [ControlNoise(0.2)]),
        slow("nominal", [StateNoise(0.01, 0.02)]),
    ],
)  # fmt: skip
def test_disturbed_robots_arrive(mode: Any, disturbances: list[Any]) -> None:
    problem = team("holonomic2d", 6, horizon=150)
    plant, said = driven(Controller("d4orm-c2f", mode=mode), problem, disturbances, seed=1)
    metrics = plant.metrics()
    assert metrics["arrived"] == 6
    assert metrics["collisions"] == 0
    assert len(said) < problem.horizon


def test_a_known_lag_is_no_weakness() -> None:
    problem = team("holonomic2d", 4, horizon=150)
    arrived = [
        driven(Controller("d4orm-c2f", mode="measured", lag=lag), problem, [Lag(0.25)])[0].metrics()["arrived"]
        for lag in (0.0, 0.25)
    ]
    assert arrived[1] == 4 > arrived[0]


def test_robots_without_a_speed_limit_of_their_own_keep_it() -> None:
    problem = team("holonomic2d", 3)
    states, fastest = problem.start.copy(), 0.0
    with Controller("go-to-goal", mode="measured") as controller:
        controller.begin(problem, states)
        for step in range(80):
            control = controller.step(states, step * problem.dt).control
            states[:, :2] += problem.dt * (states[:, 2:] + problem.dt / 2 * control)
            states[:, 2:] += problem.dt * control
            fastest = max(fastest, float(np.linalg.norm(states[:, 2:], axis=1).max()))
    assert controller.arrived.all()
    assert 0.9 < fastest < 1.001


def test_robots_with_trackers_lead_and_are_led() -> None:
    problem = team("holonomic2d", 4, horizon=150)
    states, wind, nearest = problem.start.copy(), np.float32([0.3, -0.2]), np.inf
    with Controller("d4orm-c2f", mode="measured", tracker=True, lag=0.2, refine="sync") as controller:
        controller.begin(problem, states, seed=2)
        for step in range(problem.horizon):
            s = controller.step(states, step * problem.dt)
            for part in np.arange(1, 11) / 10:  # as a drone: feed-forward, and a feedback that a wind deflects
                position = s.position + (part - 1) * problem.dt * s.velocity
                push = s.acceleration + 8 * (position - states[:, :2]) + 5 * (s.velocity - states[:, 2:]) + wind
                states[:, 2:] += problem.dt / 10 * push
                states[:, :2] += problem.dt / 10 * states[:, 2:]
            gaps = np.linalg.norm(states[:, None, :2] - states[:, :2], axis=2)[np.triu_indices(4, 1)]
            nearest = min(nearest, float(gaps.min()))
    assert controller.arrived.all()
    assert nearest > 2 * problem.team.radius.max()
    deflected = np.linalg.norm(wind) / 8
    assert (np.linalg.norm(states[:, :2] - problem.goal, axis=1) < problem.goal_radius + 0.5 * deflected).all()


@pytest.mark.parametrize("reserve", [0.5, 0.7])
def test_setpoints_of_a_tracker_stop_within_the_limits(reserve: float) -> None:
    problem = make_problem("circle", 1, robot="crazyflie", height=1.0, diameter=2.0, horizon=120)
    states, asked = problem.start.copy(), []
    with Controller("go-to-goal", tracker=True, reserve=reserve) as controller:
        controller.begin(problem, states)
        for step in range(problem.horizon):
            s = controller.step(states, step * problem.dt)
            states = np.concatenate([s.position, s.velocity], axis=1).astype(np.float32)
            asked.append(np.linalg.norm(s.acceleration, axis=1).max())
    assert controller.arrived.all()
    assert max(asked) <= 1.001 * problem.team.max_acceleration.max()


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d"])
def test_undelayed_states_obey_the_model(model: str) -> None:
    second = model == "holonomic2d"
    problem = Problem(Team((model,)), [[0, 0, 0, 0] if second else [0, 0]], [[5, 0]])
    observer, lag, dt = DisturbanceObserver(problem, 0.3), 0.3, problem.dt / 100
    state, applied = problem.start.astype(np.float64).copy(), np.zeros(2)
    before = None
    for control in np.float32([[0.5, 0.1], [-0.3, 0.4], [0.2, 0.0]]):
        now = observer.undelayed(state.astype(np.float32), np.ones(1, bool))
        if before is not None:
            np.testing.assert_allclose(now, before, atol=2e-3)
        observer.compensated(control[None], np.array([False]))
        position = now[0, :2] + (
            now[0, 2:] * problem.dt + control * problem.dt**2 / 2 if second else control * problem.dt
        )
        before = np.concatenate([position, now[0, 2:] + control * problem.dt])[None] if second else position[None]
        for _ in range(100):
            applied += dt / lag * (control - applied)
            state[0, :2] += dt * (state[0, 2:] if second else applied)
            if second:
                state[0, 2:] += dt * applied


def test_without_an_estimate_a_steady_push_leaves_robots_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the observer is for: go-to-goal brakes in time only if it knows what pushes it."""

    def misses() -> float:
        goals = []
        for seed in range(5):
            problem = team("holonomic2d", 1, goal_speed=0.05, horizon=140)
            plant, _ = driven(Controller("go-to-goal", mode="measured"), problem, [Bias(0.3)], seed)
            goals.append(plant.metrics()["arrived"])
        return float(np.mean(goals))

    with_observer = misses()
    monkeypatch.setattr("d4orm_planners.base.disturbance_observer.GAIN", 0.0)
    assert misses() <= with_observer == 1


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_sensors_may_say_anything(data: st.DataObject) -> None:
    problem = team("holonomic2d", 3)
    controller = Controller("go-to-goal", mode=data.draw(st.sampled_from(["nominal", "measured"])))
    controller.begin(problem, problem.start)
    values = st.floats(width=32) | st.floats(-3, 3, width=32)
    measured = st.lists(st.lists(values, min_size=4, max_size=4), min_size=3, max_size=3)
    for step in range(4):
        states = np.array(data.draw(measured), np.float32)
        said = controller.step(states, step * problem.dt)
        for part in (said.position, said.velocity, said.acceleration, said.control):
            assert np.isfinite(part).all()
        assert (np.linalg.norm(said.control, axis=1) <= problem.team.max_acceleration * (1 + 1e-6)).all()
    controller.close()


@pytest.mark.parametrize("model", ["differential_drive", "holonomic3d"])
def test_robots_measured_far_away_count_as_at_the_edge_whatever_the_reserve(model: str) -> None:
    problem = team(model, 2)
    for own in ({"tracker": True}, {"reserve": 0.3}):
        controller = Controller("go-to-goal", mode="measured", **own)
        controller.begin(problem, problem.start)
        for step in range(4):
            assert np.isfinite(controller.step(problem.start + np.float32(1e3), step * problem.dt).control).all()


def test_of_late_steps_no_push_is_learned() -> None:
    problem = team("velocity2d", 2)
    controller, states, time = Controller("go-to-goal", mode="measured"), problem.start, 0.0
    controller.begin(problem, states)
    for step in range(10):
        control = controller.step(states, time).control
        periods = 4 if step == 6 else 1
        states, time = states + periods * problem.dt * control, time + periods * problem.dt
    np.testing.assert_allclose(controller._observer.bias, 0, atol=1e-3)


def test_missing_robots_are_where_the_reference_has_them() -> None:
    problem = team("holonomic2d", 3)
    seen, blind = Controller("go-to-goal", mode="measured"), Controller("go-to-goal", mode="measured")
    for controller in (seen, blind):
        controller.begin(problem, problem.start)
    states = problem.start.copy()
    for step in range(20):
        told = seen.step(states, step * problem.dt)
        partly = states.copy()
        partly[1] = np.nan
        other = blind.step(partly, step * problem.dt)
        np.testing.assert_allclose(other.control, told.control, atol=1e-5)
        states = np.hstack([told.position, told.velocity]).astype(np.float32)


@pytest.mark.parametrize(("model", "unmeasured"), [("holonomic2d", [2, 3]), ("car", [3, 4]), ("unicycle2", [4])])
def test_what_no_sensor_says_follows_from_states_and_controls(model: str, unmeasured: list[int]) -> None:
    problem = team(model, 2)
    seeing, guessing = (Controller("go-to-goal", mode="measured") for _ in range(2))
    for controller in (seeing, guessing):
        controller.begin(problem, problem.start)
    states = problem.start.copy()
    for step in range(30):
        partly = states.copy()
        partly[:, unmeasured] = np.nan
        told, other = seeing.step(states, step * problem.dt), guessing.step(partly, step * problem.dt)
        np.testing.assert_allclose(guessing.states, states, atol=1e-5)
        np.testing.assert_allclose(other.control, told.control, atol=1e-4)
        states = advanced(problem, states, told.control)


@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_robots_that_are_seen_late_drive_as_if_they_were_seen_now(mode: Any) -> None:
    problem, told = team("holonomic2d", 2), []
    for late in ([0, 0], [1, 3]):
        with Controller("go-to-goal", mode=mode) as controller:
            controller.begin(problem, problem.start)
            seen, states, said = [], problem.start + np.float32([0.1, 0.1, 0, 0]), []
            for step in range(30):
                seen.append(states)
                old = np.minimum(late, step)
                measured = np.stack([seen[step - steps][robot] for robot, steps in enumerate(old)])
                setpoint = controller.step(measured, step * problem.dt, old * problem.dt)
                states = advanced(problem, states, setpoint.control)
                said.append(setpoint.control)
        told.append(said)
    np.testing.assert_allclose(*told, atol=2e-3)
    for age, message in (
        (-0.1, "age of robot_0 is -0.1"),
        ([0, 1.1], "age of robot_1 is 1.1 s; it must be at most 10"),
    ):
        with pytest.raises(ValueError, match=message):
            controller.step(states, 9.0, age)


def test_one_setpoint_a_period_and_none_skipped() -> None:
    problem = team("holonomic2d", 2)
    controller = Controller("go-to-goal")
    controller.begin(problem, problem.start, time=100.0)
    first = controller.step(problem.start, 100.0)
    assert controller.step(problem.start, 100.03) is first
    second = controller.step(problem.start, 100.1)
    assert second is not first
    late = controller.step(problem.start, 101.0)
    # The reference is one step on, not nine.
    assert np.linalg.norm(late.position - second.position, axis=1).max() <= 0.1 * problem.dt * 3
    after = controller.step(problem.start, 101.1)
    assert after is not late
    for time in (float("nan"), 1.7e18, True, 10**400):  # the second one in nanoseconds
        with pytest.raises(ValueError, match="give the seconds of one clock"):
            controller.step(problem.start, time)


def test_clocks_may_drift() -> None:
    problem = team("holonomic2d", 2)
    controller = Controller("go-to-goal")
    controller.begin(problem, problem.start)
    said = [controller.step(problem.start, 0.1013 * step + 0.01 * (-1) ** step) for step in range(50)]
    assert len({id(s) for s in said}) == 50


@pytest.mark.parametrize("jump", [-3600.0, -0.25, 3600.0])
def test_a_clock_that_is_set_leaves_the_reference_as_it_is(jump: float) -> None:
    problem, said = team("holonomic2d", 2), []
    for at in (np.inf, 7):
        controller, states = Controller("go-to-goal"), problem.start
        controller.begin(problem, states, time=1e4)
        said.append([])
        for step in range(30):
            clock = 1e4 + step * problem.dt + (jump if step >= at else 0.0)
            setpoint = controller.step(states, clock)
            assert controller.step(states, clock + 0.02) is setpoint
            states = advanced(problem, states, setpoint.control)
            said[-1].append(setpoint.position)
        assert controller.clock_resets == (jump < 0 and at < np.inf)
    np.testing.assert_array_equal(*said)


def test_what_comes_a_little_early_is_of_the_same_period() -> None:
    problem = team("holonomic2d", 2)
    controller = Controller("go-to-goal")
    controller.begin(problem, problem.start, time=1.0)
    first = controller.step(problem.start, 1.0)
    assert controller.step(problem.start, 0.96) is first
    assert controller.clock_resets == 0


class Tolerant(GoToGoal):
    """Remembers what goal headings may be missed by."""

    def reset(self, env: Any, seed: int = 0) -> None:
        super().reset(env, seed)
        self.tolerance = self.problem.goal_heading_tolerance.tolist()


def test_the_reference_leaves_a_share_of_what_a_goal_heading_may_be_missed_by() -> None:
    team = Team(("differential_drive",))
    problem = Problem(team, [[0, 0, 0, 0]], [[1, 0]], goal_heading=1.0, goal_heading_tolerance=0.1)
    for mode, tolerance in (("nominal", 0.075), ("measured", 0.1)):
        controller = Controller(policy := Tolerant(), mode=mode, reserve=0.25 if mode == "nominal" else None)
        controller.begin(problem, problem.start)
        assert policy.tolerance == pytest.approx([tolerance])


class Slow(GoToGoal):
    """A policy that answers when it is allowed to."""

    def __init__(self) -> None:
        self.allowed = threading.Event()
        self.calls = 0

    def act(self, observations: Any, state: Any) -> Any:
        self.calls += 1
        assert self.allowed.wait(60)
        return super().act(observations, state)


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "velocity2d"])
def test_who_does_not_answer_in_time_is_not_waited_for(model: str) -> None:
    problem, slow = team(model, 2), Slow()
    with Controller(slow, timeout=1000.0) as controller:
        controller.begin(problem, problem.start)
        slow.allowed.set()
        moving = [controller.step(problem.start, step * problem.dt) for step in range(4)]
        assert not any(s.held for s in moving)
        slow.allowed.clear()
        controller.timeout = 0.02
        held = [controller.step(problem.start, 4 * problem.dt)]
        controller.timeout = 1000.0  # for another answer: this one is late
        held += [controller.step(problem.start, step * problem.dt) for step in range(5, 24)]
        assert all(s.held for s in held)
        assert slow.calls == 5, "it is not asked again while it thinks"
        np.testing.assert_allclose(held[-1].velocity, 0, atol=1e-5)
        np.testing.assert_allclose(held[-1].position, held[-2].position, atol=1e-5)
        slow.allowed.set()
        times = itertools.count(24)
        until(lambda: not controller.step(problem.start, next(times) * problem.dt).held)


def test_what_a_step_does_after_its_wait_is_within_the_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock on which a policy never answers, and a setpoint takes a fifth of the time."""
    clock, described, taken, problem = [0.0], Controller._described, [], team("holonomic2d", 2)

    def late(background: Any, work: Any, timeout: float) -> None:
        clock[0] += timeout

    def slow(*arguments: Any, **named: Any) -> ControlSetpoint:
        clock[0] += 0.2
        return described(*arguments, **named)

    monkeypatch.setattr(policy_threads, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(policy_threads.Background, "run", late)
    monkeypatch.setattr(Controller, "_described", slow)
    controller = Controller("go-to-goal", timeout=1.0)
    controller.begin(problem, problem.start)
    for step in range(5):
        clock[0] = 10.0 * step
        assert controller.step(problem.start, step * problem.dt).held
        taken.append(clock[0] - 10.0 * step)
    np.testing.assert_allclose(taken[1:], 1.0)


def test_beside_control_loops_garbage_is_looked_for_among_what_is_new() -> None:
    kept, problem = [[[]] for _ in range(policy_threads.MANY)], team("holonomic2d", 2)
    gc.collect()
    assert len(gc.get_objects(generation=2)) > policy_threads.MANY
    for timeout, few in ((None, False), (60.0, True)):
        controller = Controller("go-to-goal", timeout=timeout)
        controller.begin(problem, problem.start)
        assert (len(gc.get_objects(generation=2)) < policy_threads.MANY) == few
    gc.unfreeze()
    del kept


def until(condition: Any) -> None:
    for _ in range(200):
        if condition():
            return
        threading.Event().wait(0.05)
    raise AssertionError


def test_who_has_arrived_is_brought_back() -> None:
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[0.3, 0]])
    controller = Controller("go-to-goal", mode="measured")
    controller.begin(problem, problem.start)
    states, step = problem.start, 0
    while not controller.arrived.all():
        said = controller.step(states, 0.1 * step)
        states, step = np.hstack([said.position, said.velocity]).astype(np.float32), step + 1
    assert controller.over
    np.testing.assert_array_equal(controller.step(states, 0.1 * step).control, 0)
    step += 1
    away = states + np.float32([0.2, 0, 0, 0])
    said = controller.step(away, 0.1 * (step + 1))
    assert said.control[0, 0] < -0.3
    np.testing.assert_allclose(said.position, states[:, :2], atol=1e-6)


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "velocity2d"])
@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_robots_are_at_rest_soon_after_the_horizon(mode: Any, model: str) -> None:
    problem = team(model, 2).replace(horizon=30)
    controller, states, told = Controller("go-to-goal", mode=mode), problem.start, []
    controller.begin(problem, states)
    for step in range(90):
        told.append(controller.step(states, step * problem.dt))
        states = moved(problem, states, told[-1].control)
    assert controller.over
    assert not controller.arrived.any()
    assert np.linalg.norm(told[29].velocity, axis=1).min() > 0.3, "they were under way"
    np.testing.assert_allclose(told[-1].velocity, 0, atol=1e-6)
    np.testing.assert_allclose(told[-1].position, told[45].position, atol=1e-5)
    np.testing.assert_allclose(states[:, :2], told[-1].position, atol=0.01)


def moved(problem: Problem, states: Any, controls: Any) -> Any:
    """States after a step of robots that do as the model says, and never arrive."""
    after = []
    for robot in range(problem.num_robots):
        alone = problem.select([robot]).replace(start=states[[robot]], goal=problem.goal[[robot]] + 50)
        held = np.repeat(controls[None, [robot]], problem.horizon, axis=0)
        after.append(rollout(alone, held, engine="cpu").states[1])
    return np.concatenate(after)


@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_first_order_robots_stay_at_their_goals(mode: Any) -> None:
    """Though they arrive at a speed, and where they are is known to a millimetre."""
    problem, random = team("velocity2d", 2), np.random.default_rng(0)
    controller, states = Controller("go-to-goal", mode=mode), problem.start
    controller.begin(problem, states)
    for step in range(150):
        control = controller.step(states + random.normal(0, 0.001, states.shape), step * problem.dt).control
        states = states + problem.dt * control
    assert controller.arrived.all()
    assert (np.linalg.norm(states - problem.goal, axis=1) <= problem.goal_radius).all()


@pytest.mark.parametrize("period", [0.02, 0.051, 0.06, 0.1])
def test_frequent_calls_make_the_reference_no_faster(period: float) -> None:
    problem = team("holonomic2d", 2)
    controller, states = Controller("go-to-goal"), problem.start
    controller.begin(problem, states)
    said = {}
    for call in range(round(3 / period)):
        setpoint = controller.step(states, call * period)
        said[id(setpoint)] = setpoint
        states = np.hstack([setpoint.position, setpoint.velocity])
    assert 29 <= len(said) <= 31


def test_setpoints_are_not_to_be_written_to() -> None:
    problem = team("holonomic2d", 2)
    controller = Controller("go-to-goal")
    controller.begin(problem, problem.start)
    setpoint = controller.step(problem.start, 0.0)
    for name in ("position", "velocity", "acceleration", "heading", "control", "arrived"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(setpoint, name)[:] = 0


def test_a_policy_drives_one_team_at_a_time() -> None:
    problem, policy = team("holonomic2d", 2), make_policy("orca")
    first, second = Controller(policy), Controller(policy)
    first.begin(problem, problem.start)
    first.step(problem.start, 0.0)
    second.begin(problem, problem.start)
    second.step(problem.start, 0.0)
    with pytest.raises(RuntimeError, match="this policy has begun another episode"):
        first.step(problem.start, 0.1)


def test_a_closed_controller_goes_on_when_asked() -> None:
    problem = team("holonomic2d", 2)
    controller = Controller("go-to-goal", timeout=60.0)
    controller.begin(problem, problem.start)
    controller.step(problem.start, 0.0)
    controller.close()
    assert not controller.step(problem.start, 0.1).held
    controller.close()


def test_a_step_that_failed_is_tried_again() -> None:
    problem, failing = team("holonomic2d", 2), [True]

    def act(observations: Any, _: Any) -> Any:
        if failing:
            raise OSError
        return {agent: [0.5, 0.0] for agent in observations}

    controller = Controller(act)
    controller.begin(problem, problem.start)
    with pytest.raises(OSError):  # noqa: PT011 - it is the policy's own
        controller.step(problem.start, 0.0)
    failing.clear()
    assert controller.step(problem.start, 0.0).control.any()


def test_whole_turns_of_a_measured_heading_say_nothing() -> None:
    problem = team("differential_drive", 2)
    told = []
    for turns in (0, 3, 100):
        controller = Controller("go-to-goal", mode="measured")
        controller.begin(problem, problem.start)
        states = problem.start + np.array([0, 0, 2 * np.pi * turns, 0])
        told.append(controller.step(states, 0.0).control)
    np.testing.assert_allclose(told[1:], [told[0]] * 2, atol=1e-4)


def test_the_reserve_is_kept_in_reverse_and_to_the_right_too() -> None:
    problem = Problem(Team(("unicycle1",), own_limits={"max_reverse_speed": 0.4}), [[0, 0, 0]], [[5, 0]])
    controller = Controller(lambda observations, _: {agent: [-1, -2] for agent in observations}, reserve=0.5)
    controller.begin(problem, problem.start)
    setpoint = controller.step(problem.start, 0.0)
    assert setpoint.control[0] == pytest.approx([-0.2, -np.pi / 4], rel=1e-3)


def test_it_begins_where_robots_are() -> None:
    problem = team("holonomic2d", 3)
    elsewhere = problem.start + np.float32([0.2, 0.1, 0, 0])
    controller = Controller("d4orm-c2f")
    controller.begin(problem, elsewhere)
    said = controller.step(elsewhere, 0.0)
    np.testing.assert_allclose(said.position, elsewhere[:, :2], atol=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "open"}, "mode is 'open'; choose one of nominal, measured"),
        ({"reserve": 1.0}, "reserve"), ({"timeout": 0}, "timeout"), ({"timeout": -1.0}, "timeout"),
        ({"policy": "d4orm-c2"}, "d4orm-c2"), ({"tracker": "no"}, "tracker is 'no'; it must be True or False"),
        ({"lag": -1}, "lag is -1; it must be finite and not negative"), ({"lag": float("nan")}, "lag is nan; it must"),
        ({"lag": "a"}, "lag is 'a'; give one number or one per robot"),
    ],
)  # fmt: skip
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Controller(**arguments)


def test_bad_states_and_lags_are_named() -> None:
    problem = team("holonomic2d", 3)
    controller = Controller("go-to-goal")
    for ask in (lambda: controller.step(problem.start, 0.0), lambda: controller.over, lambda: controller.arrived):
        with pytest.raises(RuntimeError, match="call begin"):
            ask()
    with pytest.raises(ValueError, match=r"states have shape \(2, 4\); expected \(K, n\) = \(3, 4\)"):
        controller.begin(problem, problem.start[:2])
    with pytest.raises(RuntimeError, match=r"call begin\(problem, states\) before step"):
        controller.step(problem.start, 0.0)
    with pytest.raises(ValueError, match=r"one number or one per robot \(3\)"):
        Controller("go-to-goal", lag=[1, 2]).begin(problem, problem.start)


# The observer, in numbers.


@pytest.mark.parametrize("lag", [0.0, 0.15])
@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d"])
def test_a_steady_push_is_found(model: str, lag: float) -> None:
    problem = Problem(Team((model,)), [[0, 0, 0, 0] if model == "holonomic2d" else [0, 0]], [[5, 0]])
    observer, push = DisturbanceObserver(problem, lag), np.array([0.2, -0.1])
    y, applied, dt, state = np.zeros(2), np.zeros(2), problem.dt, problem.start.copy()
    for step in range(60):
        observer.observe(state, np.array([True]))
        control = np.float32([[0.3 * np.sin(step), 0.1 * np.cos(step)]])
        sent = observer.compensated(control, np.array([False]))[0]
        remains = np.exp(-dt / lag) if lag else 0.0
        mean = sent + (applied - sent) * (lag / dt) * (1 - remains)
        applied = sent + (applied - sent) * remains
        y = y + dt * (mean + push)
        state[0, -2:] = y
    np.testing.assert_allclose(observer.bias[0], push, atol=0.005)
    np.testing.assert_allclose(observer.compensated(control, np.array([False]))[0], control[0] - push, atol=0.005)


def test_the_estimate_leaves_something_to_steer_with() -> None:
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[5, 0]])
    observer, state = DisturbanceObserver(problem), problem.start.copy()
    for step in range(200):
        observer.observe(state, np.array([step % 7 != 0]))
        observer.compensated(np.zeros((1, 2), np.float32), np.array([False]))
        state[0, 2] += 5.0 * problem.dt
    np.testing.assert_allclose(observer.bias, [[MOST, 0]])


def test_a_robot_that_arrives_turning_on_the_spot_comes_to_rest() -> None:
    """It is where its reference is, which does not turn."""
    problem = make_problem("circle", num_robots=4, model="unicycle2", goal_heading=0.5)
    controller, states = Controller("go-to-goal", mode="measured"), problem.start
    controller.begin(problem, states)
    turned = 0.0
    for step in range(200):
        turned = max(turned, np.abs(states[controller.arrived, 4]).max(initial=0.0))
        states = advanced(problem, states, controller.step(states, step * problem.dt).control)
    assert controller.over
    assert turned > 0.1, "else there was nothing to brake"
    np.testing.assert_allclose(states[:, 3:], 0.0, atol=1e-3)


def test_setpoints_have_the_shapes_that_are_promised() -> None:
    problem = team("differential_drive", 3)
    controller = Controller("go-to-goal")
    controller.begin(problem, problem.start)
    said: ControlSetpoint = controller.step(problem.start, 0.0)
    assert said.position.shape == said.velocity.shape == said.acceleration.shape == (3, 2)
    assert said.control.shape == (3, 2)
    assert said.heading.shape == said.arrived.shape == (3,)


def test_a_policy_that_is_named_answers_in_time() -> None:
    for own, deadline in (({}, 0.08), ({"deadline": 0.05}, 0.05)):
        with Controller("d4orm-c2f", timeout=0.1, **own) as controller:
            assert controller.policy.config.deadline == pytest.approx(deadline)
    with Controller("orca", timeout=0.1) as controller:
        assert controller.timeout == 0.1


def test_a_finished_plan_needs_a_controller_without_a_reserve() -> None:
    problem = make_problem("circle", num_robots=2)
    plan = make_planner().solve(problem, seed=0)
    with pytest.raises(ValueError, match="or give a Controller, which holds back some of the limits, reserve=0"):
        Controller(OpenLoop(plan=plan)).begin(problem, problem.start)
    Controller(OpenLoop(plan=plan), reserve=0.0).begin(problem, problem.start)


@pytest.mark.parametrize(
    ("model", "noise", "lag"),
    [
        ("unicycle2", 0.01, 0.0), ("car", 0.01, 0.0), ("car", 0.0, 0.0), ("holonomic2d_jerk", 0.0, 0.0),
        ("holonomic2d", 0.0, 0.5), ("velocity2d", 0.0, 0.4),
    ],
)  # fmt: skip
def test_robots_stay_on_their_reference_and_come_to_rest(model: str, noise: float, lag: float) -> None:
    """Also if their limits are not the reference's; none goes to and fro at its goal."""
    problem, random = make_problem("circle", num_robots=3, model=model, diameter=6.0), np.random.default_rng(0)
    states, applied, late = problem.start.copy(), np.zeros((3, 2), np.float32), []
    remains = np.float32(np.exp(-problem.dt / lag)) if lag else 0
    share = np.float32(lag / problem.dt) * (1 - remains)
    with Controller("hybrid", lag=lag) as controller:
        controller.begin(problem, states, seed=0)
        for step in range(140):
            measured = states + noise * random.standard_normal(states.shape)
            setpoint = controller.step(measured, step * problem.dt)
            states = advanced(problem, states, setpoint.control + share * (applied - setpoint.control))
            applied = setpoint.control + remains * (applied - setpoint.control)
            off = np.linalg.norm(states[:, :2] - setpoint.position, axis=1).max()
            assert off < problem.team.radius.min() * (2 if lag else 0.5)
            late.append(np.abs(setpoint.control).max())
    assert setpoint.arrived.all()
    assert max(late[-20:]) < (0.3 if noise else 0.02)


def lagging(controller: Controller, problem: Problem, lag: Any, steps: int) -> tuple[float, float, Any]:
    """Drive robots whose actuators lag; farthest from a setpoint and least gap in radii, and the last setpoint."""
    states, applied = problem.start.copy(), np.zeros((problem.num_robots, 2), np.float32)
    lags = np.broadcast_to(np.float32(lag), (problem.num_robots,))[:, None]
    remains = np.exp(-problem.dt / np.maximum(lags, 1e-9))
    share, off, gap, radius = lags / problem.dt * (1 - remains), 0.0, np.inf, problem.team.radius[0]
    controller.begin(problem, states)
    for step in range(steps):
        setpoint = controller.step(states, step * problem.dt)
        told = setpoint.control
        states = advanced(problem, states, told + share * (applied - told))
        applied = told + remains * (applied - told)
        off = max(off, np.linalg.norm(states[:, :2] - setpoint.position, axis=1).max())
        gap = min(gap, pdist(states[:, :2]).min() - 2 * radius)
    return off / radius, gap / radius, setpoint


@pytest.mark.parametrize("mode", ["nominal", "measured"])
@pytest.mark.parametrize("model", ["car", "differential_drive", "unicycle2", "holonomic2d"])
def test_robots_whose_actuators_lag_keep_apart_arrive_and_rest(model: str, mode: Any) -> None:
    problem = make_problem("circle", num_robots=6, model=model, horizon=150)
    with Controller("d4orm-c2f", mode=mode, lag=0.2, refine="sync") as controller:
        off, gap, setpoint = lagging(controller, problem, 0.2, 160)
    assert off < 1
    assert gap > 0
    assert setpoint.arrived.all()
    assert np.abs(setpoint.control).max() < 0.02


def test_robots_of_different_lags_follow_one_motion() -> None:
    lags = [0.0, 0.1, 0.3, 0.3]
    with Controller("hybrid", lag=lags) as controller:
        off, gap, setpoint = lagging(controller, make_problem("circle", num_robots=4), lags, 100)
    assert off < 0.2
    assert gap > 0
    assert setpoint.arrived.all()


def test_what_was_learned_of_a_push_is_kept_for_new_goals() -> None:
    problem, push = make_problem("circle", num_robots=2), np.array([0.15, 0.0])

    def pushed(controller: Controller, steps: range) -> float:
        states, off = problem.start.copy(), 0.0
        controller.begin(problem.replace(dt=problem.dt), states, steps[0] * problem.dt)
        for step in steps:
            setpoint = controller.step(states, step * problem.dt)
            states = advanced(problem, states, (setpoint.control + push).astype(np.float32))
            off = max(off, np.linalg.norm(states[:, :2] - setpoint.position, axis=1).max())
        return float(off)

    with Controller("go-to-goal", mode="nominal") as controller:
        first, then, anew = (pushed(controller, steps) for steps in (range(40), range(40, 80), range(40)))
    assert then < 0.2 * first
    assert anew == first


@pytest.mark.parametrize("mode", ["nominal", "measured"])
@pytest.mark.parametrize("model", ["car", "differential_drive", "unicycle", "unicycle2"])
@pytest.mark.parametrize(("turned", "moved"), [(2.0, 0.0), (2.6, 1.0)])
def test_who_is_turned_or_put_aside_by_hand_comes_back_or_stands(
    mode: Any, model: str, turned: float, moved: float
) -> None:
    """Slopes at the reference lead a robot that faces elsewhere away."""
    problem = make_problem("circle", num_robots=1, model=model, diameter=3.0)
    states = problem.start.copy()
    with Controller("go-to-goal", mode=mode) as controller:
        controller.begin(problem, states)
        for step in range(320):
            if step == 120:
                states[0, :3] += [0.0, moved, turned]
            states = advanced(problem, states, controller.step(states, step * problem.dt).control)
    off = np.linalg.norm(states[0, :2] - problem.goal[0])
    assert off < problem.goal_radius + 2 * problem.team.radius[0]
    np.testing.assert_allclose(advanced(problem, states, np.zeros((1, 2), np.float32))[0, :2], states[0, :2], atol=2e-3)


@pytest.mark.parametrize("dt", [0.1, 0.01])
def test_who_is_pushed_comes_back_alike_whatever_the_time_step(dt: float) -> None:
    problem = make_problem("circle", num_robots=1, diameter=3.0, dt=dt, horizon=round(10 / dt))
    states, seen = problem.start.copy(), []
    with Controller("go-to-goal") as controller:
        controller.begin(problem, states)
        for step in range(round(9 / dt)):
            if step == round(5 / dt):
                states[0, :2] += [0.3, 0.0]
            setpoint = controller.step(states, step * dt)
            states = advanced(problem, states, setpoint.control)
            seen.append(float(states[0, 0] - setpoint.position[0, 0]))
    assert min(seen[round(5 / dt) :]) > -0.03
    assert abs(np.array(seen[round(8 / dt) :])).max() < 0.01


def test_the_reference_of_a_robot_that_is_lost_keeps_its_speed() -> None:
    """What a lag explains of a measured state is no part of the reference."""
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[8, 0]], horizon=200)
    states, setpoints = problem.start.copy(), []
    with Controller("go-to-goal", mode="measured", lag=0.2) as controller:
        controller.begin(problem, states)
        for step in range(40):
            setpoints.append(controller.step(states if step < 20 else states * np.nan, step * problem.dt))
            states = advanced(problem, states, setpoints[-1].control)
    passed = np.diff([s.position[0, 0] for s in setpoints[20:]])
    assert passed.max() < 1.1 * problem.dt


def test_a_reference_that_turns_as_fast_as_robots_may_is_followed() -> None:
    """The slopes of the motion are not those of one side of a limit."""
    problem = make_problem("circle", num_robots=1, model="unicycle2")
    states = problem.start.copy()
    with Controller(lambda observations, state: {each: np.float32([0.3, -np.pi]) for each in observations}) as driver:
        driver.begin(problem, states)
        for step in range(30):
            setpoint = driver.step(states, step * problem.dt)
            states = advanced(problem, states, setpoint.control)
            assert abs(states[0, 2] - setpoint.heading[0]) < 0.1


@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_plans_are_followed_in_either_mode(mode: Any) -> None:
    """A plan looks at nothing; robots on their own would miss their goals by what the speed limit takes."""
    problem = make_problem("circle", num_robots=10)
    plan = make_planner().solve(problem, seed=2)
    plant, said = driven(Controller(OpenLoop(plan=plan), mode=mode, reserve=0.0), problem, [ControlNoise(0.1)])
    assert plant.metrics()["success"] == 1
    assert len(said) <= len(plan.controls)
