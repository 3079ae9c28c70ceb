"""Layout of robots and obstacles, made into a problem: random positions, headings, horizon, bounds, the final check."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, Floats, as_float32, frozen_array, short_repr
from d4orm_env.core.portable import arctan2, root
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import MAX_HORIZON, check_positions
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios.settings import LARGEST, OBSTACLES, STARTS_AND_GOALS, Settings, bounded, require_scale

MIN_HORIZON = 100
HORIZON_SLACK = 1.6

FEW, MANY, ROUNDS = 8, 512, 70
"""Candidates drawn at first and at most at once, and how often, before a position is held to be impossible."""

DENSITY = {2: 0.4, 3: 0.25}
"""Share of the area (volume) that random placement fills without fail; it jams at 0.547 (0.384)."""


FLOOR = np.array([-np.inf, -np.inf, 0.0], np.float32)
"""Lowest coordinates of robots that stand above a floor [m]."""


class PlacementArea(NamedTuple):
    """Region that points are drawn from: a box, or the ellipse (ellipsoid) inside it."""

    half_extent: Floats  #: ``(d,)`` half the sides of the box [m]
    is_round: bool = False  #: Whether it is the ellipse
    centre: Floats | float = 0.0  #: ``(d,)`` [m]

    def contains(self, points: Floats) -> BoolArray:
        """``(C,)`` which of ``(C, d)`` points of the box belong to it."""
        if not self.is_round:
            return np.full(len(points), True)
        extent = np.maximum(self.half_extent, np.finfo(np.float64).tiny)
        return (((points - self.centre) / extent) ** 2).sum(axis=1) <= 1


@dataclass(frozen=True)
class Layout:
    """Positions of a scenario's robots and obstacles."""

    starts: Floats  #: ``(K, d)`` start positions [m]
    goals: Floats  #: ``(K, d)`` goal positions [m]
    world: World  #: Obstacles and bounds of the scenario itself
    #: The distance the horizon is made for [m]: the same for every seed, so that problems that differ in their seed
    #: alone have the same shapes
    travel: float
    #: Region of starts and goals: random obstacles are placed there, and bounds around it. ``None`` where ``world`` has
    #: walls, and its obstacles already.
    area: PlacementArea | None = None


def build(settings: Settings, layout: Layout) -> Problem:
    """The problem of that layout."""
    team, horizon = settings.team, settings.horizon
    if settings.height is not None:
        layout = _lifted(layout, settings.height)
    require_scale(settings, layout.travel)
    world = _with_bounds(settings, layout.world, layout.area)
    _require_inside(settings, world, layout.starts, layout.goals)
    if layout.area is not None:
        world = with_random_obstacles(settings, world, np.vstack([layout.starts, layout.goals]), layout.area)
    _require_margin(settings, world, layout.starts, layout.goals)
    shared = ("dt", "margin", "goal_radius", "goal_speed", "goal_heading", "goal_heading_tolerance", "arrival")
    return Problem(
        team=team,
        start=_start_states(team, layout.starts, layout.goals),
        goal=layout.goals,
        world=world,
        horizon=default_horizon(team, settings.dt, layout.travel) if horizon is None else horizon,
        name=settings.scenario,
        collision_penalty=settings.collision_penalty,
        **{name: getattr(settings, name) for name in shared},
    )


def _lifted(layout: Layout, height: float) -> Layout:
    """The layout with its lowest start or goal at that height [m] above a floor; obstacles reach through any height."""
    positions = np.vstack([layout.starts, layout.goals])
    if positions.shape[1] != 3:
        raise ValueError(
            f"height is {height:g} and the robots move in the plane; leave it out, or use model='holonomic3d'"
        )
    lift = np.array([0.0, 0.0, height - positions[:, 2].min()])
    area, world = layout.area, layout.world
    if area is not None:
        area = area._replace(centre=area.centre + lift)
    if world.lower is not None:
        world = world.replace(lower=np.maximum(world.lower + lift, FLOOR), upper=world.upper + lift)
    return replace(layout, starts=layout.starts + lift, goals=layout.goals + lift, world=world, area=area)


def default_horizon(team: Team, dt: float, distance: float) -> int:
    """Steps that give every robot time to drive ``distance`` [m] and to give way to others.

    At least 100 steps (the paper's horizon); more where 1.6 times the straight drive from rest to rest takes longer,
    rounded up to whole tens. With the default limits and ``dt`` that is 100 steps up to 5.25 m.
    """
    speed, acceleration = np.float64(team.max_speed), np.float64(team.max_acceleration)
    has_inertia = np.array([not model.first_order for model in team.robot_models])
    peak = np.where(has_inertia, np.minimum(speed, np.sqrt(acceleration * distance)), speed)
    drive = float((distance / peak + np.where(has_inertia, peak / acceleration, 0.0)).max())
    # The tolerance keeps limits that float32 cannot hold exactly from adding a step.
    steps = HORIZON_SLACK * drive / dt * (1 - 1e-6)
    if steps > MAX_HORIZON:
        raise ValueError(
            f"a straight drive of {distance:g} m with dt {dt:g} s needs {steps:.3g} steps; "
            f"use a larger dt, faster robots or a shorter path, or give the horizon"
        )
    return max(MIN_HORIZON, 10 * math.ceil(steps / 10))


