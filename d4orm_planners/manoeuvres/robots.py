"""Robots as the search knows them: their primitives, lattices, costs to their goals, and distances that they keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.gaps import nearest, world_gap
from d4orm_env.core.goal_poses import states_at_goals
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.holonomic2d_jerk import HOLONOMIC2D_JERK
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, TURN_RATE, Model
from d4orm_env.dynamics.unicycle2 import MAX_TURN_ACCELERATION, UNICYCLE2
from d4orm_planners.manoeuvres.coming_to_rest import can_brake, first_inert, motion
from d4orm_planners.manoeuvres.costs import Area, Costs, costs_of
from d4orm_planners.manoeuvres.curves import NO_CURVES, curves_of
from d4orm_planners.manoeuvres.kinds import Kind
from d4orm_planners.manoeuvres.lattice import RobotBody
from d4orm_planners.manoeuvres.nodes import Task
from d4orm_planners.manoeuvres.primitives import MOVES, POSE_SIZE, primitives_of
from d4orm_planners.manoeuvres.snapping import CURVING, NOWHERE, SIDEWAYS, TURNING, Goal, Limits

CELLS_PER_RADIUS = 3  #: Cells in the outer radius of the largest robot
ROOM = 4  #: Room round starts and goals in a world without bounds, in diameters of the largest robot
CLEARANCE = 0.15
"""Distance kept from everything beyond the margin, in what the fastest robot drives in a step: what is between the
poses that are checked is near to these."""
CUTTING = 0.7
"""Depth to which a corner may get into another between two checked poses, as a share of the fastest stride."""
MAX_PARTS = 8  #: Most poses that are looked at in a step
CERTAIN = 0.98
"""Share of a goal's radius, heading tolerance and speed within which a robot is at its goal beyond doubt."""
WEIGHT = 1.5  #: Factor by which the steps ahead of a node count more than those behind it
DEPARTURE_INTERVAL = 0.7
"""Time between departures that are tried, as a share of that in which the fastest robot drives the radius of the
largest one."""


class ManoeuvreScene(NamedTuple):
    """Data that all robots of a team share."""

    problem: Problem
    area: Area  #: The part of the plane that robots may use
    #: The problem's arrays, of one type for all problems, with an index of all obstacles within reach
    arrays: ProblemArrays
    extra: float  #: Distance kept from everything [m]
    bent: BoolArray  #: ``(K,)`` whether trailers have to be in a bend at the robot's goal
    finest: float = 0.0  #: Size of cells near to starts and goals, zero for the usual one [m]

    @property
    def interaction_range(self) -> float:
        """Distance beyond which two robots do not matter to each other in a step [m]."""
        return 2 * float(self.problem.team.radius.max()) + self.extra + 2 * self.problem.stride

    def with_cells(self, share: float) -> ManoeuvreScene:
        """The same with cells of another size, a share of this one's."""
        return self._replace(area=self.area._replace(cell=share * self.area.cell))

    def with_finer_cells(self, share: float) -> ManoeuvreScene:
        """The same with cells near to starts and goals of another size, a share of the others'."""
        return self._replace(finest=share * self.area.cell)

    def body(self, robot: int) -> RobotBody:
        """A robot among the obstacles."""
        footprints, stride = self.problem.team.all_footprint_arrays, self.problem.stride
        parts = min(int(np.ceil(CUTTING * stride / self.extra)), MAX_PARTS)
        return RobotBody(footprints, self.arrays, robot, np.float32(self.extra), stride, parts)


def scene_of(problem: Problem) -> ManoeuvreScene:
    """The data that all robots of a team share."""
    team, bent = problem.team, must_bend(problem)
    extra = distance_kept(problem, bent)
    index = problem.world.index(float(team.radius.max()) + extra, within=float(team.radius.max()) + extra)
    arrays = problem.arrays._replace(
        grid=index, turns_at_goals=None, goal_direction=None, squared_goal_chord=None, footprints=None
    )
    return ManoeuvreScene(problem, area_of(problem), arrays, extra, bent)


def can_plan(problem: Problem) -> bool:
    """Check whether all robots have primitives and start at rest, and any has a footprint or a goal heading.

    Robots on their way come to rest first, if one of them turns only as it drives: others need not to turn at goals.
    """
    team = problem.team
    if problem.dimension != 2 or not set(team.models) <= set(MOVES):
        return False
    if not team.shapes and np.isnan(problem.goal_heading).all():
        return False
    moving = motion(problem, problem.start).any(axis=1)
    return not moving.any() or (bool((moving & (team.turning_radius > 0)).any()) and can_brake(problem))


def area_of(problem: Problem) -> Area:
    """The part of the plane that robots may use."""
    positions = np.concatenate([problem.start[:, :2], problem.goal]).astype(np.float64)
    largest = float(problem.team.radius.max())
    low, high = positions.min(axis=0) - 2 * ROOM * largest, positions.max(axis=0) + 2 * ROOM * largest
    if problem.world.num_obstacles:
        lower, upper = problem.world.shapes.extent()
        low, high = np.minimum(low, lower - 4 * largest), np.maximum(high, upper + 4 * largest)
    low = np.maximum(low, problem.world.bounds[0])
    high = np.minimum(high, problem.world.bounds[1])
    return Area(low, high, largest / CELLS_PER_RADIUS)


