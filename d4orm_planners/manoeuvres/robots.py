"""A robot as the search knows it: what it can do, how large its lattice is, and how far every pose is from its goal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.footprint_gaps import pair_gap, world_gap
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, TURN_RATE, Model
from d4orm_planners.manoeuvres.heaps import Heap
from d4orm_planners.manoeuvres.lattice import PoseLattice, RobotBody, fill_costs
from d4orm_planners.manoeuvres.primitives import MOVES, SECTOR, SECTORS, Kind, Mode, Primitives, primitives_of
from d4orm_planners.manoeuvres.snapping import NOWHERE, SIDEWAYS, TURNING, Goal, Limits

CELLS_PER_RADIUS = 3
"""Cells in the outer radius of the largest robot."""
TEAM_CELLS, LEAST_CELLS, MOST_CELLS = 4_000_000, 150_000, 400_000
"""Cells of the costs of all robots together, and the least and the most of one: a larger world has larger cells."""
ROOM = 4
"""Room round starts and goals in a world without bounds, in diameters of the largest robot."""
CLEARANCE = 0.15
"""Distance kept from everything beyond the margin, in what the fastest robot drives in a step: what is between the
poses that are checked is near to these."""
CUTTING = 0.7
"""How far a corner may get into another between two poses that are checked, in what the fastest robot drives."""
MAX_PARTS = 8
"""Most poses that are looked at in a step."""
CERTAIN = 0.98
"""Share of a goal's radius, heading tolerance and speed within which a robot is there beyond doubt."""


class Area(NamedTuple):
    """The room that robots may use, and the largest cell that a lattice of it needs [m]."""

    low: Floats
    high: Floats
    cell: float


def can_plan(problem: Problem) -> bool:
    """Check whether robots have primitives, start at rest, and are no discs or must face somewhere at their goals."""
    team = problem.team
    if problem.dimension != 2 or not set(team.models) <= set(MOVES):
        return False
    if not team.shapes and np.isnan(problem.goal_heading).all():
        return False
    extras = [problem.start[robot, _extra(model) : model.state_size] for robot, model in enumerate(team.robot_models)]
    return not any(extra.any() for extra in extras)


def _extra(model: Model) -> int:
    """Number of the first state component beyond position and heading."""
    return model.dimension if model.heading_index is None else model.heading_index + 1


def area_of(problem: Problem) -> Area:
    """The room that robots may use."""
    places = np.concatenate([problem.start[:, :2], problem.goal]).astype(np.float64)
    largest = float(problem.team.radius.max())
    low, high = places.min(axis=0) - 2 * ROOM * largest, places.max(axis=0) + 2 * ROOM * largest
    if problem.world.num_obstacles:
        lower, upper = problem.world.shapes.extent()
        low, high = np.minimum(low, lower - 4 * largest), np.maximum(high, upper + 4 * largest)
    low = np.maximum(low, problem.world.bounds[0])
    high = np.minimum(high, problem.world.bounds[1])
    return Area(low, high, largest / CELLS_PER_RADIUS)


def plain_arrays(problem: Problem, reach: float) -> ProblemArrays:
    """The problem's arrays, of one type for all problems, with an index of all obstacles within reach."""
    index = problem.world.index(reach, within=reach)
    return problem.arrays._replace(
        grid=index, turns_at_goals=None, goal_direction=None, squared_goal_chord=None, footprints=None
    )


def distance_kept(problem: Problem) -> float:
    """Distance that robots keep from everything [m]; less where starts or goals leave less room."""
    team, largest = problem.team, float(problem.team.radius.max())
    room, usual = np.inf, problem.margin + problem.rounding + CLEARANCE * problem.stride
    turned = np.where([model.heading_index is None for model in team.robot_models], 0, problem.goal_heading)
    for places, headings in ((problem.start[:, :2], team.headings(problem.start)), (problem.goal, turned)):
        poses = np.column_stack([places, headings]).astype(np.float64)
        for robot in np.flatnonzero(problem.world.clearance(places) - team.radius < usual):
            room = min(room, world_gap(problem.world, team.footprint[robot], poses[robot]))
        for one, other in combinations(range(len(poses)), 2):
            if np.linalg.norm(poses[one, :2] - poses[other, :2]) < 2 * largest + usual:
                room = min(room, pair_gap(team.footprint[one], poses[one], team.footprint[other], poses[other]))
    return min(usual, 0.9 * room)


