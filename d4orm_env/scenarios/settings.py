"""The arguments every scenario shares, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import positive_number, whole_number
from d4orm_env.core.problem_checks import MAX_HORIZON, Arrival, check_arrival
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import get_model
from d4orm_env.scenarios.footprint_entries import parsed

MAX_COUNT = 10_000
"""Most robots or obstacles a generator makes: a slip of the finger must not fill the memory."""

LARGEST = 10_000.0
"""Largest length [m] and time [s]; beyond it float32 holds no millimetres."""


@dataclass(frozen=True)
class Settings:
    """Arguments common to all scenarios. Defaults are the paper's and its reference code's.

    Attributes:
        scenario: Name of the scenario.
        num_robots: ``K``.
        seed: Seeds whatever the scenario draws: walls, random starts and goals, random obstacles, jitter.
        model: One model name for all robots, or ``K`` names.
        num_obstacles: Random circles (spheres in space) placed inside the scenario.
        obstacle_radius: Radius of circular obstacles [m].
        bounds: Of a scenario that is open: a margin [m] around the box in which its robots start and end, or the lower
            and the upper corner ``(2, d)`` [m].
        radius: Robot radius [m], one or ``K``; 0.15 by default, or that of the footprint.
        footprint: One of :mod:`d4orm_env.footprints` or ``K``, or as in files, ``{"shape": "box", ...}``.
        margin: Safety margin [m].
        dt: Time step [s].
        horizon: Number of steps; ``None`` follows :func:`~d4orm_env.scenarios.layout.default_horizon`.
        height: Of the lowest start or goal above zero [m]; only in space. By default scenarios are about the origin.
        goal_radius: A robot within it has arrived [m].
        goal_speed: Speed at which a robot may still dock [m/s], one or ``K``;
            see :class:`~d4orm_env.core.problem.Problem`.
        goal_heading: Heading with which a robot must arrive [rad], one or ``K``, NaN for any.
        goal_heading_tolerance: How far it may be off [rad], one or ``K``.
        arrival: ``"dock"``: a robot that arrives stays there for good. ``"stay"``: it may be moved again.
        collision_penalty: Taken off the reward per step within the margin of a robot, and of an obstacle.
        max_speed: Speed limit [m/s], one or ``K``.
        max_acceleration: Acceleration limit [m/s^2], one or ``K``.
        max_turn_rate: Turn rate limit [rad/s], one or ``K``.
        own_limits: Limits that models have for themselves by name, each one or ``K``.

    Raises:
        ValueError: If a value makes no sense; the message names it.
    """

    scenario: str
    num_robots: int = 8
    seed: int = 0
    model: str | Sequence[str] | None = "holonomic2d"
    num_obstacles: int = 0
    obstacle_radius: float = 0.15
    bounds: SupportsFloat | list[list[float]] | tuple[Sequence[float], ...] | NDArray[np.floating] | None = None
    radius: ArrayLike | None = None
    footprint: Any = None
    margin: float = 0.05
    dt: float = 0.1
    horizon: int | None = None
    height: float | None = None
    goal_radius: float = 0.075
    goal_speed: ArrayLike | None = None
    goal_heading: ArrayLike | None = None
    goal_heading_tolerance: ArrayLike = 0.1
    arrival: Arrival = "dock"
    collision_penalty: float = 1.0
    max_speed: ArrayLike = 1.0
    max_acceleration: ArrayLike = 1.0
    max_turn_rate: ArrayLike = float(np.pi / 2)
    own_limits: Mapping[str, ArrayLike] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, minimum in (("num_robots", 1), ("seed", 0), ("num_obstacles", 0)):
            object.__setattr__(self, name, whole_number(getattr(self, name), name, minimum))
        for name in ("num_robots", "num_obstacles"):
            if getattr(self, name) > MAX_COUNT:
                raise ValueError(f"{name} is {getattr(self, name)}; scenarios make at most {MAX_COUNT}")
        if self.horizon is not None:
            object.__setattr__(self, "horizon", whole_number(self.horizon, "horizon", 1, MAX_HORIZON))
        for name in ("dt", "goal_radius", "obstacle_radius", "collision_penalty"):
            object.__setattr__(self, name, bounded(getattr(self, name), name))
        object.__setattr__(self, "margin", bounded(self.margin, "margin", zero_allowed=True))
        if self.height is not None:
            object.__setattr__(self, "height", bounded(self.height, "height", zero_allowed=True))
        check_arrival(self.arrival)

    @cached_property
    def models(self) -> tuple[str, ...]:
        """``K`` model names."""
        if isinstance(self.model, str):
            get_model(self.model)
            return (self.model,) * self.num_robots
        if not isinstance(self.model, Sequence) or not all(isinstance(name, str) for name in self.model):
            raise ValueError(f"model must be the name of a model or one name per robot, not {self.model!r}")
        if len(self.model) != self.num_robots:
            raise ValueError(f"model lists {len(self.model)} names for {self.num_robots} robots; give one per robot")
        return tuple(self.model)

    @cached_property
    def team(self) -> Team:
        """The robots."""
        shapes = parsed(self.footprint) if isinstance(self.footprint, Mapping) else self.footprint
        limits = self.max_speed, self.max_acceleration, self.max_turn_rate, self.own_limits
        return Team(self.models, self.radius, *limits, footprint=shapes)

    @property
    def spacing(self) -> float:
        """Distance between the centres of the two largest robots whose surfaces are one margin apart [m]."""
        return 2 * float(np.max(self.team.radius)) + self.margin

    def generator(self, purpose: int) -> np.random.Generator:
        """The seed's random numbers for one purpose: drawing obstacles does not move the robots."""
        return np.random.default_rng([self.seed, purpose])


STARTS_AND_GOALS, OBSTACLES, JITTER, WALLS = range(4)
"""Purposes of :meth:`Settings.generator`."""


def bounded(value: SupportsFloat, name: str, *, zero_allowed: bool = False) -> float:
    """``value`` as a positive number no larger than scenarios are, :data:`LARGEST`."""
    number = positive_number(value, name, zero_allowed=zero_allowed)
    if number > LARGEST:
        raise ValueError(f"{name} is {number:g}; scenarios take at most {LARGEST:g}")
    return number


def require_plane(settings: Settings) -> None:
    """Check that a scenario of the plane is asked for robots of the plane."""
    if settings.team.dimension != 2:
        raise ValueError(
            f"scenario {settings.scenario!r} is planar and model {settings.model!r} is not; "
            f"use model='holonomic2d', or scenario 'forest'"
        )


def grid_size(value: object, name: str) -> tuple[int, int]:
    """Columns and rows from what was given for them: two whole numbers, and not too many squares."""
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ValueError(f"{name} must be two whole numbers, columns and rows, not {value!r}")
    columns, rows = (whole_number(count, name, 1, MAX_COUNT) for count in value)
    if columns * rows > MAX_COUNT:
        raise ValueError(f"{name} is {columns} x {rows}; scenarios make at most {MAX_COUNT} in all")
    return columns, rows
