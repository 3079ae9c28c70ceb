"""The low-level control of a drive with two wheels.

A command is a speed and a turn rate. The kinematics of the differential drive makes wheel speeds of them (R. Siegwart,
I. R. Nourbakhsh and D. Scaramuzza, Introduction to Autonomous Mobile Robots, 2nd edition, chapter 3), and each wheel
follows its own by PI control with feedforward. Its gains place both poles of a wheel, an integrator from torque to
speed, at the inverse of the settling time, and its integral stands still while the motor is at its limit (K. J. Åström
and R. M. Murray, Feedback Systems, chapter "PID Control").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import Floats

GRAVITY = 9.81
"""[m/s^2]."""


class WheelCommands(NamedTuple):
    """Commands of ``D`` drives from the beginning of a step on, each ``(D,)``.

    Attributes:
        speed: At the beginning [m/s].
        acceleration: From there on [m/s^2].
        turn_rate: [rad/s].
        max_speed: [m/s].
    """

    speed: Floats
    acceleration: Floats
    turn_rate: Floats
    max_speed: Floats


class WheelControl:
    """PI control of ``D`` drives' left and right wheels.

    Args:
        radius: ``(D,)`` of the wheels [m].
        half_track: ``(D,)`` distance of a wheel from the middle [m].
        mass: ``(D,)`` of the drives [kg].
        settling_time: [s].

    Attributes:
        radius: ``(D,)`` of the wheels [m].
    """

    def __init__(self, radius: Floats, half_track: Floats, mass: Floats, settling_time: float) -> None:
        self.radius, self._half_track = radius, half_track
        # Each wheel carries half of the robot along.
        self._inertia = (mass * radius * radius / 2)[:, None]
        self._proportional = 2 * self._inertia / settling_time
        self._integral_gain = self._inertia / settling_time**2
        # What the tyres could hold if they carried all of the weight.
        self._max_torque = (mass * GRAVITY * radius / 2)[:, None]
        self._integral = np.zeros((len(mass), 2))

    def reset(self, drives: NDArray[np.bool_]) -> None:
        """Forget the past of some drives ``(D,)``."""
        self._integral[drives] = 0

    def torque(self, commands: WheelCommands, time: float, step: float, spin: Floats) -> Floats:
        """``(D, 2)`` torques of left and right wheels for the next step [N m].

        Args:
            commands: Commands of the drives.
            time: Since the commands were given, at the end of the step [s].
            step: [s].
            spin: ``(D, 2)`` present speeds of the wheels [rad/s].
        """
        wanted = commands.speed + time * commands.acceleration
        speed = np.clip(wanted, -commands.max_speed, commands.max_speed)
        turning = commands.turn_rate * self._half_track
        reference = np.stack([speed - turning, speed + turning], axis=1) / self.radius[:, None]
        ahead = np.where(speed == wanted, commands.acceleration, 0.0) / self.radius
        error = reference - spin
        integral = self._integral + step * error
        torque = self._inertia * ahead[:, None] + self._proportional * error + self._integral_gain * integral
        limited = np.clip(torque, -self._max_torque, self._max_torque)
        self._integral = np.where(limited == torque, integral, self._integral)
        return limited
