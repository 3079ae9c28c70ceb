"""The scenarios. Each is a function from the common settings and its own arguments to a problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from d4orm_env.core.portable import cos, root, sin
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.layout import Layout, build, in_space
from d4orm_env.scenarios.placement import PlacementArea, Points, round_up, scatter
from d4orm_env.scenarios.settings import JITTER, Settings, bounded

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


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
    obstacles = np.hstack([centres, np.full((4, 1), settings.obstacle_radius)])
    dimension = settings.team.dimension
    world = World(circles=obstacles) if dimension == 2 else World(3, cylinders=obstacles)
    return build(settings, replace(layout, world=world))


def heterogeneous(settings: Settings, *, diameter: float = 5.0) -> Problem:
    """The circle with differential drives and holonomic2d robots in turn, with different acceleration limits.

    The paper's heterogeneous team (section IV-B). Robots 0, 2, ... are differential drives with 1 m/s^2 that face their
    goals, robots 1, 3, ... are holonomic with 2 m/s^2; ``max_acceleration`` replaces both limits.

    Args:
        settings: The common arguments, ``model`` left out.
        diameter: Diameter of the circle [m].
    """
    mixed = mixed_team(settings, first=("differential_drive", 1.0), second=("holonomic2d", 2.0))
    return circle(mixed, diameter=diameter)


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
    starts, goals = (in_space(np.column_stack([side, y]), dimension) for side in (x, -x))
    area = PlacementArea(in_space([distance / 2, first * spacing / 2], dimension)[0])
    return build(settings, Layout(starts, goals, World(dimension=dimension), distance, area))


AMSWARM: Mapping[str, tuple[str, Sequence[tuple[float, float]]]] = {
    "amswarm_1": ("ten 3D robots on a circle, no obstacles", ()),
    "amswarm_2": ("five cylinders close together in the centre", ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))),
    "amswarm_3": ("four cylinders around the centre", ((0, 1), (0, -1), (1, 0), (-1, 0))),
    "amswarm_4": (
        "a cylinder in the centre and four at the corners of a square", ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
    ),
    "amswarm_5": ("five cylinders, to one side", ((0, 0), (0, 1), (0, -1), (-1, 1), (-1, -1))),
}  # fmt: skip
"""Environments of AMSwarm, and where their cylinders are; see :func:`amswarm`."""


def amswarm(centres: Sequence[tuple[float, float]], settings: Settings, *, jitter: float = 0.0) -> Problem:
    """Ten 3D robots among cylinders: the paper's comparison with AMSwarm (section VIII).

    ``holonomic3d`` robots of radius 0.29 m with margin 0.05 m, antipodal on a circle of radius 2.5 m in the plane
    z = 0, in bounds of +-3 m. The obstacles are vertical cylinders of radius 0.2 m.

    Args:
        centres: x and y of the cylinders [m].
        settings: The common arguments; ten robots.
        jitter: Each coordinate of each start is moved by a uniform random number within +-``jitter`` [m].
    """
    _require_space(settings)
    if settings.num_robots != 10:
        raise ValueError(
            f"num_robots is {settings.num_robots}; scenario {settings.scenario!r} has exactly 10 robots, so leave "
            f"num_robots out, or use scenario 'circle' with model='holonomic3d'"
        )
    jitter = bounded(jitter, "jitter", zero_allowed=True)
    layout = antipodal_circle(settings, 5.0)
    moved = layout.starts + settings.generator(JITTER).uniform(-jitter, jitter, layout.starts.shape)
    world = World(dimension=3, cylinders=[(x, y, 0.2) for x, y in centres], lower=[-3.0] * 3, upper=[3.0] * 3)
    return build(settings, replace(layout, starts=moved, world=world))


def fibonacci_sphere(count: int) -> Points:
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
    _require_space(settings)
    points = fibonacci_sphere(settings.num_robots)
    gaps = (np.linalg.norm(points[:index] - points[index], axis=1).min() for index in range(1, len(points)))
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
    starts, goals = _antipodal(in_space(points, dimension))
    area = PlacementArea(in_space([diameter / 2, diameter / 2], dimension)[0], is_round=True)
    return Layout(starts, goals, World(dimension=dimension), diameter, area)


def _antipodal(points: Points) -> tuple[Points, Points]:
    """Starts and goals, rid of rounding dust such as 3e-16 and -0.0, which files and pictures would show."""
    starts: Points = np.round(points, 12) + 0.0
    return starts, 0.0 - starts


def _require_space(settings: Settings) -> None:
    if settings.team.dimension != 3:
        raise ValueError(
            f"scenario {settings.scenario!r} is three-dimensional and model {settings.model!r} is not; "
            f"use model='holonomic3d', or scenario 'circle'"
        )


def _too_small(settings: Settings, name: str, value: float, needed: float) -> ValueError:
    return ValueError(
        f"scenario {settings.scenario!r}: {settings.num_robots} robots of radius {np.max(settings.team.radius):g} m "
        f"with margin {settings.margin:g} m do not fit on a {name} of {value:g} m; use {name}={round_up(needed)}"
    )
