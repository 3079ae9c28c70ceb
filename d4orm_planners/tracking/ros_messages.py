"""Messages of ROS 2 Humble and later, made and encoded without ROS, and motions as such messages in a bag.

In a bag, ``/robot_0/path`` has one ``nav_msgs/Path`` and ``/robot_0/trajectory`` one
``trajectory_msgs/MultiDOFJointTrajectory``, both in frame ``map``.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.lazy import LazyModule

if TYPE_CHECKING:
    from d4orm_planners.tracking.export import Setpoints

rosbag2: Any = LazyModule("rosbags.rosbag2", "a ROS bag", "ros")
typesys: Any = LazyModule("rosbags.typesys", "a ROS message", "ros")

FRAME = "map"
BAG_VERSION: Final = 9


@cache
def message_types() -> Any:
    """The types of messages, with their encoding; ImportError without rosbags."""
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def make(kind: str, *values: Any) -> Any:
    """A message of a type, such as ``"geometry_msgs/msg/Twist"``, with values for all its fields."""
    return message_types().types[kind](*values)


def header(nanoseconds: int) -> Any:
    """A ``std_msgs/Header`` of this time, in the frame of all."""
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(nanoseconds, 10**9)), FRAME)


def xyz(values: Floats, kind: str = "Vector3", height: float = 0.0) -> Any:
    """A ``geometry_msgs/Vector3``, or ``Point``, of ``(d,)`` numbers; ``height`` is the third of two."""
    x, y, *z = map(float, values)
    return make(f"geometry_msgs/msg/{kind}", x, y, z[0] if z else height)


def quaternion(heading: float) -> Any:
    """The ``geometry_msgs/Quaternion`` of a heading."""
    return make("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def twist(linear: Floats, turning: float = 0.0) -> Any:
    """A ``geometry_msgs/Twist`` of a velocity ``(d,)`` [m/s], or acceleration, and a turn rate [rad/s]."""
    return make("geometry_msgs/msg/Twist", xyz(linear), xyz(np.array([0.0, 0.0, turning])))


def pose(position: Floats, heading: float, height: float = 0.0) -> Any:
    """A ``geometry_msgs/Pose``."""
    return make("geometry_msgs/msg/Pose", xyz(position, "Point", height), quaternion(heading))


def trajectory_point(
    position: Floats, velocity: Floats, acceleration: Floats, heading: float,
    *, turn_rate: float = 0.0, nanoseconds: int = 0, height: float = 0.0,
) -> Any:  # fmt: skip
    """A ``trajectory_msgs/MultiDOFJointTrajectoryPoint`` of a robot: where it is to be, ``(d,)`` each, and when."""
    transform = make("geometry_msgs/msg/Transform", xyz(position, height=height), quaternion(heading))
    after = make("builtin_interfaces/msg/Duration", *divmod(nanoseconds, 10**9))
    motion = [twist(velocity, turn_rate)], [twist(acceleration)]
    return make("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint", [transform], *motion, after)


def trajectory(name: str, points: list[Any], nanoseconds: int) -> Any:
    """A ``trajectory_msgs/MultiDOFJointTrajectory`` of a robot, begun at this time."""
    return make("trajectory_msgs/msg/MultiDOFJointTrajectory", header(nanoseconds), [name], points)


def path_of(setpoints: Setpoints, robot: int, height: float) -> Any:
    """The ``nav_msgs/Path`` of a robot, with the times as stamps."""
    rows = zip(setpoints.time, setpoints.position[:, robot], setpoints.heading[:, robot], strict=True)
    poses = [
        make("geometry_msgs/msg/PoseStamped", header(_nanoseconds(time)), pose(position, heading, height))
        for time, position, heading in rows
    ]
    return make("nav_msgs/msg/Path", header(0), poses)


def trajectory_of(setpoints: Setpoints, robot: int, height: float) -> Any:
    """The ``trajectory_msgs/MultiDOFJointTrajectory`` of a robot."""
    heading, motion = setpoints.heading[:, robot], (setpoints.position, setpoints.velocity, setpoints.acceleration)
    rows = zip(*(part[:, robot] for part in motion), heading, np.gradient(heading, setpoints.time), strict=True)
    points = [
        trajectory_point(*row, turn_rate=rate, nanoseconds=_nanoseconds(time), height=height)
        for time, (*row, rate) in zip(setpoints.time, rows, strict=True)
    ]
    return trajectory(f"robot_{robot}", points, 0)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def write_bag(setpoints: Setpoints, folder: Path, height: float, storage: str) -> None:
    """Write a new folder with the bag, stored as ``"SQLITE3"`` or ``"MCAP"``; ModuleNotFoundError without rosbags."""
    with rosbag2.Writer(folder, version=BAG_VERSION, storage_plugin=rosbag2.StoragePlugin[storage]) as bag:
        for robot in range(setpoints.heading.shape[1]):
            for topic, message in (
                ("path", path_of(setpoints, robot, height)),
                ("trajectory", trajectory_of(setpoints, robot, height)),
            ):
                kind, types = message.__msgtype__, message_types()
                connection = bag.add_connection(f"/robot_{robot}/{topic}", kind, typestore=types)
                bag.write(connection, 0, types.serialize_cdr(message, kind))
