"""``d4orm serve`` against robots that speak the same bytes: ROS 2 messages by rosbags, over Zenoh."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from env_support import slow
from scipy.spatial.distance import pdist

from d4orm_env import Problem, Team, make_problem
from d4orm_planners import Controller
from d4orm_planners.base.controller import Mode
from d4orm_planners.cli.app import main
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings

zenoh = pytest.importorskip("zenoh")
typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed: pip install 'd4orm-env[ros]'")

from d4orm_planners.serve.fleet import FleetRobot, RunningOn  # noqa: E402
from d4orm_planners.serve.fleet_server import FleetServer  # noqa: E402
from d4orm_planners.serve.wire import (  # noqa: E402
    BOOL,
    ODOMETRY,
    POSE,
    TRAJECTORY,
    TWIST,
    RosSession,
    state_from,
    twist,
)
from d4orm_planners.tracking import ros_messages as ros  # noqa: E402

STORE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
DT, DEADLINE = 0.05, 0.3


def pose_stamped(*position: float) -> Any:
    return ros.make(POSE, ros.header(0), ros.pose(np.array(position or (0.0, 0.0)), 0.0))


def odometry_of(position: np.ndarray, told: Any = None) -> Any:
    told, zeros = ros.twist(np.zeros(3)) if told is None else told, np.zeros(36)
    pose = ros.make("geometry_msgs/msg/PoseWithCovariance", ros.pose(position, 0.0), zeros)
    return ros.make(ODOMETRY, ros.header(0), "", pose, ros.make("geometry_msgs/msg/TwistWithCovariance", told, zeros))


def key(topic: str, ros_type: str) -> str:
    """The key as rmw_zenoh has it, made independently of the package."""
    package, _, name = ros_type.split("/")
    return f"0/{topic}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(ros_type)}"


class Fleet:
    """Robots that do as ``cmd_vel`` says, and tell where they are.

    Each may be off, messages may be lost, and a watchdog stops who has heard nothing for that long [s].
    """

    def __init__(
        self, endpoint: str, start: np.ndarray, loss: float = 0.0, poses: bool = False, watchdog: float = math.inf
    ) -> None:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session, self.position, self.heading = zenoh.open(config), start.copy(), np.array([0.0, 0.7])
        self.velocity, self.on = np.zeros_like(start), [True] * len(start)
        self.heard, self.diagnosis, self.setpoints = [0.0] * len(start), [""], [None] * len(start)
        self.poses, self.loss, self.random, self.moved_at = poses, loss, np.random.default_rng(0), 0.0
        self.watchdog, self.moved, self._moving = watchdog, time.monotonic(), threading.RLock()
        self.told_to_stand = [0.0] * len(start)  # when the server did so, by its stamps; infinite for who is to move
        self._over, self._subscribers = threading.Event(), [
            self.session.declare_subscriber(key("*/cmd_vel", "geometry_msgs/msg/Twist"), self._command),
            self.session.declare_subscriber(
                key("*/setpoint", "trajectory_msgs/msg/MultiDOFJointTrajectory"), self._setpoint
            ),
            self.session.declare_subscriber(key("diagnostics", "diagnostic_msgs/msg/DiagnosticArray"), self._diagnose),
        ]  # fmt: skip
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.session.close()

    def say(self, topic: str, ros_type: str, message: Any) -> None:
        self.session.put(key(topic, ros_type), bytes(STORE.serialize_cdr(message, ros_type)))

    def e_stop(self, wanted: bool) -> None:
        self.say("e_stop", "std_msgs/msg/Bool", STORE.types["std_msgs/msg/Bool"](wanted))

    def goal(self, robot: int, position: list[float]) -> None:
        self.say(f"robot_{robot}/goal", "geometry_msgs/msg/PoseStamped", pose_stamped(*position))

    def _command(self, sample: Any) -> None:
        number, sequence = int(str(sample.key_expr).split("/")[1][-1]), sample.attachment.to_bytes()
        count, stamp, size, _ = struct.unpack("<qqB16s", sequence)
        assert (size, count > 0) == (16, True)
        command = STORE.deserialize_cdr(sample.payload.to_bytes(), "geometry_msgs/msg/Twist")
        cos, sin = math.cos(self.heading[number]), math.sin(self.heading[number])
        x, y = command.linear.x, command.linear.y
        self.told_to_stand[number] = math.inf if x or y else min(self.told_to_stand[number], 1e-9 * stamp)
        if self.random.random() >= self.loss:
            with self._moving:
                self._move()
                self.velocity[number], self.heard[number] = (cos * x - sin * y, sin * x + cos * y), time.monotonic()

    def _move(self) -> None:
        """Robots have moved on up to now, however late this is done, or until their watchdogs stopped them."""
        with self._moving:
            now, stop = time.monotonic(), np.array(self.heard) + self.watchdog
            self.position += np.clip(stop - self.moved, 0, now - self.moved)[:, None] * self.velocity
            self.velocity[now > stop], self.moved = 0, now

    def _setpoint(self, sample: Any) -> None:
        message = STORE.deserialize_cdr(sample.payload.to_bytes(), "trajectory_msgs/msg/MultiDOFJointTrajectory")
        self.setpoints[int(message.joint_names[0][-1])] = message.points[0]

    def _diagnose(self, sample: Any) -> None:
        array = STORE.deserialize_cdr(sample.payload.to_bytes(), "diagnostic_msgs/msg/DiagnosticArray")
        self.diagnosis.append(array.status[0].message)

    def _live(self) -> None:
        odometry, stamped = odometry_of(np.zeros(2)), pose_stamped()
        while not self._over.wait(DT / 5):
            self._move()
            if (np.abs(self.velocity) > 1e-6).any():
                self.moved_at = time.monotonic()
            for robot in np.flatnonzero(self.on).tolist():
                if self.random.random() < self.loss:
                    continue
                pose, speed = odometry.pose.pose, odometry.twist.twist.linear
                pose.position.x, pose.position.y = self.position[robot].tolist()
                half, heading = self.heading[robot] / 2, -self.heading[robot]
                pose.orientation.z, pose.orientation.w = math.sin(half), math.cos(half)
                vx, vy = self.velocity[robot].tolist()
                speed.x = math.cos(heading) * vx - math.sin(heading) * vy
                speed.y = math.sin(heading) * vx + math.cos(heading) * vy
                if self.poses:
                    stamped.header.stamp.sec, stamped.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
                    stamped.pose.position, stamped.pose.orientation = pose.position, pose.orientation
                    self.say(f"robot_{robot}/pose", "geometry_msgs/msg/PoseStamped", stamped)
                else:
                    self.say(f"robot_{robot}/odom", "nav_msgs/msg/Odometry", odometry)


def problem() -> Problem:
    team = Team(("holonomic2d",) * 2, radius=0.1, max_acceleration=2.0)
    return Problem(team, [[0, 0, 0, 0], [0, 1, 0, 0]], [[0.6, 0], [0.6, 1]], dt=DT, horizon=200, goal_radius=0.06)


@contextlib.contextmanager
def served(endpoint: str) -> Iterator[FleetServer]:
    over = threading.Event()
    with RosSession(ZenohSettings(listen=(endpoint,)), 0, "d4orm") as session:
        names = ("robot_0", "robot_1")
        controller = Controller("go-to-goal", mode="measured", timeout=2.0)
        server = FleetServer(session, problem(), controller, names, DEADLINE)
        thread = threading.Thread(target=server.run, args=(over,))
        thread.start()
        try:
            yield server
        finally:
            over.set()
            thread.join()
            time.sleep(0.05)  # for the last commands to get away


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def until(condition: Callable[[], bool], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


@pytest.mark.parametrize("poses", [slow(False), True])
def test_robots_arrive_though_messages_are_lost_and_get_new_goals(endpoint: str, poses: bool) -> None:
    with served(endpoint) as server:
        fleet = Fleet(endpoint, problem().start[:, :2].astype(float), loss=0.2, poses=poses)
        try:
            until(lambda: bool((np.linalg.norm(fleet.position - problem().goal, axis=1) < 0.1).all()))
            fleet.goal(0, [0.3, 0.2])
            fleet.goal(1, [math.nan, 0])
            until(lambda: bool(np.linalg.norm(fleet.position[0] - [0.3, 0.2]) < 0.1))
            assert "goal of robot_1" in server.wanted.refusal
            point = fleet.setpoints[1]
            assert point.transforms[0].translation.x == pytest.approx(fleet.position[1, 0], abs=0.1)
            assert {"driving", "planning"} <= set(fleet.diagnosis)
        finally:
            fleet.close()


def test_emergency_stop_silence_and_restart(endpoint: str) -> None:
    with served(endpoint):
        fleet = Fleet(endpoint, problem().start[:, :2].astype(float))
        until(lambda: bool((fleet.position[:, 0] > 0.1).all()))
        fleet.e_stop(True)
        told = time.monotonic()
        until(lambda: bool((fleet.velocity == 0).all()))
        assert time.monotonic() - told <= 2 * DT + 0.1  # and what a loaded machine takes
        time.sleep(3 * DT)
        assert (fleet.velocity == 0).all()
        until(lambda: fleet.diagnosis[-1] == "stopped")
        fleet.e_stop(False)
        until(lambda: bool((fleet.velocity[:, 0] != 0).all()))
        fleet.on[1] = False
        until(lambda: bool((fleet.velocity == 0).all()))
        until(lambda: fleet.diagnosis[-1] == "waiting")
        fleet.on[1] = True
        until(lambda: bool((fleet.velocity != 0).any()))
    until(lambda: bool((fleet.velocity == 0).all()))  # a server that ends leaves nobody moving
    with served(endpoint):
        try:
            until(lambda: bool((np.linalg.norm(fleet.position - problem().goal, axis=1) < 0.1).all()))
        finally:
            fleet.close()


class Memory:
    """A session without a network: what is sent stays here by topic, and so does what is to be read."""

    def __init__(self) -> None:
        self.sent: dict[str, list[Any]] = {}
        self.inbox: dict[str, list[Any]] = {}
        self.heard: dict[str, Any] = {}

    def publisher(self, topic: str, kind: Any) -> Any:
        return SimpleNamespace(publish=self.sent.setdefault(topic, []).append)

    def subscriber(self, topic: str, kind: Any, heard: Any = None) -> Any:
        inbox = self.inbox.setdefault(topic, [])
        subscriber = SimpleNamespace(refused=0, take=lambda: [inbox.pop(0) for _ in range(len(inbox))])
        self.heard[topic] = heard and functools.partial(heard, subscriber)
        return subscriber

    def say(self, topic: str, message: Any) -> None:
        self.inbox[topic].append(message)
        if self.heard[topic]:
            self.heard[topic]()


def test_stamps_tell_how_old_states_are_where_clocks_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    session, ages = Memory(), []
    names = tuple(f"robot_{number}" for number in range(problem().num_robots))
    monkeypatch.setattr(time, "time", lambda: 1000.0)
    with Controller("go-to-goal", mode="measured") as controller:
        step = controller.step
        monkeypatch.setattr(controller, "step", lambda *told: ages.append(told[2]) or step(*told))
        server = FleetServer(session, problem(), controller, names, DEADLINE, stamped=True)  # type: ignore[arg-type]

        def tick(old: float = 0.2) -> None:
            for name, state in zip(names, problem().start, strict=True):
                odometry = odometry_of(state[:2])
                odometry.header.stamp.sec, odometry.header.stamp.nanosec = divmod(round(1e9 * (1000 - old)), 10**9)
                session.say(f"{name}/odom", odometry)
            server.tick(time.monotonic())

        for age in (DEADLINE + 0.01, -DEADLINE - 0.01):
            tick(age)
            assert server.state == "waiting"
        planned(tick, server)
    np.testing.assert_allclose(ages[-1], 0.2, atol=1e-6)


def planned(tick: Callable[[], object], server: FleetServer) -> None:
    """Tick until the robots drive: a thread plans, and kernels may have to be compiled for it."""
    end = time.monotonic() + 600
    while server.state != "driving":
        tick()
        time.sleep(0.01)
        assert time.monotonic() < end


def test_for_a_new_goal_robots_brake_as_they_can_and_stand() -> None:
    session, position, states = Memory(), problem().start[:, :2].astype(float), []
    names = ("robot_0", "robot_1")
    with Controller("go-to-goal", mode="measured") as controller:
        server = FleetServer(session, problem(), controller, names, DEADLINE)  # type: ignore[arg-type]
        commands, end = [session.sent[f"{name}/cmd_vel"] for name in names], time.monotonic() + 600

        def live(until_told: Callable[[], bool]) -> None:
            while not until_told():
                for name, at, told in zip(names, position, commands, strict=True):
                    odometry = odometry_of(at, told[-1] if told else None)
                    session.say(f"{name}/odom", odometry)
                server.tick(DT * len(states))
                states.append(server.state)
                position[:, 0] += [DT * told[-1].linear.x for told in commands]
                position[:, 1] += [DT * told[-1].linear.y for told in commands]
                if server.state == "planning":  # and kernels may have to be compiled for it
                    time.sleep(0.01)
                    assert time.monotonic() < end

        live(lambda: bool(commands[1]) and commands[1][-1].linear.x > 0.4)
        session.say("robot_0/goal", pose_stamped(0.3, 0.2))
        begun = len(states)
        live(lambda: states[-1] == "planning" and len(states) > begun)
    speeds = np.array([command.linear.x for command in commands[1]])
    braking = states.count("braking")
    assert states[begun:][: braking + 1] == ["braking"] * braking + ["planning"]
    # At 2 m/s² a period of 0.05 s takes 0.1 m/s, of a reference that goes on to speed up meanwhile.
    changes = np.diff(speeds[begun - 1 : begun + braking])
    assert 4 <= braking <= 10
    assert speeds[begun + braking - 1] == 0
    assert np.abs(changes).max() <= 2.0 * DT * (1 + 1e-6)
    said = [sent.points[0].transforms[0].translation.x for sent in session.sent["robot_1/setpoint"]]
    assert said[begun - 1] < said[begun] < said[begun + 1] < said[begun + braking - 1]
    assert said[-1] == said[begun + braking - 1]


def test_an_emergency_stop_does_not_wait_for_the_controller() -> None:
    session, thinking, go_on = Memory(), threading.Event(), threading.Event()
    with Controller("go-to-goal", mode="measured") as controller:
        server = FleetServer(session, problem(), controller, ("robot_0", "robot_1"), DEADLINE)  # type: ignore[arg-type]
        command, period = session.sent["robot_0/cmd_vel"], 0

        def tick() -> None:
            nonlocal period
            period += 1
            for number, position in enumerate(problem().start[:, :2].astype(float)):
                session.say(f"robot_{number}/odom", odometry_of(position))
            server.tick(DT * period)

        planned(tick, server)
        step = controller.step

        def slow(*arguments: Any) -> Any:
            thinking.set()
            assert go_on.wait(60)
            return step(*arguments)

        controller.step = slow  # type: ignore[method-assign]
        loop = threading.Thread(target=tick)
        loop.start()
        assert thinking.wait(60)
        session.say("e_stop", ros.make(BOOL, True))
        told = len(command)
        assert command[-1].linear.x == 0
        go_on.set()
        loop.join()
        tick()
        assert {sent.linear.x for sent in command[told:]} == {0}
        assert server.state == "stopped"


@contextlib.contextmanager
def in_memory(
    team_problem: Problem, mode: Mode = "measured", policy: str = "go-to-goal", lag: float = 0.0, **settings: Any
) -> Iterator[tuple[Memory, FleetServer]]:
    session, names = Memory(), [f"robot_{number}" for number in range(team_problem.num_robots)]
    with Controller(policy, mode=mode, lag=lag) as controller:
        yield session, FleetServer(session, team_problem, controller, tuple(names), DEADLINE, **settings)  # type: ignore[arg-type]


class RollingFleet:
    """Robots on wheels that do as ``cmd_vel`` says, without a network; their speed follows with a lag [s]."""

    def __init__(self, session: Memory, server: FleetServer, team_problem: Problem, lag: float = 0.0) -> None:
        self.session, self.server, self.dt = session, server, team_problem.dt
        self.follows, self.speeds = 1 - math.exp(-self.dt / lag) if lag else 1.0, np.zeros(team_problem.num_robots)
        self.poses, self.period = team_problem.start[:, :3].astype(float), 0
        self.commands = [session.sent[f"robot_{number}/cmd_vel"] for number in range(team_problem.num_robots)]

    def tick(self) -> None:
        self.period += 1
        self.report()
        self.server.tick(self.dt * self.period)

    def report(self) -> None:
        for number, (pose, told) in enumerate(zip(self.poses, self.commands, strict=True)):
            turn_rate = told[-1].angular.z if told else 0.0
            odometry = odometry_of(pose[:2], ros.twist(np.array([self.speeds[number], 0, 0]), turn_rate))
            half = pose[2] / 2
            odometry.pose.pose.orientation.z, odometry.pose.pose.orientation.w = np.sin(half), np.cos(half)
            self.session.say(f"robot_{number}/odom", odometry)

    def drive(self) -> None:
        """A period on the last commands, and the next."""
        self.run_on()
        self.tick()

    def run_on(self) -> None:
        for number, (pose, (*_, told)) in enumerate(zip(self.poses, self.commands, strict=True)):
            self.speeds[number] += self.follows * (told.linear.x - self.speeds[number])
            speed, middle = self.speeds[number], pose[2] + told.angular.z * self.dt / 2
            pose += self.dt * np.array([speed * np.cos(middle), speed * np.sin(middle), told.angular.z])


@pytest.mark.parametrize("mode", ["nominal", "measured"])
@pytest.mark.parametrize("model", ["car", "unicycle2", "differential_drive"])
def test_robots_whose_odometry_does_not_say_all_arrive(model: str, mode: Mode) -> None:
    team = Team((model,))
    alone = Problem(team, [[0.0] * team.state_size], [[2.0, 1.5]], horizon=150)
    with in_memory(alone, mode) as (session, server):
        fleet = RollingFleet(session, server, alone)
        planned(fleet.tick, server)
        for _ in range(alone.horizon):
            fleet.drive()
    x, y, _ = fleet.poses[0]
    assert math.hypot(x - 2.0, y - 1.5) < alone.goal_radius + 0.02
    assert abs(fleet.commands[0][-1].linear.x) < 0.05


@pytest.mark.parametrize("mode", ["nominal", "measured"])
def test_robots_that_follow_commands_with_a_lag_do_not_overshoot(mode: Mode) -> None:
    alone = Problem(Team(("differential_drive",)), [[0.0, 0.0, 0.0, 0.0]], [[3.0, 0.0]], horizon=150)
    with in_memory(alone, mode, lag=0.2) as (session, server):
        fleet, farthest = RollingFleet(session, server, alone, lag=0.2), 0.0
        planned(fleet.tick, server)
        for _ in range(120):
            fleet.drive()
            farthest = max(farthest, float(fleet.poses[0, 0]))
    assert 3.0 - alone.goal_radius < farthest < 3.0 + 2 * alone.goal_radius


def test_robots_that_brake_for_new_goals_stay_on_their_ways() -> None:
    """They cross the middle of the circle then, and would meet on the arcs that they are on."""
    crossing = make_problem("circle", num_robots=12, model="differential_drive")
    with in_memory(crossing, policy="d4orm-c2f") as (session, server):
        fleet, gaps, states = RollingFleet(session, server, crossing), [], []
        planned(fleet.tick, server)
        for step in range(60):
            if step == 26:
                for number in (0, 1):
                    session.say(f"robot_{number}/goal", pose_stamped(*map(float, crossing.goal[1 - number])))
            fleet.drive()
            states.append(server.state)
            gaps.append(pdist(fleet.poses[:, :2]).min() - 2 * crossing.team.radius.max())
    assert "braking" in states
    assert min(gaps) > 0


def facing(goal: float) -> Problem:
    """Two robots on wheels that drive at each other, to goals so far from the middle between them [m]."""
    team = Team(("differential_drive",) * 2, radius=0.1, max_acceleration=2.0)
    start = [[-1.5, 0, 0, 0], [1.5, 0, math.pi, 0]]
    return Problem(team, start, [[-goal, 0], [goal, 0]], dt=DT, horizon=200, goal_radius=0.06)


def test_robots_that_brake_are_led_on_from_where_they_are_when_the_loop_is_late() -> None:
    with in_memory(facing(0.3)) as (session, server):
        fleet = RollingFleet(session, server, facing(0.3))
        planned(fleet.tick, server)
        for _ in range(14):
            fleet.drive()
        session.say("robot_0/goal", pose_stamped(-0.4, 0.0))
        fleet.drive()
        for _ in range(3):
            fleet.run_on()
            fleet.period += 1
        assert abs(fleet.speeds).min() > 0.5
        while server.state == "braking":
            fleet.drive()
            point = session.sent["robot_0/setpoint"][-1].points[0].transforms[0].translation
            assert fleet.poses[0, 0] - 1e-3 < point.x < fleet.poses[0, 0] + DT
        assert point.x == pytest.approx(fleet.poses[0, 0], abs=5e-3)


@pytest.mark.parametrize("ahead", [True, False])
def test_robots_that_hear_nothing_more_do_not_meet_before_their_watchdogs_stop_them(
    ahead: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not ahead:
        monkeypatch.setattr(RunningOn, "meets_something", lambda *_: False)
    with in_memory(facing(0.13), watchdog=0.2) as (session, server):
        fleet, gaps = RollingFleet(session, server, facing(0.13)), []
        planned(fleet.tick, server)
        for _ in range(100):
            fleet.drive()
            told = np.array([command[-1].linear.x for command in fleet.commands])
            gaps.append(fleet.poses[1, 0] - fleet.poses[0, 0] - 0.2 * told.sum() - 0.2)
    assert (min(gaps) > 0) == ahead
    np.testing.assert_allclose(fleet.poses[:, 0], [-0.13, 0.13], atol=0.061)


def test_a_loop_that_was_silent_itself_begins_anew_from_what_it_hears_after_that() -> None:
    with in_memory(facing(0.3), watchdog=0.2) as (session, server):
        fleet = RollingFleet(session, server, facing(0.3))
        planned(fleet.tick, server)
        for _ in range(8):
            fleet.drive()
        fleet.report()
        for _ in range(2):
            fleet.period += 5
            server.tick(fleet.dt * fleet.period)
            assert server.state == "waiting"
            assert all(command[-1].linear.x == 0 for command in fleet.commands)
        fleet.speeds[:] = 0.0
        planned(fleet.tick, server)


def test_an_emergency_stop_that_is_called_off_at_once_is_one() -> None:
    with in_memory(facing(0.3)) as (session, server):
        fleet = RollingFleet(session, server, facing(0.3))
        planned(fleet.tick, server)
        for _ in range(8):
            fleet.drive()
        for wanted in (True, True, False):
            session.say("e_stop", ros.make(BOOL, wanted))
        count = len(fleet.commands[0])
        fleet.tick()
        assert server.state == "waiting"
        fleet.tick()
        assert server.state == "planning"
        assert {command.linear.x for command in fleet.commands[0][count:]} == {0}


def test_an_emergency_stop_that_cannot_be_read_is_one() -> None:
    with in_memory(facing(0.3)) as (session, server):
        fleet = RollingFleet(session, server, facing(0.3))
        planned(fleet.tick, server)
        take = server._e_stop.take

        def unreadable() -> list[Any]:
            server._e_stop.refused += 1
            return []

        server._e_stop.take = unreadable
        session.say("e_stop", None)
        server._e_stop.take = lambda: take() and []
        fleet.tick()
        assert server.state == "stopped"
        assert all(command[-1].linear.x == 0 for command in fleet.commands)
        server._e_stop.take = take
        session.say("e_stop", ros.make(BOOL, False))
        planned(fleet.tick, server)


def test_an_emergency_stop_while_commands_are_sent_has_the_last_word() -> None:
    """Whatever the loop is doing, it waits for the commands of one period at most, and nothing moves after it."""
    with in_memory(facing(0.3)) as (session, server):
        fleet = RollingFleet(session, server, facing(0.3))
        planned(fleet.tick, server)
        sending, go_on, stopping = threading.Event(), threading.Event(), threading.Event()
        publisher = server._commands._twists[1]
        publish = publisher.publish

        def held_up(message: Any) -> None:
            sending.set()
            assert go_on.wait(60)
            publish(message)

        def stop() -> None:
            stopping.set()
            session.say("e_stop", ros.make(BOOL, True))

        publisher.publish = held_up
        loop, operator = threading.Thread(target=fleet.tick), threading.Thread(target=stop)
        loop.start()
        assert sending.wait(60)
        operator.start()
        assert stopping.wait(60)
        go_on.set()
        loop.join()
        operator.join()
        assert all(command[-1].linear.x == 0 for command in fleet.commands)
        told = [len(command) for command in fleet.commands]
        for _ in range(3):
            fleet.tick()
        assert all(
            {one.linear.x for one in command[count:]} == {0}
            for command, count in zip(fleet.commands, told, strict=True)
        )


def test_goals_of_one_moment_are_taken_together_and_known_ones_change_nothing() -> None:
    with in_memory(problem()) as (session, server):
        period = 0

        def tick(*goals: tuple[int, float, float]) -> str:
            nonlocal period
            period += 1
            for number, position in enumerate(problem().start[:, :2].astype(float)):
                session.say(f"robot_{number}/odom", odometry_of(position))
            for number, *goal in goals:
                session.say(f"robot_{number}/goal", pose_stamped(*goal))
            server.tick(DT * period)
            return server.state

        planned(tick, server)
        assert tick((0, 0.6, 0.0)) == tick((1, 0.6, 1.0)) == "driving"
        assert tick((0, 0.6, 1.0)) == "driving"
        assert "robot_0" in server.wanted.refusal
        assert tick((1, 0.6, 0.0)) == "braking"
        np.testing.assert_allclose(server._problem.goal, problem().goal[::-1])
        planned(tick, server)
        assert tick((0, math.nan, 0.0), (1, 0.0, 0.5)) == "braking"
        np.testing.assert_allclose(server._problem.goal, np.float32([[0.6, 1.0], [0.0, 0.5]]))


@pytest.mark.parametrize("broken", [(0, 0, 0, 0), (0, 0, 0, 2), (0, 0, math.nan, 1)])
def test_odometry_without_a_heading_is_not_taken(broken: tuple[float, ...]) -> None:
    team = Team(("velocity2d",))
    alone = Problem(team, [[0.0, 0.0]], [[2.0, 1.5]])
    with in_memory(alone) as (session, server):
        odometry = odometry_of(np.array([1e300, 0.0]))
        session.say("robot_0/odom", odometry)
        server.tick(0.0)
        orientation = odometry.pose.pose.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = broken
        session.say("robot_0/odom", odometry)
        server.tick(1.0)
        assert server.state == "waiting"
        told = {pair.key: pair.value for pair in session.sent["diagnostics"][-1].status[0].values}
        assert (told["silent"], told["unreadable messages"]) == ("robot_0", "1")


def test_velocities_are_taken_from_poses() -> None:
    robot, stamped = FleetRobot("a", np.zeros(4, np.float32)), pose_stamped()
    rows = ((0.0, 1.0, 0.0), (0.01, 9.0, 0.0), (0.05, 1.1, 2.0), (0.06, 1.1, 2.0), (0.01, 3.0, 2.0), (0.06, 3.05, 1.0),
            (0.9, 3.1, 1.0), (0.95, 3.2, 2.0))  # fmt: skip
    for number, (stamp, x, velocity) in enumerate(rows):
        stamped.header.stamp.nanosec, stamped.pose.position.x = round(1e9 * stamp), x
        robot.take_pose(stamped, 0.05 * number, 0.04, DEADLINE)
        assert robot.velocity == pytest.approx([velocity, 0, 0])
    assert robot.clock_resets == 2, "set back, and then forward"


def test_types_are_those_of_ros() -> None:
    types = ros.message_types()
    for kind, expected in {
        "std_msgs/msg/Bool": "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
        "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
        TRAJECTORY: "3a18fd095292a65cfde8833c72985a30af981f3ec44494655c6267262b443a4a",
        "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
        "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
        "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    }.items():
        assert f"RIHS01_{expected}" == types.hash_rihs01(kind) == STORE.hash_rihs01(kind)
    content = bytes(types.serialize_cdr(ros.twist(np.array([1.0, 2.0, 3.0]), 0.5), TWIST))
    assert content == b"\x00\x01\x00\x00" + struct.pack("<6d", 1, 2, 3, 0, 0, 0.5)


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "differential_drive", "unicycle", "holonomic3d"])
def test_states_and_velocities_are_in_the_robots_own_frame(model: str) -> None:
    team = Team((model,))
    d = 3 if model == "holonomic3d" else 2
    alone = Problem(team, [[0] * team.state_size], [[3] * d])
    odometry = odometry_of(np.array([1.0, 2.0, 3.0]))
    odometry.pose.pose.orientation.z = odometry.pose.pose.orientation.w = math.sqrt(0.5)
    state = state_from(alone, 0, odometry.pose.pose, np.array([0.4, 0, 0]))
    expected = {
        "holonomic2d": [1, 2, 0, 0.4], "velocity2d": [1, 2], "differential_drive": [1, 2, math.pi / 2, 0.4],
        "unicycle": [1, 2, math.pi / 2], "holonomic3d": [1, 2, 3, 0, 0.4, 0],
    }  # fmt: skip
    np.testing.assert_allclose(sorted(state), sorted(expected[model]), atol=1e-6)
    control = {"velocity2d": [0, 0.4], "unicycle": [0.4, 0], "holonomic3d": [0, 0, 0]}.get(model, [0, 0])
    slower = np.where(state == np.float32(0.4), np.float32(0.3), state)  # as a lag of 0.1 s explains
    for lag, measured in ((0.0, state), (0.1, slower)):
        command = twist(alone, 0, measured, np.float32(control), math.pi / 2, np.array([0.4, 0.0, 0.0, 0.0]), lag)
        assert command == pytest.approx((0.4, 0, 0, 0), abs=1e-6)


def test_a_bridge_gets_plain_names_and_bytes(endpoint: str) -> None:
    with RosSession(ZenohSettings(listen=(endpoint,)), 7, "d4orm", "bridge") as session:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        publisher, subscriber = session.publisher("tb0/cmd_vel", TWIST), session.subscriber("tb0/odom", ODOMETRY)
        heard: list[Any] = []
        with zenoh.open(config) as bridge:
            listening = bridge.declare_subscriber("**", heard.append)
            told, odometry = ros.twist(np.array([0.2, 0.0, 0.0]), 0.5), odometry_of(np.array([1.0, 2.0]))

            def arrives() -> bool:
                publisher.publish(told)
                bridge.put("tb0/odom", bytes(STORE.serialize_cdr(odometry, ODOMETRY)))
                time.sleep(0.01)
                return any(str(one.key_expr) == "tb0/cmd_vel" for one in heard) and bool(subscriber._samples)

            until(arrives)
            listening.undeclare()
            assert not list(bridge.liveliness().get("@ros2_lv/**"))
    said = next(one for one in heard if str(one.key_expr) == "tb0/cmd_vel")
    floats = struct.pack("<6d", 0.2, 0, 0, 0, 0, 0.5)
    assert (said.payload.to_bytes(), said.attachment) == (b"\0\1\0\0" + floats, None), "CDR, little end first"
    assert subscriber.take()[-1].pose.pose.position.y == 2.0


def test_strangers_bytes_are_counted(endpoint: str) -> None:
    with RosSession(ZenohSettings(listen=(endpoint,)), 0, "d4orm") as session:
        subscriber = session.subscriber("e_stop", BOOL)
        fleet = Fleet(endpoint, np.zeros((2, 2)))
        try:
            until(
                lambda: bool(
                    fleet.session.put(key("e_stop", "std_msgs/msg/Bool"), b"")
                    or subscriber.take()
                    or subscriber.refused
                )
            )
        finally:
            fleet.close()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("policy: orca", "field 'problem' is missing"),
        ("problem: {scenario: circle}\nspeed: 2", "unknown field 'speed'"),
        ("problem: {scenario: circle}\nzenoh: {namespace: a}", "zenoh has 'namespace'"),
        ("problem: {scenario: circle}\nwire: dds", "wire 'dds' is unknown; choose one of rmw_zenoh, bridge"),
        ("problem: {scenario: circle}\nwatchdog: 0.1", "watchdog is 0.1; it must be"),
        ("problem: {scenario: circle}\nrobots: [a/b]", "robots is ['a/b']"),
        ("problem: {scenario: circle}\npolicy: nobody", "nobody"),
        ("problem: {scenario: circle}\nrobots: [a, b]", "there are 2 names for 8 robots"),
        ("problem: {scenario: circle, num_robots: 2}\nrobots: [a, a]", "robots are called a, a; give each a name of"),
        ("problem: {scenario: circle}\ncontroller: {mode: wild}", "mode is 'wild'"),
        ("problem: {scenario: circle}\ncontroller: {policy: orca}", "'policy' is in the wrong place; controller takes"),
        (
            "problem: {scenario: circle}\nsettings: {mode: measured}",
            "'mode' is in the wrong place; controller takes lag",
        ),
        ("problem: {scenario: circle}\ncontroller: {lag: [1, 2]}", "lag has shape (2,); give one number or one per"),
    ],
)
def test_bad_files_are_one_line(text: str, complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "serve.yaml").write_text(text)
    with pytest.raises(SystemExit) as ended:
        main(["serve", "--config", str(tmp_path / "serve.yaml")])
    error = capsys.readouterr().err
    assert ended.value.code == 2
    assert complaint in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_a_fleet_is_served_by_another_process() -> None:
    script = Path(__file__).parents[1] / "release" / "soak_serve.py"
    done = subprocess.run([sys.executable, script, "0.2"], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout[done.stdout.index("{") :])["goals"] > 0
