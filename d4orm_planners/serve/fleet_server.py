"""A team of robots on a ROS 2 network, driven by a controller."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, positive_number
from d4orm_env.core.problem import Problem
from d4orm_planners.base.controller import Controller
from d4orm_planners.base.measured_states import OLDEST
from d4orm_planners.serve import wire
from d4orm_planners.serve.wire import FleetRobot, RosSession, Subscriber, position_of, turned
from d4orm_planners.tracking import ros_messages as ros
from d4orm_planners.tracking.reference_feedback import ControlSetpoint
from d4orm_planners.tracking.steering import braking_share

NODE = "d4orm"
DRIVING, BRAKING, PLANNING, WAITING, STOPPED = "driving", "braking", "planning", "waiting", "stopped"
"""States of the server: robots drive; brake for replanning; rest for planning, a silent robot or an emergency stop."""
LEVELS = {DRIVING: 0, BRAKING: 0, PLANNING: 0, WAITING: 1, STOPPED: 2}  #: Levels of diagnostics: well, warning, error
AT_REST = 0.05  #: Share of its largest speed up to which a robot that was stopped counts as at rest
TELL = 1.0  #: Time between two diagnostics of the same state [s]


class Period(NamedTuple):
    """A period of the controller's reference."""

    begin: Floats  #: ``(K, d)`` where robots are to be when it begins [m]
    setpoint: ControlSetpoint
    twists: Floats  #: ``(K, 4)`` velocity in each robot's frame [m/s] and turn rate [rad/s]