def distance_kept(problem: Problem, bent: BoolArray) -> float:
    """Distance that robots keep from everything [m]; less where starts or goals leave less room, but for trailers that
    are in a bend there.
    """
    team, usual = problem.team, problem.margin + problem.rounding + CLEARANCE * problem.stride
    goals = _at_goals(problem)
    for robot, model in enumerate(team.robot_models):
        if bent[robot]:
            goals[robot, model.heading_index] = np.nan
    return min(usual, 0.9 * min(nearest(problem, problem.start, usual), nearest(problem, goals, usual)))


def _at_goals(problem: Problem) -> FloatArray:
    """``(K, n)`` states in which robots are at their goals, trailers in line unless hitch angles are asked for."""
    goals = states_at_goals(problem)
    for robot, model in enumerate(problem.team.robot_models):
        hitches = [hitch for hitch, _ in model.trailers]
        goals[robot, hitches] = np.nan_to_num(goals[robot, hitches])
    return goals


def must_bend(problem: Problem) -> BoolArray:
    """``(K,)`` whether trailers in line would overlap with an obstacle or a bound at the robot's goal."""
    team, poses, bent = problem.team, problem.team.body_poses(_at_goals(problem)), np.zeros(problem.num_robots, bool)
    for body, pose in zip(team.bodies, poses, strict=True):
        free = np.isnan(problem.goal_hitches[body.robot]).all()
        if team.robot_models[body.robot].trailers and free and not np.isnan(pose).any():
            bent[body.robot] |= world_gap(problem.world, body.footprint, pose) <= 0
    return bent


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot, as the search reads it."""

    model: Model
    kind: Kind  #: On which its primitives depend
    start: Floats  #: ``(6,)`` pose
    mode: int  #: That it starts in
    task: Task  #: What a search for its motion is told


def make_robot(scene: ManoeuvreScene, number: int, goal: Goal | None = None) -> Robot | None:
    """Prepare the search for a robot of a team, to its own goal or another one with trailers in line; ``None`` if its
    trailers cannot be brought in line from the start.
    """
    problem, area, body = scene.problem, scene.area, scene.body(number)
    model = problem.team.robot_models[number]
    state = problem.start[number, : model.state_size].astype(np.float64).tolist()
    limits = problem.team.limits[number, : len(model.limit_names)].astype(np.float64).tolist()
    begin = tuple(state[first_inert(model) :])
    kind = Kind(model.name, tuple(limits), problem.dt, area.cell, begin, scene.finest)
    primitives, _, modes = primitives_of(kind)
    if kind.start not in modes:
        return None
    start, goal, last = np.zeros(POSE_SIZE), goal or make_goal(problem, number), _limits(kind)
    start[: first_inert(model)] = state[: first_inert(model)]
    start[3 : 3 + len(model.trailers)] = state[3 : 3 + len(model.trailers)]
    lattice = area.lattice(kind, float(start[2]), start, goal, len(modes))
    wanted = tuple(np.nan_to_num(goal.hitches[: len(model.trailers)]).tolist())
    hitches = wanted if any(wanted) else None
    bent = bool(scene.bent[number]) or hitches is not None
    costs = Costs(lattice, np.zeros(0, np.float32), np.inf, 0.0, (0.0, 0.0))
    if scene.finest == 0 and (problem.world.num_obstacles or last.way in (NOWHERE, CURVING)):
        costs = costs_of(kind, area, body, start, goal, problem.num_robots, bent)
    curves = curves_of(kind.base, bent, hitches) if last.way == CURVING else NO_CURVES
    interval = max(1, round(DEPARTURE_INTERVAL * float(problem.team.radius.max()) / problem.stride))
    in_line, horizon = last.way == CURVING and curves.last == 0, problem.horizon
    task = Task(body, primitives, last, curves, goal, lattice, costs, WEIGHT, interval, horizon, in_line, number=0)
    return Robot(model, kind, start, modes.index(kind.start), task)


def _limits(kind: Kind) -> Limits:
    model, own, lower = kind.model, kind.limits, kind.lower
    way = TURNING if model.turns_in_place else CURVING if model.first_order else NOWHERE
    if model.heading_index is None:
        way = NOWHERE if model.name == HOLONOMIC2D_JERK.name else SIDEWAYS
    swing = own[MAX_TURN_ACCELERATION] if model.name == UNICYCLE2.name else np.inf
    return Limits(
        way, own[SPEED], lower[SPEED],
        np.inf if model.first_order else own[ACCELERATION], own[TURN_RATE], lower[TURN_RATE], swing,
        float(np.float32(kind.dt)),
    )  # fmt: skip


def make_goal(problem: Problem, number: int) -> Goal:
    """A robot's goal."""
    heading = np.nan if problem.team.robot_models[number].heading_index is None else problem.goal_heading[number]
    return Goal(
        float(problem.goal[number, 0]), float(problem.goal[number, 1]), float(heading),
        tuple(problem.goal_hitches[number].astype(np.float64).tolist()), problem.goal_radius * CERTAIN,
        float(problem.goal_heading_tolerance[number]) * CERTAIN, float(problem.goal_speed[number]) * CERTAIN,
        problem.docks,
    )  # fmt: skip
