"""The robots of a fleet: as they were heard, what they are told, where they are sent, and where they run on to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.engine.cpu import CpuEngine
from d4orm_planners.base.disturbance_observer import summed_controls
from d4orm_planners.serve import wire
from d4orm_planners.serve.wire import RosSession
from d4orm_planners.tracking import ros_messages as ros
from d4orm_planners.tracking.tracker import follow_reference

BASE = 0.5  #: Share of a period over which velocities are taken from poses
NEAR = 0.5  #: Share of the margin that robots keep when they run on
CREEPING = 0.125  #: Least pace of robots that are slowed down


@dataclass
class FleetRobot:
    """A robot as it was last heard."""

    name: str  #: Name of its topics
    state: FloatArray  #: ``(n,)`` as last heard; not a number before, and what no message says
    heard: float = -np.inf  #: When it was last heard, by this process's clock [s]
    measured: float = -np.inf  #: When that was, likewise; as it was heard, if no stamps tell [s]
    heading: float = 0.0  #: As last heard [rad]
    yaw: float = 0.0  #: As first heard, which a robot whose model has no heading keeps [rad]
    stand: Floats | None = None  #: ``(d,)`` where it is held, or braking to a halt, while the team does not drive [m]
    #: ``(3,)`` by the last two poses that are far enough apart, in the frame of all [m/s]
    velocity: Floats = field(default_factory=lambda: np.zeros(3))
    #: Time by the robot's clock and by this process's [s], and ``(3,)`` position of the later one [m]
    posed: tuple[float, float, Floats] | None = None
    clock_resets: int = 0  #: Times that its clock was set back, or forward beyond the deadline

    def take_state(self, state: FloatArray, heading: float, now: float, age: float) -> None:
        """Take a state ``(n,)`` and a heading [rad], measured ``age`` seconds ago."""
        self.yaw = self.yaw if np.isfinite(self.heard) else heading
        self.state, self.heading, self.heard, self.measured = state, heading, now, now - age

    def take_pose(self, stamped: Any, now: float, period: float, deadline: float) -> None:
        """Take the velocity from a ``geometry_msgs/PoseStamped`` and one that is older by half a period [s] at least.

        Where the robot's clock was set in between it stays as it is.
        """
        stamp, position = wire.time_of(stamped.header), wire.position_of(stamped.pose.position)
        if self.posed is not None:
            passed, waited = stamp - self.posed[0], now - self.posed[1]
            if 0 <= passed < BASE * period:
                return
            if 0 < passed <= waited + deadline:
                self.velocity = (position - self.posed[2]) / passed
            else:
                self.clock_resets += 1
        self.posed = stamp, now, position


class FleetCommands:
    """The topics on which a team is told what to do."""

    def __init__(self, session: RosSession, problem: Problem, robots: Sequence[FleetRobot]) -> None:
        self._robots, self._team, self._still = robots, problem.team, np.zeros(problem.dimension)
        self._twists = [session.publisher(f"{robot.name}/cmd_vel", wire.TWIST) for robot in robots]
        self._setpoints = [session.publisher(f"{robot.name}/setpoint", wire.TRAJECTORY) for robot in robots]
        self.told: Floats = np.zeros((len(robots), 4))  #: Twists ``(K, 4)`` as told last [m/s, rad/s]

    def move(self, headings: Floats, twists: Floats, *points: Floats) -> None:
        """Tell twists ``(K, 4)``, and positions, velocities and accelerations ``(K, d)`` with the headings ``(K,)``."""
        self._tell(twists)
        for robot, setpoint, *point in zip(self._robots, self._setpoints, *points, self._facing(headings)):
            setpoint.publish(wire.full_state(robot.name, *point))

    def stand(self) -> None:
        """Hold all robots where they were when they were stopped."""
        self._tell(np.zeros_like(self.told))
        facing = self._facing(np.array([robot.heading for robot in self._robots]))
        for robot, setpoint, heading in zip(self._robots, self._setpoints, facing):
            if robot.stand is None and np.isfinite(robot.heard):
                robot.stand = robot.state[: self._team.dimension].astype(np.float64)
            if robot.stand is not None:
                setpoint.publish(wire.full_state(robot.name, robot.stand, self._still, self._still, heading))

    def _tell(self, twists: Floats) -> None:
        self.told = twists
        for publisher, row in zip(self._twists, twists):
            publisher.publish(ros.twist(row[:3], float(row[3])))

    def _facing(self, headings: Floats) -> list[float]:
        """Headings of robots whose model has one, and the yaw of the others."""
        models = zip(self._team.robot_models, headings, self._robots)
        return [robot.yaw if model.heading_index is None else float(own) for model, own, robot in models]


class WantedGoals:
    """Goals of robots called ``names``, from when they are heard for ``patience`` [s] at most.

    Those of the last moments are taken together, as two robots may change places, or else one by one.
    """

    def __init__(self, names: tuple[str, ...], patience: float) -> None:
        self._names, self._patience = names, patience
        self._wanted: dict[int, tuple[Floats, float]] = {}  # and when they were heard
        self.refusal = ""  #: Why one was refused last

    def hear(self, number: int, goal: Floats, now: float) -> None:
        self._wanted[number] = goal, now

    def taken(self, problem: Problem, now: float) -> Problem:
        """The problem with what robots can have of it; itself where that changes nothing."""
        self._wanted = {number: goal for number, goal in self._wanted.items() if now - goal[1] <= self._patience}
        together = self._given(problem, list(self._wanted))
        if together is not None:
            return together
        for number in list(self._wanted):
            problem = self._given(problem, [number]) or problem
        return problem

    def _given(self, problem: Problem, numbers: list[int]) -> Problem | None:
        """The problem with the goals that some robots want; ``None`` if they cannot have them."""
        goals = problem.goal.copy()
        for number in numbers:
            goals[number] = self._wanted[number][0]
        if not np.array_equal(goals, problem.goal):
            try:
                problem = problem.replace(goal=goals)
            except ValueError as error:
                self.refusal = f"goal of {', '.join(self._names[number] for number in numbers)}: {error}"
                return None
        for number in numbers:
            del self._wanted[number]
        return problem


class RunningOn:
    """Foresight of where a team runs on to, at the speeds and turn rates that it was told, for so many ``seconds``."""

    def __init__(self, problem: Problem, seconds: float) -> None:
        self._problem, self._engine = problem, CpuEngine()
        self._steps = math.ceil(seconds / problem.dt)
        self._keeps_speed = ~summed_controls(problem).any(axis=1)
        self._braking = math.ceil(float((problem.team.max_speed / problem.team.max_acceleration).max()) / problem.dt)

    def meets_something(self, states: FloatArray, controls: FloatArray) -> bool:
        """Check whether robots in ``states`` ``(K, n)`` that are told ``controls`` ``(K, m)``, and then nothing, come
        nearer than :data:`NEAR`, or touch if they are nearer now, before they have come to rest.
        """
        problem, held = self._problem, np.repeat(controls[None], self._steps, axis=0)
        held[1:] *= self._keeps_speed
        end = self._engine.move(problem.arrays, states, np.zeros(len(states), bool), held)[-1]
        at_rest = np.zeros((self._braking, *problem.goal.shape), np.float32)
        told = np.concatenate([held, follow_reference(problem, end, at_rest, at_rest, 0.0)])
        nearer = {"margin": NEAR * problem.margin, "goal_radius": problem.rounding}
        seen = self._engine.rollout(problem.with_state(states, problem.goal, horizon=len(told), **nearer), told)
        near = seen.margin_violated[1:] & ~seen.margin_violated[0]
        return bool((near | (seen.collided[1:] & ~seen.collided[0])).any())


def slowed(twists: Floats, before: Floats, share: float) -> Floats:
    """``(K, 1)`` paces at which speeds of ``twists`` ``(K, 4)`` are lower by a share than those ``before``.

    Some pace is left, so that robots get away from where they stand.
    """
    now, then = (np.linalg.norm(rows[:, :3], axis=1) for rows in (twists, before))
    return np.clip((1 - share) * then / np.maximum(now, np.finfo(float).tiny), CREEPING, 1.0)[:, None]
