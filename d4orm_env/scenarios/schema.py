"""Schema of a scenario file, and the problem it means.

The public description is the documented example ``examples/scenarios/mixed_team.yaml``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError, model_validator

from d4orm_env.core.arrays import LARGEST_NUMBER, short_repr
from d4orm_env.core.errors import did_you_mean
from d4orm_env.core.goal_poses import DEFAULT_TOLERANCE, MOST_TRAILERS
from d4orm_env.core.portable import arctan2
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import Arrival
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import get_model
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.footprints import Disc, Footprint
from d4orm_env.scenarios.problems import SCENARIOS
from d4orm_env.scenarios.settings import parsed

FLOAT32_MAX = float(str(np.finfo(np.float32).max))
VERSION = 1

Number = Annotated[float, Field(ge=-FLOAT32_MAX, le=FLOAT32_MAX)]
Squared = Annotated[float, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Speed = Annotated[float, Field(allow_inf_nan=True)]
Position = Annotated[list[Squared], Field(min_length=2, max_length=3)]
PlanarPosition = Annotated[list[Number], Field(min_length=2, max_length=2)]
SpatialPosition = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Entry(BaseModel):
    """Common strictness: no unknown fields, no text for numbers, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class RobotEntry(Entry):
    """One robot. Lengths of ``start``, ``goal`` and ``velocity`` follow the model's dimension."""

    model: str
    start: Position
    goal: Position
    velocity: Position | None = None
    heading: Number | None = None
    speed: Squared | None = None
    state: list[Number] | None = None
    radius: Number = 0.15
    max_speed: Number = 1.0
    max_acceleration: Number = 1.0
    max_turn_rate: Number = float(np.float32(np.pi / 2))
    own_limits: dict[str, Number] = Field(default_factory=dict)
    lag: Number = 0.0
    footprint: Annotated[Footprint, PlainValidator(parsed)] | None = None
    goal_heading: Number | None = None
    goal_heading_tolerance: Number = DEFAULT_TOLERANCE
    goal_hitches: Annotated[list[Number | None], Field(max_length=MOST_TRAILERS)] | None = None

    @model_validator(mode="after")
    def _fits_model(self) -> RobotEntry:
        model = get_model(self.model)
        if self.footprint is not None and "radius" in self.model_fields_set:
            raise ValueError("give either a radius or a footprint, from which the radius follows")
        for name in ("start", "goal", "velocity"):
            value = getattr(self, name)
            if value is not None and len(value) != model.dimension:
                raise ValueError(f"{name} {value} has {len(value)} components; a {model.name} needs {model.dimension}")
        rest = model.state_names[model.dimension :]
        if self.state is not None and len(self.state) != len(rest):
            raise ValueError(f"state {self.state} has {len(self.state)} components; it holds {', '.join(rest)}")
        for name in ("velocity", "heading", "speed", "state"):
            if getattr(self, name) is not None and name not in start_fields(model):
                known = ", ".join(("start", *start_fields(model)))
                raise ValueError(f"a {model.name} starts without {name}; it has {known}")
        return self

    @property
    def start_state(self) -> list[float]:
        """The start state, defaults filled in; a robot with a heading faces its goal."""
        model = get_model(self.model)
        parts = [getattr(self, name) for name in start_fields(model)]
        rest = [0.0] * (model.state_size - model.dimension)
        if model.heading_index is not None:
            offset = np.subtract(self.goal, self.start)
            rest[model.heading_index - model.dimension] = float(arctan2(offset[1], offset[0]))
        if start_fields(model) in (("velocity",), ("state",)):
            rest = parts[0] or rest
        else:
            rest = [usual if given is None else given for usual, given in zip(rest, parts, strict=True)]
        return [*self.start, *rest]


class RoundEntry(Entry):
    """A circle or vertical cylinder: centre x, y and radius [m]."""

    center: PlanarPosition
    radius: Number

    @property
    def row(self) -> list[float]:
        return [*self.center, self.radius]


