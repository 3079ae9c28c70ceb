"""Motions as ROS 2 messages in a bag, written without ROS: a path and a trajectory of every robot.

``/robot_0/path`` has one ``nav_msgs/Path`` and ``/robot_0/trajectory`` one
``trajectory_msgs/MultiDOFJointTrajectory``, both in frame ``map``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from d4orm_env.core.lazy import LazyModule
from d4orm_planners.tracking import ros_messages as ros
from d4orm_planners.tracking.setpoints import Setpoints

rosbag2: Any = LazyModule("rosbags.rosbag2", "a ROS bag", "ros")

BAG_VERSION: Final = 9


def path(setpoints: Setpoints, robot: int, height: float) -> Any:
    """The ``nav_msgs/Path`` of a robot, with the times as stamps."""
    rows = zip(setpoints.time, setpoints.position[:, robot], setpoints.heading[:, robot], strict=True)
    poses = [
        ros.make("geometry_msgs/msg/PoseStamped", ros.header(_nanoseconds(time)), ros.pose(place, heading, height))
        for time, place, heading in rows
    ]
    return ros.make("nav_msgs/msg/Path", ros.header(0), poses)


def trajectory(setpoints: Setpoints, robot: int, height: float) -> Any:
    """The ``trajectory_msgs/MultiDOFJointTrajectory`` of a robot."""
    heading, motion = setpoints.heading[:, robot], (setpoints.position, setpoints.velocity, setpoints.acceleration)
    rows = zip(*(part[:, robot] for part in motion), heading, np.gradient(heading, setpoints.time), strict=True)
    points = [
        ros.trajectory_point(*row, turn_rate=rate, nanoseconds=_nanoseconds(time), height=height)
        for time, (*row, rate) in zip(setpoints.time, rows, strict=True)
    ]
    return ros.trajectory(f"robot_{robot}", points, 0)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def write_bag(setpoints: Setpoints, folder: Path, height: float, storage: str) -> None:
    """Write a new folder with the bag, stored as ``"SQLITE3"`` or ``"MCAP"``.

    Raises:
        ModuleNotFoundError: Without rosbags.
    """
    with rosbag2.Writer(folder, version=BAG_VERSION, storage_plugin=rosbag2.StoragePlugin[storage]) as bag:
        for robot in range(setpoints.heading.shape[1]):
            for topic, message in (
                ("path", path(setpoints, robot, height)),
                ("trajectory", trajectory(setpoints, robot, height)),
            ):
                kind, types = message.__msgtype__, ros.message_types()
                connection = bag.add_connection(f"/robot_{robot}/{topic}", kind, typestore=types)
                bag.write(connection, 0, types.serialize_cdr(message, kind))
