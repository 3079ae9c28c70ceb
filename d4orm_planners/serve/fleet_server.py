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
from d4orm_planners.serve.fleet import FleetCommands, FleetRobot, RunningOn, WantedGoals, slowed
from d4orm_planners.serve.wire import RosSession, Subscriber, position_of, turned
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
            than the deadline, or from as far ahead, are not taken. Else they are of the moment in which they are read.
        watchdog: Silence after which each robot stops by itself [s], by default the deadline. All are slowed down where
            they would come near to anything if they heard nothing more.
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
        watchdog: float | None = None,
    ) -> None:
        if len(names) != problem.num_robots:
            raise ValueError(f"there are {len(names)} names for {problem.num_robots} robots; give one for each")
        if len(set(names)) < len(names):
            raise ValueError(f"robots are called {', '.join(names)}; give each a name of its own")
        self.deadline = positive_number(deadline, "deadline", least=problem.dt)
        self._problem, self._controller, self._seed, self._stamped = problem, controller, seed, stamped
        least = 2 * problem.dt
        longest = max(deadline, least) if watchdog is None else watchdog
        self._watchdog = positive_number(longest, "watchdog", least=least)
        self._running_on = RunningOn(problem, self._watchdog)
        self._robots = [FleetRobot(name, np.full(problem.state_size, np.nan, np.float32)) for name in names]
        self._odometry = [session.subscriber(f"{name}/odom", wire.ODOMETRY) for name in names]
        self._poses = [session.subscriber(f"{name}/pose", wire.POSE) for name in names]
        self._goals = [session.subscriber(f"{name}/goal", wire.POSE) for name in names]
        self.wanted = WantedGoals(names, self.deadline)  #: Goals that robots are sent to
        self._unusable = 0
        self._commands = FleetCommands(session, problem, self._robots)
        self._diagnostics = session.publisher("diagnostics", wire.DIAGNOSTICS)
        self._planner = ThreadPoolExecutor(1, thread_name_prefix="serve")
        self._begun: Future[None] | None = None
        self._period: Period | None = None
        self._pace = self._passed = 1.0  # pace while braking, and share of the period that is over
        self._emergency, self._replan, self._stops, self._heeded, self._stopped = False, False, 0, 0, -np.inf
        self._commanding = threading.RLock()
        self._e_stop = session.subscriber("e_stop", wire.BOOL, self._mind)
        self._inputs = *self._odometry, *self._poses, *self._goals, self._e_stop
        # What it does, when it told so and when it last looked, and times of the last periods' work [s].
        self.state, self._told, self._looked, self.loops = WAITING, -np.inf, np.inf, [0.0]
        self._clock = -np.inf  # as the controller is told

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
        elapsed, self._looked = now - self._looked, now
        if elapsed > self._watchdog and self.state in (DRIVING, BRAKING):
            self._lose_all()
        self._read(now)
        before, self.state = self.state, self._next_state(now)
        if self.state == DRIVING:
            self._drive(now)
            # The horizon is over, and a robot has not arrived.
            self._replan |= self._controller.over and not self._controller.arrived.all()
        elif self.state == BRAKING:
            self._brake(now, max(elapsed / self._problem.dt - 1.0, 0.0))
        else:
            self._stand()
        if self.state != before or now - self._told >= TELL:
            self._told = now
            self._diagnostics.publish(self._diagnosis(now))

    def _next_state(self, now: float) -> str:
        stops, self._heeded = self._stops - self._heeded, self._stops
        if self._emergency or stops or self._silent(now):  # a stop counts that was called off within the period, too
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
            self._replan, self._period = False, None
            states = np.stack([robot.state for robot in self._robots])
            self._begun = self._planner.submit(self._begin, self._problem, states, max(now, self._clock))
        return DRIVING if self._begun is None else PLANNING

    def _begin(self, problem: Problem, states: FloatArray, now: float) -> None:
        self._controller.begin(problem, states, now, self._seed)
        # Load, or compile, what it needs.
        self._running_on.meets_something(problem.start, np.zeros_like(problem.team.control_limits))

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
                self.wanted.hear(number, position_of(message.pose.position)[: self._problem.dimension], now)
        before, self._problem = self._problem, self.wanted.taken(self._problem, now)
        self._replan |= self._problem is not before
        self._mind(self._e_stop)

    def _mind(self, e_stop: Subscriber) -> None:
        """Stop all robots at once on an emergency stop, whatever the loop is doing."""
        with self._commanding:
            unreadable = e_stop.refused
            orders = [bool(message.data) for message in e_stop.take()]
            for order in orders + (e_stop.refused > unreadable) * [True]:  # what cannot be read is one
                self._emergency = order
                if order:
                    self._replan, self._pace, self._stops = True, 0.0, self._stops + 1
                    self._stand()

    def _hear(self, number: int, pose: Any, now: float, header: Any, velocity: Floats, rate: float = np.nan) -> None:
        age = time.time() - wire.time_of(header) if self._stamped else 0.0
        state, heading = wire.state_from(self._problem, number, pose, velocity, rate), wire.heading_of(pose.orientation)
        if np.isfinite(heading) and np.isfinite(state[: self._problem.dimension]).all() and abs(age) <= self.deadline:
            self._robots[number].take_state(state, heading, now, max(age, 0.0))
        else:
            self._unusable += 1

    def _lose_all(self) -> None:
        """Stop, as this process has been silent itself: robots have stopped, and what has come is from before that."""
        self._stand()
        for topic in (*self._odometry, *self._poses):
            topic.take()
        for robot in self._robots:
            robot.heard = -np.inf

    def _silent(self, now: float) -> list[str]:
        return [robot.name for robot in self._robots if now - robot.heard > self.deadline]

    def _still_stops(self, now: float) -> bool:
        """Return whether a robot that was stopped, maybe at full speed, is not at rest yet."""
        team = self._problem.team
        speeds = [robot.state[list(model.speed_indices)] for robot, model in zip(self._robots, team.robot_models)]
        fast = [np.linalg.norm(np.nan_to_num(own, nan=np.inf)) for own in speeds] > AT_REST * team.max_speed
        return bool((fast & (now - self._stopped < team.max_speed / team.max_acceleration)).any())

    def _next_period(self, states: FloatArray, now: float, before: Period | None) -> Period:
        self._clock = max(now, self._clock + self._problem.dt)  # another period, whenever it is asked for
        ages = [min(now - robot.measured, OLDEST * self._problem.dt) for robot in self._robots]
        setpoint = self._controller.step(states, self._clock, ages)
        lags = self._controller.lag * np.isfinite(states[:, 0])  # a reference has none
        headings = [robot.heading for robot in self._robots]
        rows = zip(self._controller.states, setpoint.control, headings, self._commands.told, lags)
        twists = [wire.twist(self._problem, number, *row) for number, row in enumerate(rows)]
        begin = setpoint if before is None else before.setpoint
        return Period(begin.position, setpoint, np.array(twists))

    def _drive(self, now: float) -> None:
        missing = [now - robot.heard > 2 * self._problem.dt for robot in self._robots]  # for the last two periods
        states = np.where(np.array(missing)[:, None], np.float32(np.nan), [robot.state for robot in self._robots])
        stops, period = self._stops, self._next_period(states, now, self._period)
        begin, setpoint, twists = period
        pace = self._safe_paces(period)
        position, velocity = begin + pace * (setpoint.position - begin), pace * setpoint.velocity
        acceleration = setpoint.acceleration + (pace - 1) / self._problem.dt * setpoint.velocity
        with self._commanding:
            if self._emergency or self._stops != stops:  # it came while these were thought out
                return
            self._period, self._pace, self._passed = period, 1.0, 1.0
            for robot in self._robots:
                robot.stand = None
            self._commands.move(setpoint.heading, pace * twists, position, velocity, acceleration)

    def _safe_paces(self, period: Period) -> Floats:
        """``(K, 1)`` paces of a period: lower where robots that heard nothing more would come near to things."""
        _, setpoint, twists = period
        if not self._running_on.meets_something(self._controller.states, setpoint.control):
            return np.ones((len(twists), 1))
        return slowed(
            twists, self._commands.told, braking_share(self._problem, setpoint.velocity, setpoint.acceleration)
        )

    def _brake(self, now: float, late: float) -> None:
        """Slow all robots down on the controller's reference, by the same share.

        They have gone on for so many periods too ``late``.
        """
        period, before, dt, stops = self._period, self._pace, self._problem.dt, self._stops
        assert period is not None  # braking comes after driving
        blind, passed = np.full_like(self._controller.states, np.nan), self._passed + before * late
        while passed > 1.0:
            period, passed = self._next_period(blind, now, period), passed - 1.0
        pace = max(before - braking_share(self._problem, period.setpoint.velocity, period.setpoint.acceleration), 0.0)
        twists, passed = min(pace, 1.0 - passed) * period.twists, passed + pace
        if passed >= 1.0:
            period, passed = self._next_period(blind, now, period), passed - 1.0
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
            self._commands.move(setpoint.heading, twists, position, pace * setpoint.velocity, acceleration)

    def _stand(self) -> None:
        with self._commanding:
            self._commands.stand()

    def _diagnosis(self, now: float) -> Any:
        silent, refused = self._silent(now), self._unusable + sum(topic.refused for topic in self._inputs)
        values = {
            "silent": ", ".join(silent),
            "arrived": str(int(self._controller.arrived.sum())) if self.state == DRIVING else "",
            "longest loop [ms]": f"{1000 * max(self.loops):.1f}",
            "unreadable messages": str(refused),
            "clocks set": ", ".join(robot.name for robot in self._robots if robot.clock_resets),
            "refused": self.wanted.refusal,
        }
        return wire.diagnostics(NODE, LEVELS[self.state], self.state, values)