class SphereEntry(RoundEntry):
    """A sphere: centre x, y, z and radius [m]."""

    center: SpatialPosition


class BoxEntry(Entry):
    """An axis-aligned box, or the bounds of the world: two opposite corners [m]."""

    lower: Position
    upper: Position

    @model_validator(mode="after")
    def _corners_match(self) -> BoxEntry:
        if len(self.lower) != len(self.upper):
            raise ValueError(
                f"lower has {len(self.lower)} components and upper {len(self.upper)}; give the same number"
            )
        return self

    @property
    def row(self) -> list[float]:
        return [*self.lower, *self.upper]


class PolygonEntry(Entry):
    """A simple polygon: its corners x, y in order, either way round [m]."""

    corners: list[PlanarPosition] = Field(min_length=3)


class WorldEntry(Entry):
    """Obstacles and bounds; an open world without bounds."""

    bounds: BoxEntry | None = None
    circles: list[RoundEntry] = []
    spheres: list[SphereEntry] = []
    cylinders: list[RoundEntry] = []
    boxes: list[BoxEntry] = []
    polygons: list[PolygonEntry] = []
    origin: Position | None = None

    def build(self, dimension: int) -> World:
        kinds = ("circles", "spheres", "cylinders", "boxes")
        rows = {kind: [entry.row for entry in getattr(self, kind)] for kind in kinds}
        lower, upper = (self.bounds.lower, self.bounds.upper) if self.bounds else (None, None)
        polygons = [entry.corners for entry in self.polygons]
        return World(dimension, **rows, polygons=polygons, lower=lower, upper=upper, origin=self.origin)


class ProblemFile(Entry):
    """The explicit form: every robot is listed."""

    version: Literal[1]
    name: str = "custom"
    dt: Squared = 0.1
    horizon: int = 100
    margin: Squared = 0.05
    goal_radius: Squared = 0.075
    goal_speed: Speed | list[Speed] | None = None
    arrival: Arrival = "dock"
    collision_penalty: Number = 1.0
    robots: list[RobotEntry] = Field(min_length=1)
    world: WorldEntry = WorldEntry()

    def build(self) -> Problem:
        shaped = any(robot.footprint is not None for robot in self.robots)
        limits = (*(() if shaped else ("radius",)), "max_speed", "max_acceleration", "max_turn_rate", "lag")
        columns: dict[str, Any] = {name: [getattr(robot, name) for robot in self.robots] for name in limits}
        models = tuple(robot.model for robot in self.robots)
        shapes = [robot.footprint or Disc(robot.radius) for robot in self.robots] if shaped else None
        team = Team(models, **columns, own_limits=self._own_limits(), footprint=shapes, margin=self.margin)
        size = team.state_size  # asks every robot
        start = [state + [0.0] * (size - len(state)) for state in (robot.start_state for robot in self.robots)]
        names = set(type(self).model_fields) - {"version", "robots", "world"}
        return Problem(
            team,
            start,
            goal=[robot.goal for robot in self.robots],
            world=self.world.build(team.dimension),
            goal_heading=[np.nan if robot.goal_heading is None else robot.goal_heading for robot in self.robots],
            goal_heading_tolerance=[robot.goal_heading_tolerance for robot in self.robots],
            goal_hitches=[_padded(robot.goal_hitches or ()) for robot in self.robots],
            **{name: getattr(self, name) for name in names},
        )

    def _own_limits(self) -> dict[str, list[float]]:
        columns: dict[str, list[float]] = {}
        for robot, entry in enumerate(self.robots):
            model = get_model(entry.model)
            known = {limit.name: limit.default for limit in model.own_limits}
            for name in entry.own_limits:
                if name not in known:
                    has = ", ".join(known) or "none"
                    raise ValueError(f"robots[{robot}].own_limits: a {model.name} has no {name!r}; it has {has}")
            for name, value in (known | entry.own_limits).items():
                columns.setdefault(name, [1.0] * len(self.robots))[robot] = value
        return columns


