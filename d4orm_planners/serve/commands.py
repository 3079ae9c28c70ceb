"""Commands of a fleet: speeds and turn rates, and setpoints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.problem import Problem
from d4orm_planners.serve import wire
from d4orm_planners.serve.wire import FleetRobot, RosSession
from d4orm_planners.tracking import ros_messages as ros


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
