"""Schema of a scenario file, and the problem it means.

The public description is the documented example ``examples/scenarios/mixed_team.yaml``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from d4orm_env.core.portable import arctan2
from d4orm_env.core.problem import Arrival, Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import get_model
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.footprints import Disc, Footprint
from d4orm_env.scenarios.footprint_entries import described, parsed
from d4orm_env.scenarios.scenario_registry import SCENARIOS

FLOAT32_MAX = float(str(np.finfo(np.float32).max))
VERSION = 1

SQUARED_MAX = 1e18
"""Largest magnitude whose square, and a sum of such squares, float32 still holds."""

Number = Annotated[float, Field(ge=-FLOAT32_MAX, le=FLOAT32_MAX)]
Squared = Annotated[float, Field(ge=-SQUARED_MAX, le=SQUARED_MAX)]
Speed = Annotated[float, Field(allow_inf_nan=True)]
Place = Annotated[list[Squared], Field(min_length=2, max_length=3)]
PlanarPlace = Annotated[list[Number], Field(min_length=2, max_length=2)]
SpatialPlace = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Entry(BaseModel):
    """Common strictness: no unknown fields, no text for numbers, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class RobotEntry(Entry):
    """One robot. Lengths of ``start``, ``goal`` and ``velocity`` follow the model's dimension."""

    model: str
    start: Place
    goal: Place
    velocity: Place | None = None
    heading: Number | None = None
    speed: Squared | None = None
    state: list[Number] | None = None
    radius: Number = 0.15
    max_speed: Number = 1.0
    max_acceleration: Number = 1.0
    max_turn_rate: Number = float(np.float32(np.pi / 2))
    own_limits: dict[str, Number] = Field(default_factory=dict)
    footprint: dict[str, Any] | None = None
    goal_heading: Number | None = None
    goal_heading_tolerance: Number = 0.1

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
        state = list(self.start)
        offset = np.subtract(self.goal, self.start)
        if "state" in start_fields(model):
            rest = [0.0] * (model.state_size - model.dimension)
            if model.heading_index is not None:
                rest[model.heading_index - model.dimension] = float(arctan2(offset[1], offset[0]))
            state += self.state or rest
        if "velocity" in start_fields(model):
            state += self.velocity or [0.0] * model.dimension
        if "heading" in start_fields(model):
            state += [float(arctan2(offset[1], offset[0])) if self.heading is None else self.heading]
        if "speed" in start_fields(model):
            state += [0.0 if self.speed is None else self.speed]
        return state


class RoundEntry(Entry):
    """A circle or vertical cylinder: centre x, y and radius [m]."""

    center: PlanarPlace
    radius: Number

    @property
    def row(self) -> list[float]:
        return [*self.center, self.radius]


class SphereEntry(RoundEntry):
    """A sphere: centre x, y, z and radius [m]."""

    center: SpatialPlace


class BoxEntry(Entry):
    """An axis-aligned box, or the bounds of the world: two opposite corners [m]."""

    lower: Place
    upper: Place

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

    corners: list[PlanarPlace] = Field(min_length=3)


