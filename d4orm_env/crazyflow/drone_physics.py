"""The drones, and what a planner does not know of them."""

from __future__ import annotations

from dataclasses import dataclass

from crazyflow.drones import Drone

from d4orm_env.core.arrays import positive_number, shown

DRONES = tuple(drone.value for drone in Drone)


@dataclass(frozen=True, kw_only=True)
class DronePhysics:
    """The drones of a team in crazyflow.

    Attributes:
        drone: Their type, as crazyflow names it: ``"cf2x_L250"`` is the Crazyflie 2.x.
        mass_factor: Their mass over that which their controller reckons with.
        gust: Force on every drone, in another random direction every 0.5 s [N].

    Raises:
        ValueError: For an unknown type, or a number out of range.
    """

    drone: str = Drone.cf2x_L250.value
    mass_factor: float = 1.0
    gust: float = 0.0

    def __post_init__(self) -> None:
        if self.drone not in DRONES:
            raise ValueError(f"drone is {shown(self.drone)}; choose one of {', '.join(DRONES)}")
        factor = positive_number(self.mass_factor, "mass_factor", least=0.1, most=10)
        object.__setattr__(self, "mass_factor", factor)
        object.__setattr__(self, "gust", positive_number(self.gust, "gust", zero_allowed=True, most=10))
