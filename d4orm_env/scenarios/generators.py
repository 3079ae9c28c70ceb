"""The scenarios without walls. Each is a function from the common settings and its own arguments to a problem.

The ``paper_`` ones are those that the paper's authors measure on, as their published code of 2026 defines them (section
IV-B). All of these have 100 steps, whatever the path, and no bounds unless asked for.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import Floats
from d4orm_env.core.portable import cos, root, sin
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.layout import Layout, PlacementArea, build, round_up, scatter
from d4orm_env.scenarios.settings import OBSTACLES, STARTS_AND_GOALS, Settings, bounded, require_dimension

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

SINGLE_RADIUS = 0.5
"""Radius of a single obstacle of :func:`paper_obstacles` [m]."""
SIDE, NEAREST, FURTHEST = 10.0, 5.0, 6.0
"""Side of the square of :func:`paper_random`, and least and largest distance of a start from its goal [m]."""
SPACING = 6
"""Least distance of two of its starts, in robots' radii."""
RESTARTS, CANDIDATES = 20, 1000
"""Number of times that all of its starts are drawn, and points for each."""


def circle(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """Robots evenly on a circle, each with its goal at the antipodal point.

    The paper's benchmark (section IV-B). Robot ``k`` starts at the angle ``2 pi k / K``. Nothing in it is random but
    obstacles. A team of ``holonomic3d`` robots is on the circle in the plane z = 0. Random obstacles lie inside the
    circle.

    Args:
        settings: The common arguments.
        diameter: Diameter of the circle [m].
    """
    return build(settings, antipodal_circle(settings, bounded(diameter, "diameter")))


def sphere(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """Robots evenly on a sphere (Fibonacci points), each with its goal at the antipodal point; 3D.

    As on the circle, a goal may lie where another robot started. Random obstacles lie inside the sphere.

    Args:
        settings: The common arguments.
        diameter: Diameter of the sphere [m].
    """
    return build(settings, antipodal_sphere(settings, bounded(diameter, "diameter")))


def random(settings: Settings, *, size: float | None = None) -> Problem:
    """Random starts and goals in a square, or in a cube for 3D robots; set by the seed.

    The square is centred on the origin and holds the centres of the robots; the world has no bounds unless asked for.
    Starts keep more than the margin to each other, and goals to each other. The horizon is made for the diagonal.

    Args:
        settings: The common arguments.
        size: Side of the square or cube [m]. By default ``max(5, 1.25 K^(1/d))``: 5 m up to 16 robots in the plane, and
            the density of 64 robots in 10 x 10 m beyond.
    """
    dimension = settings.team.dimension
    if size is None:
        size = max(5.0, 1.25 * root(settings.num_robots, dimension))
    size = bounded(size, "size")
    starts, goals = scatter(settings, size)
    area = PlacementArea(np.full(dimension, size / 2))
    return build(settings, Layout(starts, goals, World(dimension=dimension), size * math.sqrt(dimension), area))


def four_obstacles(settings: Settings, *, diameter: float = 5.0, obstacle_distance: float = 1.0) -> Problem:
    """The circle with four round obstacles about its centre.

    The paper gives no coordinates for its "2D Holo 4 Obs". Here the obstacles are at ``(+-1, 0)`` and ``(0, +-1)``,
    radius 0.15 m (``obstacle_radius``): on the straight paths of robots 0, K/4, K/2 and 3K/4, and around where all
    paths cross. In 3D they are vertical cylinders. Random obstacles come on top.

    Args:
        settings: The common arguments.
        diameter: Diameter of the circle of robots [m].
        obstacle_distance: Distance of each obstacle's centre from the origin [m].
    """
    layout = antipodal_circle(settings, bounded(diameter, "diameter"))
    distance = bounded(obstacle_distance, "obstacle_distance")
    centres = distance * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    return build(settings, replace(layout, world=_pillars(settings, centres, settings.obstacle_radius)))


def heterogeneous(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """The circle with differential drives and holonomic2d robots in turn, with different acceleration limits.

    The paper's heterogeneous team (section IV-B). Robots 0, 2, ... are differential drives with 1 m/s^2 that face their
    goals, robots 1, 3, ... are holonomic with 2 m/s^2; ``max_acceleration`` replaces both limits.

    Args:
        settings: The common arguments, ``model`` left out.
        diameter: Diameter of the circle [m].
    """
    return circle(mixed_team(settings, ("differential_drive", 1.0), ("holonomic2d", 2.0)), diameter=diameter)


def swap(settings: Settings, *, distance: float = 5.0, spacing: float | None = None) -> Problem:
    """Two rows of robots that face each other and exchange places.

    Every robot's goal is straight across, where the robot that faces it starts. With an odd number the first row is one
    longer. Random obstacles lie between the rows.

    Args:
        settings: The common arguments.
        distance: Distance between the rows [m].
        spacing: Distance between neighbours in a row [m]; by default twice the least that keeps the margin.
    """
    least = settings.spacing
    distance = bounded(distance, "distance")
    spacing = bounded(2 * least if spacing is None else spacing, "spacing")
    for name, value in (("distance", distance), ("spacing", spacing)):
        if value <= least and settings.num_robots > 1:
            raise _too_small(settings, name, value, least)
    first = (settings.num_robots + 1) // 2
    row = (np.arange(first) - (first - 1) / 2) * spacing
    y = np.concatenate([row, row[: settings.num_robots - first]])
    x = np.where(np.arange(settings.num_robots) < first, -distance / 2, distance / 2)
    dimension = settings.team.dimension
    starts, goals = (_in_space(np.column_stack([side, y]), dimension) for side in (x, -x))
    area = PlacementArea(_in_space([distance / 2, first * spacing / 2], dimension)[0])
    return build(settings, Layout(starts, goals, World(dimension=dimension), distance, area))


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
    require_dimension(settings, 2)
    side = math.isqrt(settings.num_robots - 1) + 1
    across = np.linspace(-SIDE / 2, SIDE / 2, side)
    goals: Floats = np.column_stack([np.tile(across, side), np.repeat(across, side)])[: settings.num_robots]
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
    return circle(mixed_team(settings, ("holonomic2d", 1.0), ("differential_drive", 2.0)), diameter=diameter)


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
    radius = SINGLE_RADIUS if settings.num_obstacles == 1 else settings.obstacle_radius
    world = _pillars(settings, _obstacle_centres(settings), bounded(radius, "obstacle_radius"))
    return build(replace(settings, num_obstacles=0), replace(layout, world=world))


def fibonacci_sphere(count: int) -> Floats:
    """``(count, 3)`` Fibonacci points on the unit sphere: equal areas in z, the golden angle around it."""
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * cos(index * GOLDEN_ANGLE), across * sin(index * GOLDEN_ANGLE), z])


def mixed_team(settings: Settings, first: tuple[str, float], second: tuple[str, float]) -> Settings:
    """The settings with two models in turn, each with its limit of acceleration [m/s^2] unless one is given."""
    if settings.model is not None:
        raise ValueError(
            f"scenario {settings.scenario!r} mixes {first[0]} and {second[0]} itself and takes no model, "
            f"not {settings.model!r}; leave it out, or give one name per robot to scenario 'circle'"
        )
    models, limits = zip(*((first, second)[robot % 2] for robot in range(settings.num_robots)), strict=True)
    given = settings.max_acceleration
    return replace(settings, model=models, max_acceleration=np.array(limits) if given is None else given)


def antipodal_sphere(settings: Settings, diameter: float) -> Layout:
    """Robots on the Fibonacci points of a sphere, goals at the antipodes."""
    require_dimension(settings, 3)
    points = fibonacci_sphere(settings.num_robots)
    flat = settings.team.flattened(points, settings.margin)
    gaps = (np.linalg.norm(flat[:index] - flat[index], axis=1).min() for index in range(1, len(flat)))
    needed = 2 * settings.spacing / float(min(gaps, default=np.inf))
    if needed >= diameter:
        raise _too_small(settings, "diameter", diameter, needed)
    starts, goals = _antipodal(points * (diameter / 2))
    area = PlacementArea(np.full(3, diameter / 2), is_round=True)
    return Layout(starts, goals, World(dimension=3), diameter, area)


def antipodal_circle(settings: Settings, diameter: float) -> Layout:
    """Robots evenly on a circle, goals at the antipodes."""
    count, dimension = settings.num_robots, settings.team.dimension
    needed = settings.spacing / float(sin(math.pi / count)) if count > 1 else 0.0
    if needed >= diameter:
        raise _too_small(settings, "diameter", diameter, needed)
    angle = 2 * math.pi * np.arange(count) / count
    points = diameter / 2 * np.column_stack([cos(angle), sin(angle)])
    starts, goals = _antipodal(_in_space(points, dimension))
    area = PlacementArea(_in_space([diameter / 2, diameter / 2], dimension)[0], is_round=True)
    return Layout(starts, goals, World(dimension=dimension), diameter, area)


def _in_space(points: ArrayLike, dimension: int) -> Floats:
    """``(., 2)`` points of the plane as ``(., dimension)``: in space, at z = 0."""
    planar: Floats = np.asarray(points, np.float64).reshape(-1, 2)
    return planar if dimension == 2 else np.hstack([planar, np.zeros((len(planar), 1))])


def _pillars(settings: Settings, centres: Floats, radius: float) -> World:
    """The open world of round obstacles at centres ``(., 2)`` [m]: circles, or vertical cylinders in space."""
    obstacles = np.column_stack([centres, np.full(len(centres), radius)])
    return World(circles=obstacles) if settings.team.dimension == 2 else World(3, cylinders=obstacles)


def _antipodal(points: Floats) -> tuple[Floats, Floats]:
    """Starts and goals, rid of rounding dust such as 3e-16 and -0.0, which files and pictures would show."""
    starts: Floats = np.round(points, 12) + 0.0
    return starts, 0.0 - starts


def _starts(random: np.random.Generator, goals: Floats, spacing: float) -> Floats:
    """Starts for the goals ``(K, 2)``, one after another; fewer where one finds no room."""
    starts: Floats = np.empty((0, 2))
    for goal in goals:
        candidates = random.uniform(-SIDE / 2, SIDE / 2, (CANDIDATES, 2))
        distance = np.linalg.norm(candidates - goal, axis=1)
        candidates = candidates[(distance >= NEAREST) & (distance <= FURTHEST)]
        separation = np.linalg.norm(candidates[:, None] - starts, axis=-1).min(axis=1, initial=np.inf) >= spacing
        if not separation.any():
            break
        starts = np.vstack([starts, candidates[np.argmax(separation)]])
    return starts


def _obstacle_centres(settings: Settings) -> Floats:
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


def _too_small(settings: Settings, name: str, value: float, needed: float) -> ValueError:
    return ValueError(
        f"scenario {settings.scenario!r}: {settings.num_robots} robots of radius {np.max(settings.team.radius):g} m "
        f"with margin {settings.margin:g} m do not fit on a {name} of {value:g} m; use {name}={round_up(needed)}"
    )