class WorldEntry(Entry):
    """Obstacles and bounds; an open world without bounds."""

    bounds: BoxEntry | None = None
    circles: list[RoundEntry] = []
    spheres: list[SphereEntry] = []
    cylinders: list[RoundEntry] = []
    boxes: list[BoxEntry] = []
    polygons: list[PolygonEntry] = []
    origin: Place | None = None

    def build(self, dimension: int) -> World:
        rows = {
            kind: [entry.row for entry in getattr(self, kind)] for kind in ("circles", "spheres", "cylinders", "boxes")
        }
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
        shaped = any(robot.footprint for robot in self.robots)
        limits = (*(() if shaped else ("radius",)), "max_speed", "max_acceleration", "max_turn_rate")
        columns: dict[str, Any] = {name: [getattr(robot, name) for robot in self.robots] for name in limits}
        models = tuple(robot.model for robot in self.robots)
        shapes = [*map(_footprint, self.robots)] if shaped else None
        team = Team(models, **columns, own_limits=self._own_limits(), footprint=shapes)
        size = team.state_size  # asks every robot
        start = [state + [0.0] * (size - len(state)) for state in (robot.start_state for robot in self.robots)]
        return Problem(
            team=team,
            start=start,
            goal=[robot.goal for robot in self.robots],
            world=self.world.build(team.dimension),
            dt=self.dt,
            horizon=self.horizon,
            margin=self.margin,
            goal_radius=self.goal_radius,
            goal_speed=self.goal_speed,
            arrival=self.arrival,
            collision_penalty=self.collision_penalty,
            goal_heading=[np.nan if robot.goal_heading is None else robot.goal_heading for robot in self.robots],
            goal_heading_tolerance=[robot.goal_heading_tolerance for robot in self.robots],
            name=self.name,
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
    """The short form: a scenario's name and arguments, which :class:`~d4orm_env.scenarios.scenario.Scenario` checks."""

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


PARTS: dict[tuple[str, ...], type[BaseModel]] = {
    (): ProblemFile,
    ("robots",): RobotEntry,
    ("world",): WorldEntry,
    ("world", "bounds"): BoxEntry,
    ("world", "circles"): RoundEntry,
    ("world", "spheres"): SphereEntry,
    ("world", "cylinders"): RoundEntry,
    ("world", "boxes"): BoxEntry,
    ("world", "polygons"): PolygonEntry,
}
"""The schema of each part of the explicit form."""


KINDS = ("float", "list[float]")
"""Names of alternatives that pydantic puts among those of fields."""


def start_fields(model: Model) -> tuple[str, ...]:
    """Return the parts of a start state of that model beside its position, or ``state`` for all that there is."""
    rest = model.state_names[model.dimension :]
    if rest in ((), ("heading",), ("heading", "speed")):
        return rest
    if model.speed_indices == tuple(range(model.dimension, 2 * model.dimension)) and len(rest) == model.dimension:
        return ("velocity",)
    return ("state",)


def parse(data: object) -> Problem:
    """The problem that the content of a file means.

    Raises:
        ValueError: If it breaks the schema or makes no valid problem; one line that names the field.
    """
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


def describe(problem: Problem) -> dict[str, object]:
    """The content of a file that means that problem, to the bit: the inverse of :func:`parse`."""
    settings = {name: getattr(problem, name) for name in ("dt", "horizon", "margin", "goal_radius")}
    speeds = _decimals(problem.goal_speed)
    settings["goal_speed"] = speeds[0] if len(set(speeds)) == 1 else speeds
    if not problem.docks:
        settings["arrival"] = problem.arrival
    if problem.collision_penalty != 1:
        settings["collision_penalty"] = problem.collision_penalty
    robots = [_describe_robot(problem, robot) for robot in range(problem.num_robots)]
    return {
        "version": VERSION,
        "name": str(problem.name).encode("utf-8", "replace").decode(),  # YAML has no lone surrogates
        **settings,
        "robots": robots,
        "world": _describe_world(problem),
    }


def _describe_robot(problem: Problem, robot: int) -> dict[str, object]:
    team, dimension = problem.team, problem.dimension
    model = team.robot_models[robot]
    state = _decimals(problem.start[robot, : model.state_size])
    entry: dict[str, object] = {"model": model.name, "start": state[:dimension], "goal": _decimals(problem.goal[robot])}
    if "velocity" in start_fields(model):
        entry["velocity"] = state[dimension:]
    elif "state" in start_fields(model):
        entry["state"] = state[dimension:]
    else:
        entry |= dict(zip(start_fields(model), state[dimension:], strict=True))
    footprint = team.footprint[robot]
    shape = {"radius": team.radius[[robot]]} if isinstance(footprint, Disc) else {}
    if not shape:
        entry["footprint"] = described(footprint)
    for name in (*shape, "max_speed", "max_acceleration", "max_turn_rate"):
        (entry[name],) = _decimals(np.asarray(getattr(team, name))[[robot]])
    if not np.isnan(problem.goal_heading[robot]):
        for name in ("goal_heading", "goal_heading_tolerance"):
            (entry[name],) = _decimals(getattr(problem, name)[[robot]])
    if model.own_limits:
        names = [limit.name for limit in model.own_limits]
        values = _decimals([np.asarray(team.own_limits[name])[robot] for name in names])
        entry["own_limits"] = dict(zip(names, values, strict=True))
    return entry


def _footprint(entry: RobotEntry) -> Footprint:
    return Disc(entry.radius) if entry.footprint is None else parsed(entry.footprint)


def _describe_world(problem: Problem) -> dict[str, object]:
    world, dimension = problem.world, problem.dimension
    content: dict[str, object] = {}
    if world.lower is not None:
        lower, upper = map(_decimals, world.bounds)
        content["bounds"] = {"lower": lower, "upper": upper}
    if world.origin.any():
        content["origin"] = world.origin.tolist()
    for kind in ("circles", "spheres", "cylinders"):
        rows = [_decimals(row) for row in getattr(world, kind)]
        content[kind] = [{"center": row[:-1], "radius": row[-1]} for row in rows]
    boxes = [_decimals(row) for row in world.boxes]
    content["boxes"] = [{"lower": row[:dimension], "upper": row[dimension:]} for row in boxes]
    content["polygons"] = [{"corners": [_decimals(corner) for corner in corners]} for corners in world.polygons]
    return {kind: entries for kind, entries in content.items() if entries}


def _decimals(values: Iterable[np.float32]) -> list[float]:
    """float32 values as the shortest decimals that read back as the same float32."""
    shortest = [float(str(value)) for value in values]
    # Reading a decimal by way of float64 may round twice; the exact value never does.
    return [number if np.float32(number) == value else float(value) for number, value in zip(shortest, values)]


def _explain(error: ValidationError) -> str:
    """The first error, as one line: where, what was expected, what was found."""
    first = error.errors(include_url=False)[0]
    names = tuple(part for part in first["loc"] if isinstance(part, str))
    parts = [part for part in first["loc"] if part not in KINDS]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")
    if first["type"] == "extra_forbidden" and names[:-1] in PARTS:
        message = f"unknown field; known are {', '.join(PARTS[names[:-1]].model_fields)}"
    elif first["type"] == "missing":
        message = "this field is missing"
    elif first["type"] == "value_error":
        message = str(first["ctx"]["error"])
    else:
        found = repr(first["input"])
        message = (
            f"{first['msg'][0].lower()}{first['msg'][1:]}, not {found if len(found) <= 60 else found[:57] + '...'}"
        )
    return f"{where}: {message}" if where else message