class FleetServer:
    """A controller as a ROS 2 node.

    In: ``/NAME/odom`` (``nav_msgs/Odometry``) or ``/NAME/pose`` (``geometry_msgs/PoseStamped``), ``/NAME/goal``
    (``geometry_msgs/PoseStamped``) and ``/e_stop`` (``std_msgs/Bool``). Out, once a period: ``/NAME/cmd_vel``
    (``geometry_msgs/Twist``) and ``/NAME/setpoint`` (``trajectory_msgs/MultiDOFJointTrajectory`` of one point); and
    ``/diagnostics``.

    Robots move only while all were heard within the deadline, and no emergency stop is in force, which takes effect at
    once. Afterwards the controller begins anew from where the robots are. For a new goal it does so after all have
    braked: they go on along the controller's reference, ever slower, all by the same share, so that they keep apart as
    they would have.

    Args:
        session: The network.
        problem: The team; its starts do not count.
        controller: What drives it.
        names: Of the robots, in the problem's order.
        deadline: Longest silence of a robot [s].
        seed: Of the controller.
        stamped: Whether robots' clocks are this machine's: states are as old as their stamps say then, and those older
            than the deadline are not taken. Else they are of the moment in which they are read.
    """

    def __init__(
        self,
        session: RosSession,
        problem: Problem,
        controller: Controller,
        names: tuple[str, ...],
        deadline: float = 0.5,
        seed: int = 0,
        stamped: bool = False,
    ) -> None:
        if len(names) != problem.num_robots:
            raise ValueError(f"there are {len(names)} names for {problem.num_robots} robots; give one for each")
        if len(set(names)) < len(names):
            raise ValueError(f"robots are called {', '.join(names)}; give each a name of its own")
        self.deadline = positive_number(deadline, "deadline", least=problem.dt)
        self._problem, self._controller, self._seed, self._stamped = problem, controller, seed, stamped
        self._robots = [FleetRobot(name, np.full(problem.state_size, np.nan, np.float32)) for name in names]
        self._odometry = [session.subscriber(f"{name}/odom", wire.ODOMETRY) for name in names]
        self._poses = [session.subscriber(f"{name}/pose", wire.POSE) for name in names]
        self._goals = [session.subscriber(f"{name}/goal", wire.POSE) for name in names]
        self._wanted: dict[int, tuple[Floats, float]] = {}  # goals of robots, and when they were heard
        self._unusable = 0
        self._commands = [session.publisher(f"{name}/cmd_vel", wire.TWIST) for name in names]
        self._setpoints = [session.publisher(f"{name}/setpoint", wire.TRAJECTORY) for name in names]
        self._diagnostics = session.publisher("diagnostics", wire.DIAGNOSTICS)
        self._planner = ThreadPoolExecutor(1, thread_name_prefix="serve")
        self._begun: Future[None] | None = None
        self._period: Period | None = None
        self._pace = self._passed = 1.0  # pace while braking, and share of the period that is over
        self._twists: Floats = np.zeros((len(names), 4))  # as told last
        self._emergency, self._replan, self._stops, self._stopped = False, False, 0, -np.inf
        self._commanding = threading.RLock()
        self._e_stop = session.subscriber("e_stop", wire.BOOL, self._mind)
        self._inputs = *self._odometry, *self._poses, *self._goals, self._e_stop
        # What it does, when it told so, times of the last periods' work [s], and why a goal was refused last.
        self.state, self._told, self.loops, self.refusal = WAITING, -np.inf, [0.0], ""

    def run(self, over: threading.Event) -> None:
        """Serve until ``over`` is set; robots are told to stand then."""
        begin, period = time.monotonic(), 0
        try:
            while not over.is_set():
                now = time.monotonic()
                self.tick(now)
                self.loops = [*self.loops[-99:], time.monotonic() - now]
                period = max(period + 1, int((time.monotonic() - begin) / self._problem.dt))
                over.wait(max(0.0, begin + period * self._problem.dt - time.monotonic()))
        finally:
            self._stand()
            self._planner.shutdown(wait=False, cancel_futures=True)
            self._controller.close()

    def tick(self, now: float) -> None:
        """One period: read what has come, and command every robot."""
        self._read(now)
        before, self.state = self.state, self._next_state(now)
        if self.state == DRIVING:
            self._drive(now)
            # The horizon is over, and a robot has not arrived.
            self._replan |= self._controller.over and not self._controller.arrived.all()
        elif self.state == BRAKING:
            self._brake(now)
        else:
            self._stand()
        if self.state != before or now - self._told >= TELL:
            self._told = now
            self._diagnostics.publish(self._diagnosis(now))

    def _next_state(self, now: float) -> str:
        if self._emergency or self._silent(now):
            self._replan, self._stopped = True, now
            return STOPPED if self._emergency else WAITING
        if self._begun is not None and self._begun.done():
            self._begun.result()
            self._begun = None
            # Meanwhile a robot may have been pushed, and goals may have changed.
            return PLANNING if self._replan else DRIVING
        if self._begun is None and (self._replan or self.state != DRIVING):
            if self.state in (DRIVING, BRAKING) and self._pace > 0:
                return BRAKING
            if self._still_stops(now):
                return PLANNING
            self._replan = False
            states = np.stack([robot.state for robot in self._robots])
            self._begun = self._planner.submit(self._controller.begin, self._problem, states, now, self._seed)
        return DRIVING if self._begun is None else PLANNING

    def _read(self, now: float) -> None:
        for number, robot in enumerate(self._robots):
            for message in self._odometry[number].take():
                told = message.twist.twist
                self._hear(number, message.pose.pose, now, message.header, position_of(told.linear), told.angular.z)
            for message in self._poses[number].take():
                if np.isfinite(position_of(message.pose.position)).all():
                    robot.take_pose(message, now, self._problem.dt, self.deadline)
                    own = turned(robot.velocity, -wire.heading_of(message.pose.orientation))
                    self._hear(number, message.pose, now, message.header, own)
            for message in self._goals[number].take():
                self._wanted[number] = position_of(message.pose.position)[: self._problem.dimension], now
        self._take_goals(now)
        self._mind(self._e_stop)

    def _mind(self, e_stop: Subscriber) -> None:
        """Stop all robots at once on an emergency stop, whatever the loop is doing."""
        with self._commanding:
            for message in e_stop.take():
                self._emergency = bool(message.data)
                if self._emergency:
                    self._replan, self._pace, self._stops = True, 0.0, self._stops + 1
                    self._stand()

    def _hear(self, number: int, pose: Any, now: float, header: Any, velocity: Floats, rate: float = np.nan) -> None:
        age = max(time.time() - wire.time_of(header), 0.0) if self._stamped else 0.0
        state, heading = wire.state_from(self._problem, number, pose, velocity, rate), wire.heading_of(pose.orientation)
        if np.isfinite(heading) and np.isfinite(state[: self._problem.dimension]).all() and age <= self.deadline:
            self._robots[number].take_state(state, heading, now, age)
        else:
            self._unusable += 1

    def _take_goals(self, now: float) -> None:
        """Take the goals of the last moments together, as two robots may change places, or else one by one."""
        self._wanted = {number: goal for number, goal in self._wanted.items() if now - goal[1] <= self.deadline}
        if not self._take_goal(list(self._wanted)):
            for number in list(self._wanted):
                self._take_goal([number])

    def _take_goal(self, numbers: list[int]) -> bool:
        """Give some robots the goals that are wanted; return whether they can have them."""
        goals = self._problem.goal.copy()
        for number in numbers:
            goals[number] = self._wanted[number][0]
        if not np.array_equal(goals, self._problem.goal):
            try:
                self._problem, self._replan = self._problem.replace(goal=goals), True
            except ValueError as error:
                self.refusal = f"goal of {', '.join(self._robots[number].name for number in numbers)}: {error}"
                return False
        for number in numbers:
            del self._wanted[number]
        return True

    def _silent(self, now: float) -> list[str]:
        return [robot.name for robot in self._robots if now - robot.heard > self.deadline]

    def _still_stops(self, now: float) -> bool:
        """Return whether a robot that was stopped, maybe at full speed, is not at rest yet."""
        team = self._problem.team
        speeds = [robot.state[list(model.speed_indices)] for robot, model in zip(self._robots, team.robot_models)]
        fast = [np.linalg.norm(np.nan_to_num(own)) for own in speeds] > AT_REST * team.max_speed
        return bool((fast & (now - self._stopped < team.max_speed / team.max_acceleration)).any())

    def _next_period(self, states: FloatArray, now: float) -> Period:
        ages = [min(now - robot.measured, OLDEST * self._problem.dt) for robot in self._robots]
        setpoint = self._controller.step(states, now, ages)
        lags = self._controller.lag * np.isfinite(states[:, 0])  # a reference has none
        headings = [robot.heading for robot in self._robots]
        rows = zip(self._controller.states, setpoint.control, headings, self._twists, lags)
        twists = [wire.twist(self._problem, number, *row) for number, row in enumerate(rows)]
        begin = setpoint if self._period is None else self._period.setpoint
        return Period(begin.position, setpoint, np.array(twists))

    def _drive(self, now: float) -> None:
        missing = [now - robot.heard > 2 * self._problem.dt for robot in self._robots]  # for the last two periods
        states = np.where(np.array(missing)[:, None], np.float32(np.nan), [robot.state for robot in self._robots])
        stops, period = self._stops, self._next_period(states, now)
        _, setpoint, twists = period
        with self._commanding:
            if self._emergency or self._stops != stops:  # it came while these were thought out
                return
            self._period, self._pace, self._passed = period, 1.0, 1.0
            for robot in self._robots:
                robot.stand = None
            self._command(period, twists, setpoint.position, setpoint.velocity, setpoint.acceleration)

    def _brake(self, now: float) -> None:
        """Slow all robots down on the controller's reference, by the same share."""
        period, before, dt, stops = self._period, self._pace, self._problem.dt, self._stops
        assert period is not None  # braking comes after driving
        pace = max(before - braking_share(self._problem, period.setpoint.velocity, period.setpoint.acceleration), 0.0)
        twists, passed = min(pace, 1.0 - self._passed) * period.twists, self._passed + pace
        if passed >= 1.0:
            period, passed = self._next_period(np.full_like(self._controller.states, np.nan), now), passed - 1.0
            twists = twists + passed * period.twists
        setpoint = period.setpoint
        position = period.begin + passed * (setpoint.position - period.begin)
        acceleration = pace * pace * setpoint.acceleration + (pace - before) / dt * setpoint.velocity
        with self._commanding:
            if self._emergency or self._stops != stops:
                return
            self._period, self._pace, self._passed = period, pace, passed
            for robot, stand in zip(self._robots, position):
                robot.stand = stand
            self._command(period, twists, position, pace * setpoint.velocity, acceleration)

    def _command(self, period: Period, twists: Floats, *points: Floats) -> None:
        """Publish twists ``(K, 4)``, and positions, velocities and accelerations ``(K, d)`` with the headings."""
        self._twists = twists
        rows = zip(self._robots, twists, *points, self._facing(period.setpoint.heading))
        for number, (robot, twist, *point) in enumerate(rows):
            self._commands[number].publish(ros.twist(twist[:3], float(twist[3])))
            self._setpoints[number].publish(wire.full_state(robot.name, *point))

    def _facing(self, headings: Floats) -> list[float]:
        """Headings of robots whose model has one, and the yaw of the others."""
        models = zip(self._problem.team.robot_models, headings, self._robots)
        return [robot.yaw if model.heading_index is None else float(own) for model, own, robot in models]

    def _stand(self) -> None:
        """Hold all robots where they were when they were stopped."""
        still, d = np.zeros(self._problem.dimension), self._problem.dimension
        facing = self._facing(np.array([robot.heading for robot in self._robots]))
        with self._commanding:
            self._twists = np.zeros_like(self._twists)
            for robot, command, setpoint, heading in zip(self._robots, self._commands, self._setpoints, facing):
                command.publish(ros.twist(np.zeros(3)))
                if robot.stand is None and np.isfinite(robot.heard):
                    robot.stand = robot.state[:d].astype(np.float64)
                if robot.stand is not None:
                    setpoint.publish(wire.full_state(robot.name, robot.stand, still, still, heading))

    def _diagnosis(self, now: float) -> Any:
        silent, refused = self._silent(now), self._unusable + sum(topic.refused for topic in self._inputs)
        values = {
            "silent": ", ".join(silent),
            "arrived": str(int(self._controller.arrived.sum())) if self.state == DRIVING else "",
            "longest loop [ms]": f"{1000 * max(self.loops):.1f}",
            "unreadable messages": str(refused),
            "clocks set": ", ".join(robot.name for robot in self._robots if robot.clock_resets),
            "refused": self.refusal,
        }
        return wire.diagnostics(NODE, LEVELS[self.state], self.state, values)
