"""Material of the bodies, and time step of their integration."""

from __future__ import annotations

from dataclasses import dataclass, fields

from d4orm_env.core.arrays import positive_number

_ALLOWED_ZERO = ("drag", "wheel_friction", "body_friction")
_MOST = {"time_step": 0.02, "wheel_friction": 10.0, "body_friction": 10.0, "settling_time": 1.0, "surface_density": 1e6}


@dataclass(frozen=True, kw_only=True)
class Physics:
    """The bodies of a team in MuJoCo. The defaults are those of small laboratory robots.

    Attributes:
        time_step: Longest step of MuJoCo [s]; a time step of the problem is divided evenly. At most 0.02.
        drag: Of pucks, linear in their velocity, per mass [1/s]; what a planner does not know of.
        wheel_friction: Coulomb friction coefficient between wheels and floor.
        body_friction: The same between robots, and between robots and obstacles.
        settling_time: Time constant of the low-level speed controllers, see :mod:`d4orm_env.mujoco.wheels` [s].
        surface_density: Mass of a robot over the square of its radius [kg/m^2]; 100 is 2.25 kg for a radius of 0.15 m.

    Raises:
        ValueError: For a number out of range.
    """

    time_step: float = 0.005
    drag: float = 0.2
    wheel_friction: float = 0.8
    body_friction: float = 0.3
    settling_time: float = 0.03
    surface_density: float = 100.0

    def __post_init__(self) -> None:
        for attribute in fields(self):
            name = attribute.name
            value = positive_number(
                getattr(self, name),
                f"Physics {name}",
                zero_allowed=name in _ALLOWED_ZERO,
                least=1e-4,
                most=_MOST.get(name, 1e3),
            )
            object.__setattr__(self, name, value)
