"""ROS 2 topics over Zenoh, as rmw_zenoh or zenoh-bridge-ros2dds maps them, and a team's states, goals and commands as
messages.

With rmw_zenoh a topic is the key ``DOMAIN/NAME/TYPE/RIHS01_HASH``. With every message goes an attachment: its number
and the time of sending [ns], 8 bytes each, little end first, and the 16 bytes of the publisher's identity after their
number.
Liveliness tokens below ``@ros2_lv`` tell ``ros2 topic list`` who is there (rmw_zenoh, docs/design.md). With the bridge
the key is ``NAME``, and there is nothing else (zenoh-plugin-ros2dds, examples/python).
"""

from __future__ import annotations

import math
import secrets
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from d4orm_env.core.arrays import LARGEST_NUMBER, FloatArray, Floats
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, zenoh_config
from d4orm_planners.tracking import ros_messages as ros

_zenoh: Any = LazyModule("zenoh", "d4orm serve", "zenoh")
_rosbags: Any = LazyModule("rosbags.typesys", "d4orm serve", "ros")

BOOL, POSE, ODOMETRY = "std_msgs/msg/Bool", "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"
WIRES = ("rmw_zenoh", "bridge")  #: Mappings of topics: rmw_zenoh's, and that of zenoh-bridge-ros2dds
TWIST, TRAJECTORY = "geometry_msgs/msg/Twist", "trajectory_msgs/msg/MultiDOFJointTrajectory"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
DEPTH = 64  #: Messages of a topic that wait to be read; older ones make room
RELIABLE = f"::,{DEPTH}:,:,:,,"  #: Quality of service as tokens have it: all as by default, but for the depth
UNNORMALISED = 0.1  #: Most by which the norm of a quaternion differs from one
TURN_RATE = "turn_rate"  #: Name of a state component that odometry tells
_ATTACHMENT = struct.Struct("<qqB16s")


class RosSession:
    """A ROS 2 node on a Zenoh network, of a ROS domain, by one of :data:`WIRES`.

    ImportError without zenoh or rosbags; ValueError if zenoh refuses the settings.
    """

    def __init__(self, settings: ZenohSettings, domain: int, node: str, wire: str = WIRES[0]) -> None:
        load(_rosbags)
        zenoh = load(_zenoh)
        self._domain, self._node, self._tokens, self._bridge = domain, node, 0, wire == "bridge"
        try:
            self._session = zenoh.open(zenoh_config(zenoh, settings))
        except zenoh.ZError as error:
            raise ValueError(f"zenoh cannot listen or connect as told: {error}") from error
        self._open: list[Any] = []
        self._declare("NN")

    def __enter__(self) -> RosSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._session.close()

    def publisher(self, topic: str, kind: str) -> Publisher:
        zenoh = load(_zenoh)
        key = topic if self._bridge else _key(self._domain, topic, kind)
        self._declare("MP", topic, kind)
        # A command that is late is worth nothing: rather lose it than wait for a slow link.
        drop = zenoh.CongestionControl.DROP
        declared = self._session.declare_publisher(key, congestion_control=drop, express=True)
        return Publisher(declared, attached=not self._bridge)

    def subscriber(self, topic: str, kind: str, heard: Callable[[Subscriber], None] | None = None) -> Subscriber:
        """A subscriber to messages of a type; ``heard`` is called with it, in another thread, once there is one."""
        self._declare("MS", topic, kind)
        # Whatever the hash: ROS 2 Humble has none.
        key = topic if self._bridge else _key(self._domain, topic, kind).rpartition("/")[0] + "/*"
        subscriber = Subscriber(kind, heard)
        self._open.append(self._session.declare_subscriber(key, subscriber.hear))
        return subscriber

    def _declare(self, entity: str, topic: str = "", kind: str = "") -> None:
        if self._bridge:  # tells its own nodes only
            return
        parts = ["@ros2_lv", str(self._domain), str(self._session.zid()), "0", str(self._tokens), entity]
        parts += ["%", "%", self._node]
        if kind:
            parts += [f"%{topic.replace('/', '%')}", *_type(kind), RELIABLE]
        self._tokens += 1
        self._open.append(self._session.liveliness().declare_token("/".join(parts)))


class Publisher:
    """A topic to publish on."""

    def __init__(self, publisher: Any, *, attached: bool = True) -> None:
        self._publisher, self._number, self._identity = publisher, 0, secrets.token_bytes(16)
        self._attached = attached

    def publish(self, message: Any) -> None:
        self._number += 1
        numbered = _ATTACHMENT.pack(self._number, time.time_ns(), len(self._identity), self._identity)
        content = ros.message_types().serialize_cdr(message, message.__msgtype__)
        self._publisher.put(bytes(content), attachment=numbered if self._attached else None)