@dataclass(frozen=True, eq=False)
class Robot:
    """What the search knows of a robot.

    Attributes:
        number: Its number.
        model: Its model.
        start: ``(3,)`` pose.
        goal: Where to.
        limits: For the last stretch.
        body: Among the obstacles.
        primitives: What it can do.
        modes: Speeds and angles of each mode.
        lattice: Cells and sectors round its start's heading, ...
        costs_lattice: ... and its goal's.
        costs: ``(cells,)`` steps to the goal.
        far: Steps from where that is not known, at least.
    """

    number: int
    model: Model
    start: Floats
    goal: Goal
    limits: Limits
    body: RobotBody
    primitives: Primitives
    modes: tuple[Mode, ...]
    lattice: PoseLattice
    costs_lattice: PoseLattice
    costs: FloatArray
    far: float


def make_robot(problem: Problem, number: int, area: Area, arrays: ProblemArrays, extra: float) -> Robot:
    """Prepare the search for a robot of a team."""
    team, model = problem.team, problem.team.robot_models[number]
    own = team.limits[number].astype(np.float64)
    sectors = 1 if model.heading_index is None else SECTORS
    kind = Kind(model.name, tuple(own[: len(model.limit_names)].tolist()), problem.dt, area.cell)
    primitives, _, modes = primitives_of(kind)
    cells = np.clip(TEAM_CELLS / problem.num_robots, LEAST_CELLS, MOST_CELLS)
    wide = max(area.cell, round(float(np.sqrt(np.prod(area.high - area.low) * len(modes) * sectors / cells)), 3))
    back = primitives_of(replace(kind, cell=wide))[1]
    heading = float(problem.goal_heading[number]) if sectors > 1 else 0.0
    towards = _lattice(area, wide, 0.0 if np.isnan(heading) else heading, sectors)
    start = np.zeros(3)
    start[: _extra(model)] = problem.start[number, : _extra(model)]
    goal = _goal(problem, number, heading if sectors > 1 else np.nan)
    parts = int(np.ceil(CUTTING * problem.stride / extra))
    body = RobotBody(
        team.all_footprint_arrays, arrays, number, np.float32(extra), problem.stride, min(parts, MAX_PARTS)
    )
    costs, far, limits = np.zeros(0, np.float32), np.inf, _limits(model, own, problem.dt)
    if problem.world.num_obstacles or limits.way == NOWHERE:
        costs, far = _costs(body, back, towards, goal, start, 1 / (own[SPEED] * problem.dt))
    return Robot(
        number, model, start, goal, limits, body, primitives, modes,
        _lattice(area, area.cell, float(start[2]), sectors), towards, costs, far,
    )  # fmt: skip


def _lattice(area: Area, cell: float, heading: float, sectors: int) -> PoseLattice:
    size = np.ceil((area.high - area.low) / cell).astype(int).tolist()
    return PoseLattice(area.low, 1 / cell, (size[0], size[1]), heading, sectors)


def _limits(model: Model, own: Floats, dt: float) -> Limits:
    way = SIDEWAYS if model.heading_index is None else TURNING if model.turns_in_place else NOWHERE
    acceleration = np.inf if model.first_order else own[ACCELERATION]
    return Limits(way, float(own[SPEED]), float(acceleration), float(own[TURN_RATE]), float(np.float32(dt)))


def _goal(problem: Problem, number: int, heading: float) -> Goal:
    return Goal(
        float(problem.goal[number, 0]), float(problem.goal[number, 1]), heading, problem.goal_radius * CERTAIN,
        float(problem.goal_heading_tolerance[number]) * CERTAIN, float(problem.goal_speed[number]) * CERTAIN,
        problem.docks,
    )  # fmt: skip


def _costs(
    body: RobotBody, back: Primitives, lattice: PoseLattice, goal: Goal, start: Floats, pace: float
) -> tuple[FloatArray, float]:
    """Steps to the goal from all cells, and from where they are not known."""
    cells = len(back.rests) * lattice.sectors * lattice.size[0] * lattice.size[1]
    headings = [goal.heading] if not np.isnan(goal.heading) else np.arange(lattice.sectors) * SECTOR
    goals = np.array([[goal.x, goal.y, heading] for heading in headings])
    costs = np.full(cells, np.inf, np.float32)
    known = fill_costs(body, back, lattice, goals, start, pace, costs, np.empty((cells, 3)), Heap.of(2 * cells + 512))
    return costs, known
