"""Robots by name: the numbers that a planner needs, and the source of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.errors import unknown
from d4orm_env.core.team import Team

_BITCRAZE = "92 mm between motors, 47 mm propellers; not looked up, measure yours"
_MEASURED = "flown in crazyflow 0.4.0 with the Mellinger controller: largest tracking error 0.06 m, 0.11 m with gusts"


@dataclass(frozen=True, kw_only=True)
class RobotType:
    """A robot that can be bought. Numbers are those of everyday work in a team, not its records."""

    model: str  #: Name of its model
    radius: float  #: Of the circle (sphere) around it [m]
    max_speed: float  #: [m/s]
    max_acceleration: float = 1.0  #: [m/s^2]; of no use to first-order models
    max_turn_rate: float = 1.0  #: [rad/s]; of no use to models without a heading
    margin: float  #: Distance for what tracking is off [m]
    lag: float  #: Time constant of its actuators [s], for :class:`~d4orm_planners.base.controller.Controller`
    sources: Mapping[str, str]  #: Where the numbers come from, by attribute

    @property
    def settings(self) -> dict[str, object]:
        """Arguments of scenarios for a team of these."""
        limits = {name: getattr(self, name) for name in ("max_speed", "max_acceleration", "max_turn_rate")}
        return {"model": self.model, "radius": self.radius, "margin": self.margin, **limits}


def _robot(model: str, **numbers: tuple[float, str]) -> RobotType:
    """A robot by its numbers, each with its source."""
    values = {name: value for name, (value, _) in numbers.items()}
    return RobotType(model=model, sources={name: source for name, (_, source) in numbers.items()}, **values)


ROBOTS: Mapping[str, RobotType] = MappingProxyType({
    "crazyflie": _robot(
        "holonomic3d",
        radius=(0.07, f"Crazyflie 2.1+ {_BITCRAZE}; the air below it needs more"),
        max_speed=(1.0, "ours, for indoor flight by motion capture"),
        max_acceleration=(2.0, "ours: a tilt of 11 degrees, which leaves thrust for the height with a low battery"),
        margin=(0.1, _MEASURED),
        lag=(0.2, "of accelerations in crazyflow 0.4.0, where 0.1 s left D4orm-C2F circling its goals"),
    ),
    "crazyflie_brushless": _robot(
        "holonomic3d",
        radius=(0.08, "ours: about 50 mm to the motors, 55 mm propellers; measure yours"),
        max_speed=(1.5, "ours, for indoor flight by motion capture"),
        max_acceleration=(3.0, "ours: a tilt of 17 degrees"),
        margin=(0.1, "as crazyflie, not measured"),
        lag=(0.08, "ours, not measured"),
    ),
    "turtlebot3_burger": _robot(
        "differential_drive",
        radius=(0.105, "turtlebot3_navigation2: robot_radius 0.105 (138 x 178 mm, turning about the wheels' axle)"),
        max_speed=(0.22, "ROBOTIS e-Manual, specifications: 0.22 m/s"),
        max_acceleration=(0.5, "ours; turtlebot3_navigation allows 2.5"),
        max_turn_rate=(1.8, "ours; the e-Manual has 2.84 rad/s at most"),
        margin=(0.05, "ours, not measured"),
        lag=(0.15, "ours: a loop at 10 Hz over ROS 2"),
    ),
    "robomaster": _robot(
        "holonomic2d",
        radius=(0.2, "DJI RoboMaster S1/EP: 320 x 240 mm, half of the diagonal"),
        max_speed=(1.0, "ours; DJI: 3.5 m/s forwards, 2.8 m/s sideways"),
        max_acceleration=(1.0, "ours, for mecanum wheels without slip"),
        margin=(0.05, "ours, not measured"),
        lag=(0.1, "ours, not measured"),
    ),
    "jackal": _robot(
        "differential_drive",
        radius=(0.333, "Clearpath Jackal: 508 x 430 mm, half of the diagonal; not looked up"),
        max_speed=(1.5, "ours; 2.0 m/s at most, not looked up"),
        max_acceleration=(1.0, "ours, for skid steering"),
        max_turn_rate=(1.5, "ours, not measured"),
        margin=(0.1, "ours, not measured"),
        lag=(0.2, "ours, not measured"),
    ),
})  # fmt: skip
"""The robots that are known by name."""


def find_robot(name: str) -> RobotType:
    """The robot of that name."""
    if not isinstance(name, str) or name not in ROBOTS:
        raise unknown("robot", name, ROBOTS)
    return ROBOTS[name]


def make_team(name: str, num_robots: int) -> Team:
    """A team of robots that can be bought, with the radius and the limits that :data:`ROBOTS` has.

    Scenarios take ``robot=name``, which sets the margin too.

    Args:
        name: ``"crazyflie"``, ``"crazyflie_brushless"``, ``"turtlebot3_burger"``, ``"robomaster"`` or ``"jackal"``.
        num_robots: ``K``.

    Raises:
        ValueError: If there is no such robot, or the number is not positive.
    """
    settings = find_robot(name).settings
    models, _ = (settings.pop("model"),) * whole_number(num_robots, "num_robots", 1), settings.pop("margin")
    return Team(models, **settings)  # type: ignore[arg-type]