def _start_states(team: Team, starts: Floats, goals: Floats) -> Floats:
    """``(K, n)`` states at rest; a model that has a heading faces its goal (as in the paper's reference code)."""
    states = np.zeros((team.num_robots, team.state_size))
    states[:, : team.dimension] = starts
    offset = goals - starts
    for robot, model in enumerate(team.robot_models):
        if model.heading_index is not None:
            states[robot, [model.heading_index, *model.start_angles]] = arctan2(offset[robot, 1], offset[robot, 0])
    return states


def _require_margin(settings: Settings, world: World, starts: Floats, goals: Floats) -> None:
    """Check that the surfaces of robots and obstacles are more than the margin apart, at the start and at the goal.

    The problem would have no solution that keeps the margin.
    """
    for what, positions in (("start", starts), ("goal", goals)):
        if fault := check_positions(settings.team, world, what, as_float32(positions), settings.margin):
            raise ValueError(
                f"scenario {settings.scenario!r}: {fault}; make the scenario larger, or the radius or margin smaller"
            )


def _with_bounds(settings: Settings, world: World, area: PlacementArea | None) -> World:
    """The world, with the bounds that were asked for if any were, or a floor and wide bounds above it for a height.

    A margin is laid around the scenario's ``area``, the same for every seed, so that worlds that differ in their seed
    alone have the same bounds.
    """
    if settings.bounds is None and (settings.height is None or area is None or world.lower is not None):
        return world
    if area is None or world.lower is not None:
        raise ValueError(
            f"scenario {settings.scenario!r} has bounds of its own and takes none, not {short_repr(settings.bounds)}; "
            "leave bounds out"
        )
    if isinstance(settings.bounds, list | tuple | np.ndarray):
        lower, upper = frozen_array(settings.bounds, "bounds", (2, world.dimension), largest=LARGEST)
    else:
        margin = area.half_extent.max() if settings.bounds is None else bounded(settings.bounds, "bounds")
        lower, upper = (as_float32(area.centre + way * (area.half_extent + margin)) for way in (-1, 1))
        if settings.height is not None:
            lower = np.maximum(lower, FLOOR)
    return replace(world, lower=lower, upper=upper)


def _require_inside(settings: Settings, world: World, starts: Floats, goals: Floats) -> None:
    """Check that bounds that were asked for, or a floor, leave every start and goal its radius and the margin."""
    if settings.bounds is None and settings.height is None:
        return
    lower, upper = world.bounds.astype(np.float64)
    needed = np.asarray(settings.team.wall_radius, np.float64) + settings.margin
    for what, positions in (("start", starts), ("goal", goals)):
        gaps: Floats = np.minimum(positions - lower, upper - positions).min(axis=1)
        robot = int(np.argmin(gaps - needed))
        if gaps[robot] <= needed[robot]:
            position = ", ".join(f"{coordinate:g}" for coordinate in positions[robot])
            where = f"{gaps[robot]:.3g} m inside" if gaps[robot] >= 0 else f"{-gaps[robot]:.3g} m outside"
            floor, asked = settings.bounds is None, short_repr(settings.bounds)
            asked, remedy = ("above the floor", "a larger height") if floor else (asked, "wider bounds")
            raise ValueError(
                f"scenario {settings.scenario!r}: the {what} of robot_{robot} at ({position}) is {where} the bounds "
                f"{asked}, and its radius and the margin take {needed[robot]:.3g} m; use {remedy}"
            )


def scatter(settings: Settings, size: float) -> tuple[Floats, Floats]:
    """Random starts and goals ``(K, d)`` in the square (cube) of side ``size`` around the origin.

    Starts keep more than the margin to each other, goals likewise, and no robot starts at its goal. Each is drawn
    uniformly, and drawn again until it is free.
    """
    count, dimension = settings.num_robots, settings.team.dimension
    random = settings.generator(STARTS_AND_GOALS)
    area = PlacementArea(np.full(dimension, size / 2))
    needed = max(_size_for(count, settings.spacing, dimension), 3 * settings.goal_radius)
    starts, goals = np.empty((0, dimension)), np.empty((0, dimension))
    flatten = partial(settings.team.flattened, margin=settings.margin)
    for robot in range(count if needed <= size else 0):
        starts = _with_another(random, area, starts, settings.spacing, flatten=flatten)
        goals = _with_another(
            random, area, goals, settings.spacing, (starts[robot:], settings.goal_radius), flatten=flatten
        )
        if min(len(starts), len(goals)) == robot:
            break
    if min(len(starts), len(goals)) < count:
        raise ValueError(
            f"scenario {settings.scenario!r}: {count} robots of radius {np.max(settings.team.radius):g} m with margin "
            f"{settings.margin:g} m do not fit at random in a size of {size:g} m; "
            f"use size={round_up(needed if needed > size else 1.2 * size)}"
        )
    return starts, goals


