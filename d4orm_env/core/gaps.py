"""Gaps between footprints, and from them to a world: in float64, for checks of a problem, a few robots at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.footprints import Core, Footprint

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.core.team import Team
    from d4orm_env.core.world import World

WEIGHTS = np.linspace(0, 1, 257)[1:-1]
"""Weights of two ellipsoids among which the best is taken."""


def pair_gap(one: Footprint, pose: Floats, other: Footprint, its_pose: Floats) -> float:
    """Signed gap of two footprints at poses ``(d + 1,)`` [m]; in space that along the line of their centres.

    Where a heading is NaN, the disc counts that the footprint covers at any heading.
    """
    if len(pose) == 4:
        return _ball_gap(its_pose[:3] - pose[:3], np.array(one.semi_axes), np.array(other.semi_axes))
    return _core_gap(_placed(one, pose), _placed(other, its_pose))


def gaps_at(team: Team, poses: Floats, world: World) -> Callable[[int, int], float]:
    """``gap(one, other)``, the signed gap of two robots, or of one and itself that to the world [m].

    Poses are ``(F, d + 1)``, or without the trailers ``(K, d + 1)``; bodies that are nowhere, NaN, do not count.
    """
    shapes = [body.footprint for body in team.bodies]
    numbers: list[list[int]] = [[] for _ in range(team.num_robots)]
    for i in np.flatnonzero(~np.isnan(poses[:, : team.dimension]).any(axis=1)).tolist():
        numbers[team.bodies[i].robot].append(i)

    def gap(one: int, other: int) -> float:
        if one == other:
            return min(world_gap(world, shapes[i], poses[i]) for i in numbers[one])
        pairs = product(numbers[one], numbers[other])
        return min(pair_gap(shapes[i], poses[i], shapes[j], poses[j]) for i, j in pairs)

    return gap


def nearest(problem: Problem, states: FloatArray, enough: float = np.inf) -> float:
    """The least signed gap in states ``(K, n)``, between two robots or to the world [m]; infinite beyond ``enough``.

    A robot that may face anywhere, NaN, counts with its inner disc.
    """
    team, world, d, least = problem.team, problem.world, problem.dimension, np.inf
    points, radius = states[:, :d].astype(np.float64), team.radius.astype(np.float64)
    outer = np.linalg.norm(points[:, None] - points, axis=2) - radius[:, None] - radius
    outer[np.tril_indices(len(outer), -1)] = np.inf
    outer[np.diag_indices_from(outer)] = world.clearance(states[:, :d]) - team.wall_radius
    first, gap = int(outer.argmin()), gaps_at(team, team.body_poses(states), world)
    if outer.flat[first] < enough:
        least = gap(*divmod(first, len(outer)))
    for one, other in np.argwhere(outer < min(least, enough)).tolist():
        least = min(least, gap(one, other))
    return least


def touching(problem: Problem, states: FloatArray, among: NDArray[np.intp], rounding: float) -> dict[int, list[int]]:
    """Partners in contact of each robot, of those ``among`` ``(C,)``, in states ``(K, n)``, by number.

    Gaps of no more than ``rounding`` count as none [m].
    """
    team, d, poses = problem.team, problem.dimension, problem.team.body_poses(states)
    gap = gaps_at(team, poses, problem.world)
    partners: dict[int, list[int]] = {}
    for one, other in combinations(among.tolist(), 2):
        apart = np.linalg.norm(poses[one, :d] - poses[other, :d]) - team.radius[one] - team.radius[other]
        if apart <= rounding and gap(one, other) <= rounding:
            partners.setdefault(one, []).append(other)
            partners.setdefault(other, []).append(one)
    return partners


def near_pairs(points: Floats, radius: Floats, margin: float) -> tuple[IntArray, IntArray, Floats]:
    """Pairs of robots at ``points`` ``(K, d)`` within the margin: the first, the second, and their gap [m]."""
    axis = int(np.argmax(np.ptp(points, axis=0)))
    order = np.argsort(points[:, axis], kind="stable")
    along, safety_distance = points[order, axis], 2 * radius.max() + margin
    pairs: list[IntArray] = [np.empty((2, 0), np.int64)]
    for offset in range(1, len(points)):
        # Robots farther apart along the axis than this cannot be within the margin; a larger offset brings none nearer.
        near = np.flatnonzero(along[offset:] - along[:-offset] <= safety_distance)
        if not len(near):
            break
        pairs.append(np.sort(np.stack([order[near], order[near + offset]]), axis=0))
    first, second = np.concatenate(pairs, axis=1)
    gaps = np.linalg.norm(points[first] - points[second], axis=1) - radius[first] - radius[second]
    kept = gaps <= margin
    by_robot = np.lexsort((first[kept], second[kept]))
    return first[kept][by_robot], second[kept][by_robot], gaps[kept][by_robot]


def world_gap(world: World, footprint: Footprint, pose: Floats) -> float:
    """Signed gap of a footprint to the nearest obstacle or bound [m]; see :func:`pair_gap`."""
    dimension, bounds = world.dimension, world.bounds.astype(np.float64)
    if dimension == 3:
        low = high = np.array(footprint.wall_axes)
        gaps = list(_ball_gaps(world, pose[:3], low))
    else:
        core = _placed(footprint, pose)
        low, high = pose[:2] - core.corners.min(axis=0), core.corners.max(axis=0) - pose[:2]
        low, high = low + core.rounding, high + core.rounding
        gaps = [_core_gap(core, obstacle) for obstacle in _obstacles(world)]
    ends = np.concatenate([pose[:dimension] - low - bounds[0], bounds[1] - pose[:dimension] - high])
    return float(min([*ends.tolist(), *gaps]))


def _placed(footprint: Footprint, pose: Floats) -> Core:
    if np.isnan(pose[2]):
        return Core(pose[None, :2], footprint.inner_radius)
    corners, rounding = footprint.core  # type: ignore[attr-defined] # all in the plane have one
    sine, cosine = portable.sin_cos(pose[2])
    turned = np.stack([cosine * corners[:, 0] - sine * corners[:, 1], sine * corners[:, 0] + cosine * corners[:, 1]], 1)
    return Core(pose[:2] + turned, rounding)


def _obstacles(world: World) -> Iterator[Core]:
    for circle in world.circles.astype(np.float64):
        yield Core(circle[None, :2], float(circle[2]))
    for left, low, right, high in world.boxes.astype(np.float64):
        yield Core(np.array([[left, low], [right, low], [right, high], [left, high]]), 0.0)
    for triangle in world.shapes.triangles.astype(np.float64):
        yield Core(triangle.reshape(3, 2), 0.0)


def _core_gap(a: Core, b: Core) -> float:
    apart = max(_separation(a, b), _separation(b, a))
    if not -np.inf < apart <= 0:
        apart = min(_corner_distance(a, b), _corner_distance(b, a))
    return apart - a.rounding - b.rounding


def _separation(a: Core, b: Core) -> float:
    axes, extents = a.axes
    return float(((axes[:, None] * b.corners).sum(axis=2).min(axis=1) - extents).max(initial=-np.inf))


def _corner_distance(a: Core, b: Core) -> float:
    """Least distance from a corner of ``a`` to an edge of ``b``."""
    along, offset = np.roll(b.corners, -1, axis=0) - b.corners, a.corners[:, None] - b.corners
    square = (along * along).sum(axis=1)
    share = np.clip((offset * along).sum(axis=2) / np.where(square > 0, square, 1), 0, 1)
    return float(np.linalg.norm(offset - share[..., None] * along, axis=2).min())


def _ball_gaps(world: World, position: Floats, axes: Floats) -> Iterator[float]:
    for ball in world.spheres.astype(np.float64):
        yield _ball_gap(ball[:3] - position, axes, np.full(3, ball[3]))
    for x, y, radius in world.cylinders.astype(np.float64):
        yield _ball_gap(np.array([x - position[0], y - position[1], 0.0]), axes, np.full(3, radius))
    for box in world.boxes.astype(np.float64):
        offset = np.clip(position, box[:3], box[3:]) - position
        stretch = float(np.linalg.norm(offset / axes))
        yield float(np.linalg.norm(offset)) * (1 - 1 / stretch) if stretch > 0 else -float(axes.min())


def _ball_gap(offset: Floats, a: Floats, b: Floats) -> float:
    """Gap of two ellipsoids along the line of their centres (Perram and Wertheim, 1985)."""
    s = WEIGHTS[:, None]
    stretch = np.sqrt((s * (1 - s) * offset**2 / ((1 - s) * a * a + s * b * b)).sum(axis=1).max())
    return float(np.linalg.norm(offset) * (1 - 1 / stretch)) if stretch > 0 else -float(min(a.min(), b.min()))
