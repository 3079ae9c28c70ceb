"""Robots by name: the numbers that a planner needs, and the source of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from d4orm_env.core.arrays import truth, whole_number
from d4orm_env.core.errors import unknown
from d4orm_env.core.files import MAX_ITEMS
from d4orm_env.core.team import Team
from d4orm_env.footprints import Ellipsoid

_CRAZYFLIE = "https://www.bitcraze.io/documentation/hardware/crazyflie_2_1/crazyflie_2_1-datasheet.pdf"
_BRUSHLESS = "https://www.bitcraze.io/author/tobias/"
_ROBOTIS = "https://emanual.robotis.com/docs/en/platform/turtlebot3/features/#specifications"
_BURGER = "https://github.com/ROBOTIS-GIT/turtlebot3, turtlebot3_description/urdf/turtlebot3_burger.urdf"
_DJI = "https://www.dji.com/robomaster-ep/specs"
_CLEARPATH = "https://github.com/jackal/jackal/blob/noetic-devel/jackal_control/config/control.yaml"
_FLOWN = "ours, measured in crazyflow 0.4.0 (examples.studies zero_shot): "
_GUESSED = "ours, not measured"


@dataclass(frozen=True, kw_only=True)
class RobotType:
    """A robot that can be bought. Numbers are those of everyday work in a team, not its records.

    Its goal speed is what it brakes away in a time step, as of all robots.
    """

    model: str  #: Name of its model
    radius: float  #: Of the circle (sphere) around it [m]
    max_speed: float  #: [m/s]
    max_acceleration: float = 1.0  #: [m/s^2]; of no use to first-order models
    max_turn_rate: float = 1.0  #: [rad/s]; of no use to models without a heading
    margin: float  #: Distance for what tracking is off [m]
    lag: float  #: Time constant of its actuators [s], for :class:`~d4orm_planners.base.controller.Controller`
    downwash: float = 0.0  #: Half the height of the ellipsoid that others of its kind stay out of; zero for none [m]
    sources: Mapping[str, str]  #: Where the numbers come from, by attribute

    def settings(self, downwash: object = None, radius: Any = None) -> dict[str, object]:
        """Arguments of scenarios for a team of these: as balls, or with room for their downwash by default if they have
        one; and of another ``radius``, if given.
        """
        wide = bool(self.downwash) if downwash is None else truth(downwash, "downwash")
        if wide and not self.downwash:
            raise ValueError("downwash is True, and this robot has none; leave it out, or choose a drone as robot")
        names = ("model", "max_speed", "max_acceleration", "max_turn_rate", "margin", "lag")
        settings, radius = {name: getattr(self, name) for name in names}, self.radius if radius is None else radius
        if not wide:
            return settings | {"radius": radius}
        shapes = [Ellipsoid(size, size, self._reach(size), size) for size in (radius if np.ndim(radius) else [radius])]
        return settings | {"footprint": shapes if np.ndim(radius) else shapes[0]}

    def _reach(self, radius: Any) -> Any:
        """Half the height of an ellipsoid of that radius: no less."""
        return max(radius, self.downwash) if isinstance(radius, int | float | np.floating) else self.downwash


def _robot(model: str, **numbers: tuple[float, str]) -> RobotType:
    """A robot by its numbers, each with its source."""
    values = {name: value for name, (value, _) in numbers.items()}
    return RobotType(model=model, sources={name: source for name, (_, source) in numbers.items()}, **values)


ROBOTS: Mapping[str, RobotType] = MappingProxyType({
    "crazyflie": _robot(
        "holonomic3d",
        radius=(0.07, f"92 mm between motors, {_CRAZYFLIE}; propellers of 47 mm"),
        max_speed=(1.0, "ours, for indoor flight by motion capture"),
        max_acceleration=(2.0, "ours: a tilt of 11 degrees, which leaves thrust for the height with a low battery"),
        margin=(0.1, _FLOWN + "drones lost 0.03 m of it to errors of 0.06 m; in gusts 0.1 m to 0.11, so fly at 0.15"),
        lag=(0.2, _FLOWN + "of accelerations; 0.1 s left D4orm-C2F circling its goals"),
        downwash=(0.25, "ours: with the margin as the ellipsoid of 0.12 x 0.12 x 0.3 m usual for it"),
    ),
    "crazyflie_brushless": _robot(
        "holonomic3d",
        radius=(0.08, f"ours: about 50 mm to the motors; propellers of 55 mm, {_BRUSHLESS}"),
        max_speed=(1.5, "ours, for indoor flight by motion capture"),
        max_acceleration=(3.0, "ours: a tilt of 17 degrees"),
        margin=(0.15, "ours, measured in crazyflow (cf21B_500, 100 teams): drones lost 0.05 m of it to errors of 0.14"),
        lag=(0.08, _GUESSED),
        downwash=(0.25, "ours: as crazyflie, not flown"),
    ),
    "turtlebot3_burger": _robot(
        "differential_drive",
        radius=(0.124, f"from between the wheels to the corners of its box, 140 mm square and 32 mm behind, {_BURGER}"),
        max_speed=(0.22, _ROBOTIS),
        max_acceleration=(0.5, "ours; 2.5 at most, dwa_local_planner_params_burger.yaml of turtlebot3_navigation"),
        max_turn_rate=(1.8, f"ours; 2.84 rad/s at most, {_ROBOTIS}"),
        margin=(0.05, _GUESSED),
        lag=(0.15, "ours, not measured: a loop at 10 Hz over ROS 2"),
    ),
    "robomaster": _robot(
        "holonomic2d",
        radius=(0.2, f"half of the diagonal of 320 x 240 mm, {_DJI}; with an arm it is 410 mm long, 0.24"),
        max_speed=(1.0, f"ours; 3.5 m/s forwards and 2.8 m/s sideways at most, {_DJI}"),
        max_acceleration=(1.0, "ours, for mecanum wheels without slip, not measured"),
        margin=(0.05, _GUESSED),
        lag=(0.1, _GUESSED),
    ),
    "jackal": _robot(
        "differential_drive",
        radius=(0.333, "half of the diagonal of 508 x 430 mm, Clearpath's figures as others quote them"),
        max_speed=(1.5, f"ours; 2.0 m/s at most, {_CLEARPATH}"),
        max_acceleration=(1.0, f"ours, for skid steering, not measured; 20 at most, {_CLEARPATH}"),
        max_turn_rate=(1.5, f"ours; 4.0 rad/s at most, {_CLEARPATH}"),
        margin=(0.1, _GUESSED),
        lag=(0.2, _GUESSED),
    ),
})  # fmt: skip
"""The robots that are known by name."""


def find_robot(name: str) -> RobotType:
    """The robot of that name."""
    if not isinstance(name, str) or name not in ROBOTS:
        raise unknown("robot", name, ROBOTS)
    return ROBOTS[name]


def make_team(name: str, num_robots: int, *, downwash: bool | None = None) -> Team:
    """A team of robots that can be bought, as :data:`ROBOTS` has them; scenarios take ``robot=name``.

    Its problems have their margin by default, and controllers their lag.

    Args:
        name: ``"crazyflie"``, ``"crazyflie_brushless"``, ``"turtlebot3_burger"``, ``"robomaster"`` or ``"jackal"``.
        num_robots: ``K``.
        downwash: Whether they are ellipsoids to each other, which keep others out of the air below them, and balls to
            all else; by default drones are. ``False`` makes them balls.

    Raises:
        ValueError: If there is no such robot, it has no downwash, or the number is not positive.
    """
    settings = find_robot(name).settings(downwash)
    models = (settings.pop("model"),) * whole_number(num_robots, "num_robots", 1, MAX_ITEMS)
    return Team(models, **settings)  # type: ignore[arg-type]
