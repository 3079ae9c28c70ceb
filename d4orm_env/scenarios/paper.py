"""The scenarios that the paper's authors measure on, as their published code of 2026 defines them (section IV-B).

All have 100 steps, whatever the path, and no bounds unless asked for.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from d4orm_env.core.portable import cos, sin
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.generators import antipodal_circle, antipodal_sphere, circle, mixed_team
from d4orm_env.scenarios.layout import Layout, build
from d4orm_env.scenarios.placement import PlacementArea, Points
from d4orm_env.scenarios.settings import OBSTACLES, STARTS_AND_GOALS, Settings, bounded, require_plane

SINGLE_RADIUS = 0.5
"""Radius of a single obstacle [m]."""
SIDE, NEAREST, FURTHEST = 10.0, 5.0, 6.0
"""Side of the random square, and least and largest distance of a start from its goal [m]."""
SPACING = 6
"""Least distance of two random starts, in robots' radii."""
RESTARTS, CANDIDATES = 20, 1000


def paper_sphere(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """The paper's 3D scenario: robots of radius 0.3 m on a Fibonacci sphere of 5 m, goals at the antipodes.

    The sphere is that of scenario ``sphere`` in the mirror, for its azimuths run the other way.

    Args:
        settings: The common arguments; the radius is 0.3 m by default.
        diameter: Diameter of the sphere [m].
    """
    layout = antipodal_sphere(settings, bounded(diameter, "diameter"))
    mirror = np.array([1.0, -1.0, 1.0])
    return build(settings, replace(layout, starts=layout.starts * mirror + 0.0, goals=layout.goals * mirror + 0.0))


def paper_random(settings: Settings) -> Problem:
    """The paper's random 2D scenario: goals on a grid over 10 x 10 m, starts at random 5 to 6 m from them.

    Goals take the first points, row by row, of a ``ceil(sqrt K)`` by ``ceil(sqrt K)`` grid over ``[-5, 5]^2``. A start
    is the first of 1 000 uniform points of the square that is 5 to 6 m from its goal and six radii from all starts
    before it; where none is, all are drawn again, up to 20 times. That places 64 robots, and never 100.
    """
    require_plane(settings)
    goals = _grid(settings.num_robots)
    random = settings.generator(STARTS_AND_GOALS)
    for _ in range(RESTARTS):
        starts = _starts(random, goals, SPACING * float(np.max(settings.team.radius)))
        if len(starts) == len(goals):
            area = PlacementArea(np.full(2, SIDE / 2))
            return build(settings, Layout(starts, goals, World(dimension=2), FURTHEST, area))
    raise ValueError(
        f"scenario {settings.scenario!r}: {settings.num_robots} robots of radius {np.max(settings.team.radius):g} m "
        f"found no room in {RESTARTS} draws; use fewer robots, another seed, or scenario 'random'"
    )


def paper_heterogeneous(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """The paper's heterogeneous circle: holonomic robots (1 m/s^2) and differential drives (2 m/s^2) in turn.

    Robots 0, 2, ... are holonomic. In scenario ``heterogeneous`` they are the drives, and these the slower ones.

    Args:
        settings: The common arguments, ``model`` left out.
        diameter: Diameter of the circle [m].
    """
    mixed = mixed_team(settings, first=("holonomic2d", 1.0), second=("differential_drive", 2.0))
    return circle(mixed, diameter=diameter)


def paper_obstacles(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """The paper's circle with obstacles ("2D Holo X Obs"), ``num_obstacles`` of them, 4 by default.

    One stands in the centre and has a radius of 0.5 m. Two to four stand evenly on the unit circle, from (0, 1) on, and
    more are uniform in the unit disc, where they may overlap; their radius is ``obstacle_radius``, 0.15 m. In 3D they
    are vertical cylinders.

    Args:
        settings: The common arguments.
        diameter: Diameter of the circle [m].
    """
    layout = antipodal_circle(settings, bounded(diameter, "diameter"))
    count = settings.num_obstacles
    radius = SINGLE_RADIUS if count == 1 else settings.obstacle_radius
    obstacles = np.hstack([_obstacle_centres(settings), np.full((count, 1), bounded(radius, "obstacle_radius"))])
    world = World(circles=obstacles) if settings.team.dimension == 2 else World(3, cylinders=obstacles)
    return build(replace(settings, num_obstacles=0), replace(layout, world=world))


def _grid(count: int) -> Points:
    """The first points of the grid that goals stand on, ``(count, 2)``."""
    side = math.isqrt(count - 1) + 1
    across = np.linspace(-SIDE / 2, SIDE / 2, side)
    return np.column_stack([np.tile(across, side), np.repeat(across, side)])[:count]


def _starts(random: np.random.Generator, goals: Points, spacing: float) -> Points:
    """Starts for the goals ``(K, 2)``, one after another; fewer where one finds no room."""
    starts: Points = np.empty((0, 2))
    for goal in goals:
        candidates = random.uniform(-SIDE / 2, SIDE / 2, (CANDIDATES, 2))
        distance = np.linalg.norm(candidates - goal, axis=1)
        candidates = candidates[(distance >= NEAREST) & (distance <= FURTHEST)]
        separation = np.linalg.norm(candidates[:, None] - starts, axis=-1).min(axis=1, initial=np.inf) >= spacing
        if not separation.any():
            break
        starts = np.vstack([starts, candidates[np.argmax(separation)]])
    return starts


def _obstacle_centres(settings: Settings) -> Points:
    """``(num_obstacles, 2)`` [m]."""
    count = settings.num_obstacles
    if count == 1:
        return np.zeros((1, 2))
    if count <= 4:
        angle = 2 * math.pi * np.arange(count) / max(count, 1)
        return np.round(np.column_stack([sin(angle), cos(angle)]), 12) + 0.0
    random = settings.generator(OBSTACLES)
    distance, angle = np.sqrt(random.uniform(size=count)), random.uniform(0, 2 * math.pi, count)
    return distance[:, None] * np.column_stack([cos(angle), sin(angle)])
