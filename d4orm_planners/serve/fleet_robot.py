"""A robot of a fleet as its messages tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_planners.serve import wire
from d4orm_planners.serve.wire import position_of


@dataclass
class FleetRobot:
    """A robot as it was last heard."""

    name: str  #: Name of its topics
    state: FloatArray  #: ``(n,)`` as last heard; not a number before, and what no message says
    heard: float = -np.inf  #: When it was last heard, by this process's clock [s]
    heading: float = 0.0  #: As last heard [rad]
    yaw: float = 0.0  #: As first heard, which a robot whose model has no heading keeps [rad]
    stand: Floats | None = None  #: ``(d,)`` where it is held, or braking to a halt, while the team does not drive [m]
    #: ``(3,)`` by the last two poses that are far enough apart, in the frame of all [m/s]
    velocity: Floats = field(default_factory=lambda: np.zeros(3))
    #: Time by the robot's clock [s] and ``(3,)`` position of the later one [m]
    posed: tuple[float, Floats] | None = None

    def take_pose(self, stamped: Any, base: float) -> None:
        """Take the velocity from a ``geometry_msgs/PoseStamped`` and one that is older by ``base`` seconds at least."""
        now, position = wire.time_of(stamped.header), position_of(stamped.pose.position)
        passed = np.inf if self.posed is None else now - self.posed[0]
        if passed < base and passed >= 0:
            return
        self.velocity = (position - self.posed[1]) / passed if self.posed and 0 < passed < np.inf else np.zeros(3)
        self.posed = now, position
