"""The arguments every scenario shares, checked, and footprints as settings and problem files hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import cached_property
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import positive_number, short_repr, whole_number
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem_checks import MAX_HORIZON, Arrival, check_arrival
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import get_model
from d4orm_env.footprints import Box, Capsule, Disc, Ellipsoid, Footprint, Polygon, Train

MAX_COUNT = 10_000
"""Most robots or obstacles a generator makes: a slip of the finger must not fill the memory."""

LARGEST = 10_000.0
"""Largest length [m] and time [s]; beyond it float32 holds no millimetres."""


@dataclass(frozen=True)
class Settings:
    """Arguments common to all scenarios. Defaults are the paper's and its reference code's."""

    scenario: str  #: Name of the scenario
    num_robots: int = 8  #: ``K``
    seed: int = 0  #: Seeds whatever the scenario draws: walls, random starts and goals, random obstacles, jitter
    model: str | Sequence[str] | None = "holonomic2d"  #: One model name for all robots, or ``K`` names
    num_obstacles: int = 0  #: Random circles (spheres in space) placed inside the scenario
    obstacle_radius: float = 0.15  #: Radius of circular obstacles [m]
    #: Of a scenario that is open: a margin [m] around the box in which its robots start and end, or the lower and the
    #: upper corner ``(2, d)`` [m]
    bounds: SupportsFloat | list[list[float]] | tuple[Sequence[float], ...] | NDArray[np.floating] | None = None
    radius: ArrayLike | None = None  #: Robot radius [m], one or ``K``; 0.15 by default, or that of the footprint
    footprint: Any = None  #: One of :mod:`d4orm_env.footprints` or ``K``, or as in files, ``{"shape": "box", ...}``
    margin: float = 0.05  #: Safety margin [m]
    dt: float = 0.1  #: Time step [s]
    horizon: int | None = None  #: Number of steps; ``None`` follows :func:`~d4orm_env.scenarios.layout.default_horizon`
    #: Of the lowest start or goal above zero [m]; only in space. By default scenarios are about the origin.
    height: float | None = None
    goal_radius: float = 0.075  #: A robot within it has arrived [m]
    #: Speed at which a robot may still dock [m/s], one or ``K``; see :class:`~d4orm_env.core.problem.Problem`
    goal_speed: ArrayLike | None = None
    goal_heading: ArrayLike | None = None  #: Heading with which a robot must arrive [rad], one or ``K``, NaN for any
    goal_heading_tolerance: ArrayLike = 0.1  #: How far it may be off [rad], one or ``K``
    #: ``"dock"``: a robot that arrives stays there for good. ``"stay"``: it may be moved again.
    arrival: Arrival = "dock"
    collision_penalty: float = 1.0  #: Taken off the reward per step within the margin of a robot, and of an obstacle
    max_speed: ArrayLike = 1.0  #: Speed limit [m/s], one or ``K``
    max_acceleration: ArrayLike = 1.0  #: Acceleration limit [m/s^2], one or ``K``
    max_turn_rate: ArrayLike = float(np.pi / 2)  #: Turn rate limit [rad/s], one or ``K``
    #: Limits that models have for themselves by name, each one or ``K``
    own_limits: Mapping[str, ArrayLike] = field(default_factory=dict)
    lag: ArrayLike = 0.0  #: Time constant of the actuators [s], one or ``K``, for controllers of real robots

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
            raise ValueError(f"model must be the name of a model or one name per robot, not {short_repr(self.model)}")
        if len(self.model) != self.num_robots:
            raise ValueError(f"model lists {len(self.model)} names for {self.num_robots} robots; give one per robot")
        return tuple(self.model)

    @cached_property
    def team(self) -> Team:
        """The robots."""
        shapes = parsed(self.footprint) if isinstance(self.footprint, Mapping) else self.footprint
        limits = self.max_speed, self.max_acceleration, self.max_turn_rate, self.own_limits
        return Team(self.models, self.radius, *limits, footprint=shapes, lag=self.lag, margin=self.margin)

    @property
    def spacing(self) -> float:
        """Distance between the centres of the two largest robots that are side by side one margin apart [m]."""
        return 2 * float(np.max(self.team.girth)) + self.margin

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


def require_dimension(settings: Settings, dimension: int) -> None:
    """Check that a scenario of the plane, or in space, is asked for robots of the same."""
    if settings.team.dimension != dimension:
        kind, other = ("planar", "forest") if dimension == 2 else ("three-dimensional", "circle")
        raise ValueError(
            f"scenario {settings.scenario!r} is {kind} and model {settings.model!r} is not; "
            f"use model='holonomic{dimension}d', or scenario {other!r}"
        )


def require_scale(settings: Settings, travel: float) -> None:
    """Refuse a step in which all robots pass the whole scenario, or a goal radius as large: numbers in other units."""
    stride = float(settings.team.max_speed.min()) * settings.dt
    for what, length in (
        (f"dt is {settings.dt:g} s, in which the slowest robot may move by {stride:g} m", stride),
        (f"goal_radius is {settings.goal_radius:g} m", settings.goal_radius),
    ):
        if length > travel:
            raise ValueError(
                f"{what}, farther than the {travel:.3g} m that scenario {settings.scenario!r} is made for; give metres "
                "and seconds"
            )


def grid_size(value: object, name: str) -> tuple[int, int]:
    """Columns and rows from what was given for them: two whole numbers, and not too many squares."""
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ValueError(f"{name} must be two whole numbers, columns and rows, not {short_repr(value)}")
    columns, rows = (whole_number(count, name, 1, MAX_COUNT) for count in value)
    if columns * rows > MAX_COUNT:
        raise ValueError(f"{name} is {columns} x {rows}; scenarios make at most {MAX_COUNT} in all")
    return columns, rows


KINDS: dict[str, type[Footprint]] = {
    kind.__name__.lower(): kind for kind in (Disc, Box, Capsule, Polygon, Ellipsoid, Train)
}
"""Footprints by their names in files."""


def described(footprint: Footprint) -> dict[str, Any]:
    """The content of a file that means a footprint; the inverse of :func:`parsed`."""
    if isinstance(footprint, Train):
        return {
            "shape": "train",
            "front": described(footprint.front),
            "trailers": [*map(described, footprint.trailers)],
        }
    fields = asdict(footprint)  # type: ignore[call-overload] # all are dataclasses
    if "corners" in fields:
        fields["corners"] = [list(corner) for corner in fields["corners"]]
    return {"shape": type(footprint).__name__.lower()} | fields


def parsed(content: object) -> Footprint:
    """The footprint that a file means, such as ``{"shape": "box", "length": 0.5, "width": 0.25}``."""
    if not isinstance(content, dict) or not isinstance(content.get("shape"), str):
        example = "{shape: box, length: 0.5, width: 0.25}"
        raise ValueError(f"footprint must be a mapping such as {example}, not {short_repr(content)}")
    kind = KINDS.get(content["shape"])
    if kind is None:
        raise unknown("footprint", content["shape"], KINDS)
    sizes = {name: value for name, value in content.items() if name != "shape"}
    parts = fields(kind)  # type: ignore[arg-type] # all are dataclasses
    known = [part.name for part in parts]
    lacking = [part.name for part in parts if part.default is MISSING and part.name not in sizes]
    for name in sizes:
        if name not in known:
            raise unknown(f"footprint {content['shape']}: field", name, known)
    if lacking:
        raise ValueError(f"footprint {content['shape']} lacks {', '.join(lacking)}; it has {', '.join(known)}")
    try:
        if kind is Train:
            front: Any = parsed(sizes["front"])
            trailers: Any = sizes["trailers"]
            if isinstance(trailers, list | tuple):
                trailers = [*map(parsed, trailers)]
            return Train(front, trailers)
        return kind(**sizes)
    except TypeError as error:
        raise ValueError(f"footprint {content['shape']}: {error}") from None