def _size_for(count: int, spacing: float, dimension: int) -> float:
    """Side of the square (cube) that takes ``count`` random points ``spacing`` apart without fail [m]."""
    ball = math.pi / 4 * spacing * spacing if dimension == 2 else math.pi / 6 * spacing * spacing * spacing
    return root(count * ball / DENSITY[dimension], dimension) if count > 1 else 0.0


def with_random_obstacles(settings: Settings, world: World, positions: Floats, area: PlacementArea) -> World:
    """The world and ``settings.num_obstacles`` random circles, or spheres in space.

    They keep more than the margin to the ``positions`` ``(2 K, d)``, starts, then goals, of which there are none where
    these are drawn later, and leave the largest robot a passage with its margin on both sides, between each other and
    to everything else: no obstacle closes a path.
    """
    if not settings.num_obstacles:
        return world
    random = settings.generator(OBSTACLES)
    size = float(np.float32(settings.obstacle_radius))
    radius = np.float64(settings.team.wall_radius)
    passage = 2 * (float(radius.max()) + settings.margin)
    safety_distance = np.tile(radius, 2) + size + settings.margin
    balls: Floats = np.empty((0, world.dimension))

    def is_free(centres: Floats) -> BoolArray:
        apart = _gaps(centres, positions, safety_distance) > 0
        passable = (world.clearance(centres) > size + passage) & (_gaps(centres, balls, 2 * size + passage) > 0)
        return np.asarray(apart & passable)

    for index in range(settings.num_obstacles):
        ball = _first(random, area, is_free)
        if ball is None:
            raise ValueError(
                f"scenario {settings.scenario!r}: only {index} of {settings.num_obstacles} obstacles of radius "
                f"{size:g} m fit between the robots; use num_obstacles={index}, a smaller obstacle_radius or a larger "
                f"scenario"
            )
        balls = np.vstack([balls, ball])
    rows = np.vstack([world.balls, np.hstack([balls, np.full((len(balls), 1), size)])])
    return replace(world, circles=rows) if world.dimension == 2 else replace(world, spheres=rows)


def round_up(value: float) -> str:
    """A length rounded up to the next centimetre, for an error that says what would do."""
    return f"{math.floor(value * 100) / 100 + 0.01:.2f}" if value < 1e6 else f"{value * 1.01:.2e}"


def _with_another(
    random: np.random.Generator, area: PlacementArea, points: Floats, spacing: float, *others: tuple[Floats, float],
    flatten: Callable[[Floats], Floats],
) -> Floats:  # fmt: skip
    """``points`` and a random one further than ``spacing`` from each, or just ``points`` if there is no room.

    It keeps a distance of their own from each of ``others`` too. Spacing is measured between flattened positions.
    """

    def is_free(candidates: Floats) -> BoolArray:
        spaced = _gaps(flatten(candidates), flatten(points), spacing) > 0
        return np.all([spaced, *(_gaps(candidates, *kept) > 0 for kept in others)], axis=0)

    position = _first(random, area, is_free)
    return points if position is None else np.vstack([points, position])


def _first(random: np.random.Generator, area: PlacementArea, is_free: Callable[[Floats], BoolArray]) -> Floats | None:
    """The first uniform random point of an area that is free, or ``None`` if none of many was."""
    half = area.half_extent
    for attempt in range(ROUNDS):
        points = area.centre + random.uniform(-half, half, (min(FEW << attempt, MANY), len(half)))
        # Rounded as the problem will hold them, so that what is checked is what is used.
        points = points.astype(np.float32).astype(np.float64)
        free = area.contains(points) & is_free(points)
        if free.any():
            return points[np.argmax(free)]
    return None


def _gaps(candidates: Floats, points: Floats, safety_distance: Floats | float) -> Floats:
    """``(C,)`` least distance of each candidate to points, less what they keep; infinite where there are none [m]."""
    if not len(points):
        return np.full(len(candidates), np.inf)
    return (np.linalg.norm(candidates[:, None] - points, axis=-1) - safety_distance).min(axis=1)