class Subscriber:
    """A topic to read from; ``refused`` counts messages that could not be read."""

    def __init__(self, kind: str, heard: Callable[[Subscriber], None] | None = None) -> None:
        self._kind, self._heard, self.refused = kind, heard, 0
        self._samples: deque[Any] = deque(maxlen=DEPTH)

    def hear(self, sample: Any) -> None:
        """Keep a message until it is taken."""
        self._samples.append(sample)
        if self._heard is not None:
            self._heard(self)

    def take(self) -> list[Any]:
        """Return the messages since the last call, oldest first."""
        received = []
        while self._samples:
            sample = self._samples.popleft()
            try:
                received.append(ros.message_types().deserialize_cdr(sample.payload.to_bytes(), self._kind))
            except Exception:  # whatever bytes a stranger sends
                self.refused += 1
        return received


def _key(domain: int, topic: str, kind: str) -> str:
    return "/".join([str(domain), topic, *_type(kind)])


def _type(kind: str) -> tuple[str, str]:
    """Name and hash of a type, as they are in keys: ``geometry_msgs::msg::dds_::Twist_``, ``RIHS01_9c45...``."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_", ros.message_types().hash_rihs01(kind)


def heading_of(orientation: Any) -> float:
    """The heading of a quaternion [rad]; not a number where its norm is not about one."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    if not abs(math.hypot(x, y, z, w) - 1) <= UNNORMALISED:
        return math.nan
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def state_from(problem: Problem, robot: int, pose: Any, velocity: Floats, turn_rate: float = math.nan) -> FloatArray:
    """``(n,)`` the state of a robot, from its ``geometry_msgs/Pose`` and its velocity ``(3,)`` in its own frame.

    What these do not say is not a number, as the steering angle of a car.
    """
    model, d, heading = problem.team.robot_models[robot], problem.dimension, heading_of(pose.orientation)
    state = np.full(problem.state_size, np.nan)
    state[model.state_size :] = 0.0  # padding
    state[:d] = position_of(pose.position)[:d]
    if model.heading_index is not None:
        state[model.heading_index] = heading
        state[list(model.speed_indices)] = velocity[0]
    elif model.speed_indices:
        state[list(model.speed_indices)] = turned(velocity, heading)[:d]
    if TURN_RATE in model.state_names:
        state[model.state_names.index(TURN_RATE)] = turn_rate
    return np.clip(state, -LARGEST_NUMBER, LARGEST_NUMBER).astype(np.float32)


def position_of(point: Any) -> Floats:
    """``(3,)`` of a ``geometry_msgs/Point`` or ``Vector3``."""
    return np.array([point.x, point.y, point.z])


def time_of(header: Any) -> float:
    """Time of a ``std_msgs/Header`` [s]."""
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def turned(vector: Floats, angle: float) -> Floats:
    """A vector ``(3,)`` turned about the vertical."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1], vector[2]])


def twist(
    problem: Problem, robot: int, state: FloatArray, control: FloatArray, heading: float, told: Floats, lag: float
) -> Floats:
    """``(4,)`` velocity [m/s] that a control leads to in a step, in the robot's own frame, and turn rate [rad/s].

    It goes on from the speed that the robot was told last, as far as its lag explains that it drives at another: speeds
    that follow commands with a lag are accelerations that do.

    Args:
        problem: The team.
        robot: Its number.
        state: ``(n,)`` where it is.
        control: ``(m,)``.
        heading: Of a robot whose model has none [rad].
        told: ``(4,)`` the last twist.
        lag: Time constant of its speed [s].
    """
    model, limits = problem.team.robot_models[robot], tuple(problem.team.limits[robot])
    speeds, room = list(model.speed_indices), problem.team.max_acceleration[robot] * lag
    last = told[:1] if model.heading_index is not None else turned(told[:3], heading)[: len(speeds)]
    state = state.copy()
    state[speeds] += np.clip(last[: len(speeds)] - state[speeds], -room, room).astype(np.float32)
    x, u = tuple(state[: model.state_size]), tuple(control[: model.control_size])
    functions, step = model.functions, TimeStep(*problem.arrays.time_step)
    after = functions.limit_state(functions.integrate(x, u, limits, step, NUMPY_OPS), limits, NUMPY_OPS)
    velocity = np.array([*map(float, functions.velocity(after, u, limits, NUMPY_OPS)), 0.0])[:3]
    turn_rate = 0.0
    if model.heading_index is not None:
        turn_rate = float(functions.derivative(after, u, limits, NUMPY_OPS)[model.heading_index])
        heading = float(after[model.heading_index])
    return np.append(turned(velocity, -heading), turn_rate)


def full_state(name: str, position: Floats, velocity: Floats, acceleration: Floats, heading: float) -> Any:
    """A ``trajectory_msgs/MultiDOFJointTrajectory`` of one point: where a robot is to be, ``(d,)`` each."""
    point = ros.trajectory_point(position, velocity, acceleration, heading)
    return ros.trajectory(name, [point], time.time_ns())


def diagnostics(node: str, level: int, state: str, values: dict[str, str]) -> Any:
    """A ``diagnostic_msgs/DiagnosticArray`` with one state."""
    pairs = [ros.make("diagnostic_msgs/msg/KeyValue", key, value) for key, value in values.items()]
    status = ros.make("diagnostic_msgs/msg/DiagnosticStatus", level, node, state, node, pairs)
    return ros.make(DIAGNOSTICS, ros.header(time.time_ns()), [status])
