"""Layout of robots and obstacles, made into a problem: headings, horizon, bounds, random obstacles, the final check."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import as_float32, frozen_array, short_repr
from d4orm_env.core.portable import arctan2
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import MAX_HORIZON, check_positions
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios.placement import PlacementArea, Points, with_random_obstacles
from d4orm_env.scenarios.settings import LARGEST, Settings, bounded

MIN_HORIZON = 100
HORIZON_SLACK = 1.6


@dataclass(frozen=True)
class Layout:
    """Positions of a scenario's robots and obstacles."""

    starts: Points  #: ``(K, d)`` start positions [m]
    goals: Points  #: ``(K, d)`` goal positions [m]
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
    positions = np.vstack([layout.starts, layout.goals])
    world = with_bounds(settings, layout.world, layout.area)
    require_inside(settings, world, layout.starts, layout.goals)
    if layout.area is not None:
        world = with_random_obstacles(settings, world, positions, layout.area)
    require_margin(settings, world, layout.starts, layout.goals)
    return Problem(
        team=team,
        start=start_states(team, layout.starts, layout.goals),
        goal=layout.goals,
        world=world,
        dt=settings.dt,
        horizon=default_horizon(team, settings.dt, layout.travel) if horizon is None else horizon,
        margin=settings.margin,
        goal_radius=settings.goal_radius,
        goal_speed=settings.goal_speed,
        goal_heading=settings.goal_heading,
        goal_heading_tolerance=settings.goal_heading_tolerance,
        name=settings.scenario,
        arrival=settings.arrival,
        collision_penalty=settings.collision_penalty,
    )


def _lifted(layout: Layout, height: float) -> Layout:
    """The layout with its lowest start or goal at that height [m]; obstacles of scenarios reach through all heights."""
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
        world = world.replace(lower=world.lower + lift, upper=world.upper + lift)
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


def start_states(team: Team, starts: Points, goals: Points) -> Points:
    """``(K, n)`` states at rest; a model that has a heading faces its goal (as in the paper's reference code)."""
    states = np.zeros((team.num_robots, team.state_size))
    states[:, : team.dimension] = starts
    offset = goals - starts
    for robot, model in enumerate(team.robot_models):
        if model.heading_index is not None:
            states[robot, [model.heading_index, *model.start_angles]] = arctan2(offset[robot, 1], offset[robot, 0])
    return states


def in_space(points: ArrayLike, dimension: int) -> Points:
    """``(., 2)`` points of the plane as ``(., dimension)``: in space, at z = 0."""
    planar: Points = np.asarray(points, np.float64).reshape(-1, 2)
    return planar if dimension == 2 else np.hstack([planar, np.zeros((len(planar), 1))])


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


def require_margin(settings: Settings, world: World, starts: Points, goals: Points) -> None:
    """Check that the surfaces of robots and obstacles are more than the margin apart, at the start and at the goal.

    The problem would have no solution that keeps the margin.
    """
    for what, positions in (("start", starts), ("goal", goals)):
        fault = check_positions(settings.team, world, what, as_float32(positions), settings.margin)
        if fault:
            raise ValueError(
                f"scenario {settings.scenario!r}: {fault}; make the scenario larger, or the radius or margin smaller"
            )


def with_bounds(settings: Settings, world: World, area: PlacementArea | None) -> World:
    """The world, with the bounds that were asked for if any were.

    A margin is laid around the scenario's ``area``, the same for every seed, so that worlds that differ in their seed
    alone have the same bounds.
    """
    if settings.bounds is None:
        return world
    if area is None or world.lower is not None:
        raise ValueError(
            f"scenario {settings.scenario!r} has bounds of its own and takes none, not {short_repr(settings.bounds)}; "
            "leave bounds out"
        )
    if isinstance(settings.bounds, list | tuple | np.ndarray):
        lower, upper = frozen_array(settings.bounds, "bounds", (2, world.dimension), largest=LARGEST)
    else:
        out = area.half_extent + bounded(settings.bounds, "bounds")
        lower, upper = as_float32(area.centre - out), as_float32(area.centre + out)
    return replace(world, lower=lower, upper=upper)


def require_inside(settings: Settings, world: World, starts: Points, goals: Points) -> None:
    """Check that the bounds that were asked for leave every start and goal its radius and the margin."""
    if settings.bounds is None:
        return
    lower, upper = world.bounds.astype(np.float64)
    needed = np.asarray(settings.team.radius, np.float64) + settings.margin
    for what, positions in (("start", starts), ("goal", goals)):
        gaps: NDArray[np.float64] = np.minimum(positions - lower, upper - positions).min(axis=1)
        robot = int(np.argmin(gaps - needed))
        if gaps[robot] <= needed[robot]:
            position = ", ".join(f"{coordinate:g}" for coordinate in positions[robot])
            where = f"{gaps[robot]:.3g} m inside" if gaps[robot] >= 0 else f"{-gaps[robot]:.3g} m outside"
            raise ValueError(
                f"scenario {settings.scenario!r}: the {what} of robot_{robot} at ({position}) is {where} the bounds "
                f"{short_repr(settings.bounds)}, and its radius and the margin take {needed[robot]:.3g} m; use wider "
                "bounds"
            )