class ScenarioFile(BaseModel):
    """The short form: a scenario's name and arguments, which :class:`~d4orm_env.scenarios.problems.Scenario` checks."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)

    version: Literal[1]
    scenario: str
    name: str | None = None

    def build(self) -> Problem:
        arguments = self.model_extra or {}
        # A name only: a file neither imports code nor reads other files.
        scenario = SCENARIOS.look_up(self.scenario)
        complaint = scenario.complaint(arguments)
        if complaint:
            raise ValueError(complaint)
        if scenario.name == "map":
            raise ValueError("scenario 'map' reads another file, as none does; write its problem with save_problem()")
        problem = scenario.problem(**arguments)
        return problem if self.name is None else problem.replace(name=self.name)


PARTS: dict[str, type[BaseModel]] = {
    "": ProblemFile, "robots": RobotEntry, "world": WorldEntry, "bounds": BoxEntry, "circles": RoundEntry,
    "spheres": SphereEntry, "cylinders": RoundEntry, "boxes": BoxEntry, "polygons": PolygonEntry,
}  # fmt: skip
"""The schema of each part of the explicit form, by the last name on the way to it."""

KINDS = ("float", "list[float]")
"""Names of alternatives that pydantic puts among those of fields."""


def start_fields(model: Model) -> tuple[str, ...]:
    """Return the parts of a start state of that model after its position, or ``state`` for all of them."""
    rest = model.state_names[model.dimension :]
    if rest in ((), ("heading",), ("heading", "speed")):
        return rest
    if model.speed_indices == tuple(range(model.dimension, 2 * model.dimension)) and len(rest) == model.dimension:
        return ("velocity",)
    return ("state",)


def parse(data: object) -> Problem:
    """The problem that the content of a file means."""
    if not isinstance(data, dict):
        raise ValueError("expected fields such as 'version: 1' and 'robots:' or 'scenario:' at the top")
    if "scenario" in data and ("robots" in data or "world" in data):
        raise ValueError("scenario: give either a scenario and its arguments, or robots and world, not both")
    form: type[ProblemFile] | type[ScenarioFile] = ScenarioFile if "scenario" in data else ProblemFile
    try:
        content = form.model_validate(data)
    except ValidationError as error:
        raise ValueError(_explain(error)) from None
    # A value too large for float32 becomes infinite, and is then refused by name.
    with np.errstate(over="ignore"):
        return content.build()


def _padded(hitches: Sequence[float | None]) -> list[float]:
    """Hitch angles, NaN for any, for as many trailers as a robot may pull."""
    given = [np.nan if hitch is None else hitch for hitch in hitches]
    return given + [np.nan] * (MOST_TRAILERS - len(given))


def _explain(error: ValidationError) -> str:
    """The first error, as one line: where, what was expected, what was found. A field too many may be one misspelt."""
    errors = error.errors(include_url=False)
    first = next((one for one in errors if one["type"] == "extra_forbidden"), errors[0])
    names = ["", *(part for part in first["loc"] if isinstance(part, str))]
    parts = [part for part in first["loc"] if part not in KINDS]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")
    if first["type"] == "extra_forbidden":
        known = PARTS[names[-2]].model_fields
        message = f"unknown field; known are {', '.join(known)}{did_you_mean(names[-1], known)}"
    elif first["type"] == "missing":
        message = "this field is missing" + ("; give version: 1" if names[-1] == "version" else "")
    elif first["type"] == "model_type":
        message = f"expected the fields {', '.join(PARTS[names[-1]].model_fields)}, not {short_repr(first['input'])}"
    elif first["type"] == "value_error":
        message = str(first["ctx"]["error"])
    elif first["type"] == "too_short":
        message = f"{short_repr(first['input'])} has {first['ctx']['actual_length']} entries; give at least "
        message += str(first["ctx"]["min_length"])
    else:
        message = f"{first['msg'][0].lower()}{first['msg'][1:]}, not {short_repr(first['input'])}"
    return f"{where}: {message}" if where else message
