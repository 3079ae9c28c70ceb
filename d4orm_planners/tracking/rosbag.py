"""Motions as ROS 2 messages in a bag, written without ROS: a path and a trajectory of every robot.

``/robot_0/path`` has one ``nav_msgs/Path`` and ``/robot_0/trajectory`` one
``trajectory_msgs/MultiDOFJointTrajectory``, both in frame ``map``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.lazy import LazyModule
from d4orm_planners.tracking.setpoints import Setpoints

rosbag2: Any = LazyModule("rosbags.rosbag2", "a ROS bag", "ros")
typesys: Any = LazyModule("rosbags.typesys", "a ROS bag", "ros")

FRAME = "map"
BAG_VERSION: Final = 9


class Messages:
    """Messages of ROS 2 Humble and later, by their types' names.

    Raises:
        ModuleNotFoundError: Without rosbags.
    """

    def __init__(self) -> None:
        self.store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def _make(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def _header(self, seconds: float) -> Any:
        return self._make("std_msgs/msg/Header", self._time("Time", seconds), FRAME)

    def _time(self, kind: str, seconds: float) -> Any:
        nanoseconds = round(seconds * 1e9)
        return self._make(f"builtin_interfaces/msg/{kind}", nanoseconds // 10**9, nanoseconds % 10**9)

    def _xyz(self, kind: str, values: Floats, height: float = 0.0) -> Any:
        x, y, *z = values.tolist()
        return self._make(f"geometry_msgs/msg/{kind}", x, y, z[0] if z else height)

    def _turned(self, heading: float) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", 0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2))

    def path(self, setpoints: Setpoints, robot: int, height: float) -> Any:
        """The ``nav_msgs/Path`` of a robot, with the times as stamps."""
        poses = []
        rows = zip(setpoints.time, setpoints.position[:, robot], setpoints.heading[:, robot], strict=True)
        for time, place, heading in rows:
            pose = self._make("geometry_msgs/msg/Pose", self._xyz("Point", place, height), self._turned(heading))
            poses.append(self._make("geometry_msgs/msg/PoseStamped", self._header(time), pose))
        return self._make("nav_msgs/msg/Path", self._header(0.0), poses)

    def trajectory(self, setpoints: Setpoints, robot: int, height: float) -> Any:
        """The ``trajectory_msgs/MultiDOFJointTrajectory`` of a robot."""
        rate = np.gradient(setpoints.heading[:, robot], setpoints.time)
        points = []
        for i, time in enumerate(setpoints.time):
            place, heading = setpoints.position[i, robot], setpoints.heading[i, robot]
            pose = self._make("geometry_msgs/msg/Transform", self._xyz("Vector3", place, height), self._turned(heading))
            velocity = self._twist(setpoints.velocity[i, robot], rate[i])
            acceleration = self._twist(setpoints.acceleration[i, robot], 0.0)
            values = ([pose], [velocity], [acceleration], self._time("Duration", time))
            points.append(self._make("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint", *values))
        names = [f"robot_{robot}"]
        return self._make("trajectory_msgs/msg/MultiDOFJointTrajectory", self._header(0.0), names, points)

    def _twist(self, linear: Floats, turning: float) -> Any:
        around = self._xyz("Vector3", np.array([0.0, 0.0, turning]))
        return self._make("geometry_msgs/msg/Twist", self._xyz("Vector3", linear), around)


def write_bag(setpoints: Setpoints, folder: Path, height: float, storage: str) -> None:
    """Write a new folder with the bag, stored as ``"SQLITE3"`` or ``"MCAP"``.

    Raises:
        ModuleNotFoundError: Without rosbags.
    """
    messages = Messages()
    with rosbag2.Writer(folder, version=BAG_VERSION, storage_plugin=rosbag2.StoragePlugin[storage]) as bag:
        for robot in range(setpoints.heading.shape[1]):
            for topic, message in (
                ("path", messages.path(setpoints, robot, height)),
                ("trajectory", messages.trajectory(setpoints, robot, height)),
            ):
                kind = message.__msgtype__
                connection = bag.add_connection(f"/robot_{robot}/{topic}", kind, typestore=messages.store)
                bag.write(connection, 0, messages.store.serialize_cdr(message, kind))
