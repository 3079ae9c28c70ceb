"""States, goals and commands of a team, from and to ROS 2 messages."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_planners.serve.wire import messages

FRAME = "map"


def heading_of(orientation: Any) -> float:
    """The heading of a quaternion [rad]."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def state_from(problem: Problem, robot: int, pose: Any, velocity: Floats) -> FloatArray:
    """``(n,)`` the state of a robot, from its ``geometry_msgs/Pose`` and its velocity ``(3,)`` in its own frame."""
    model, d, heading = problem.team.robot_models[robot], problem.dimension, heading_of(pose.orientation)
    state: FloatArray = np.zeros(problem.state_size, np.float32)
    state[:d] = place_of(pose.position)[:d]
    if model.heading_index is not None:
        state[model.heading_index] = heading
        state[list(model.speed_indices)] = velocity[0]
    elif model.speed_indices:
        state[list(model.speed_indices)] = turned(velocity, heading)[:d]
    return state


def place_of(point: Any) -> Floats:
    """``(3,)`` of a ``geometry_msgs/Point`` or ``Vector3``."""
    return np.array([point.x, point.y, point.z])


def time_of(header: Any) -> float:
    """Time of a ``std_msgs/Header`` [s]."""
    seconds: float = header.stamp.sec + 1e-9 * header.stamp.nanosec
    return seconds


def turned(vector: Floats, angle: float) -> Floats:
    """A vector ``(3,)`` turned about the vertical."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1], vector[2]])


def twist(problem: Problem, robot: int, state: FloatArray, control: FloatArray, heading: float) -> Any:
    """The ``geometry_msgs/Twist`` of a control: the velocity that it leads to in a step, in the robot's own frame.

    Args:
        problem: The team.
        robot: Its number.
        state: ``(n,)`` where it is.
        control: ``(m,)``.
        heading: Of a robot whose model has none [rad].
    """
    model, limits = problem.team.robot_models[robot], tuple(problem.team.limits[robot])
    x, u = tuple(state[: model.state_size]), tuple(control[: model.control_size])
    functions, step = model.functions, TimeStep(*problem.arrays.time_step)
    after = functions.limit_state(functions.integrate(x, u, limits, step, NUMPY_OPS), limits, NUMPY_OPS)
    velocity = np.array([*map(float, functions.velocity(after, u, limits, NUMPY_OPS)), 0.0])[:3]
    turn_rate = 0.0
    if model.heading_index is not None:
        turn_rate = (float(after[model.heading_index]) - float(state[model.heading_index])) / problem.dt
        heading = float(after[model.heading_index])
    message = messages.Twist()
    message.linear.x, message.linear.y, message.linear.z = map(float, turned(velocity, -heading))
    message.angular.z = turn_rate
    return message


def full_state(name: str, position: Floats, velocity: Floats, acceleration: Floats, heading: float) -> Any:
    """A ``trajectory_msgs/MultiDOFJointTrajectory`` of one point: where a robot is to be, ``(d,)`` each."""
    vectors = [messages.Vector3(*map(float, [*part, 0.0][:3])) for part in (position, velocity, acceleration)]
    point = messages.MultiDOFJointTrajectoryPoint(
        transforms=[messages.Transform(vectors[0], quaternion(heading))],
        velocities=[messages.Twist(linear=vectors[1])],
        accelerations=[messages.Twist(linear=vectors[2])],
    )
    return messages.MultiDOFJointTrajectory(header(), [name], [point])


def quaternion(heading: float) -> Any:
    """The ``geometry_msgs/Quaternion`` of a heading."""
    return messages.Quaternion(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def header() -> Any:
    """A ``std_msgs/Header`` of now."""
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    return messages.RosHeader(messages.Time(seconds, nanoseconds), FRAME)


def diagnostics(node: str, level: int, state: str, values: dict[str, str]) -> Any:
    """A ``diagnostic_msgs/DiagnosticArray`` with one state."""
    pairs = [messages.KeyValue(key, value) for key, value in values.items()]
    return messages.DiagnosticArray(header(), [messages.DiagnosticStatus(level, node, state, node, pairs)])
