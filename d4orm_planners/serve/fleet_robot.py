"""A robot of a fleet as its messages tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_planners.serve import wire
from d4orm_planners.serve.wire import position_of

BASE = 0.5
"""Share of a period over which velocities are taken from poses."""


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
        stamp, position = wire.time_of(stamped.header), position_of(stamped.pose.position)
        if self.posed is not None:
            passed, waited = stamp - self.posed[0], now - self.posed[1]
            if 0 <= passed < BASE * period:
                return
            if 0 < passed <= waited + deadline:
                self.velocity = (position - self.posed[2]) / passed
            else:
                self.clock_resets += 1
        self.posed = stamp, now, position
