"""The frame in which a robot's motion is described: its shortest path, and the clearance on both sides of it.

The model never sees a map. It learns how motions differ from the shortest path driven at an even pace, in lengths of
that path: how far ahead or behind on it, and how far to its side. So one model serves all maps, sizes and
directions, and a robot that waits or hurries stays on its path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, read_only
from d4orm_env.core.portable import sin
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined
from d4orm_env.paths.spaces import Space, clearance_at, make_space

POINTS = 64  #: Stretches of equal time that a motion is cut into, as in the publication
MODES = 16  #: Sines that a difference from the path is made of
LOOKS = 16  #: Points along the path at which the model gets the path and the clearances on both sides of it
FEATURES = 5 * LOOKS + 2  #: Numbers that the model is told
_ROUNDING = 2  #: Points before and after one over which a path's direction is averaged
_ANY = 1e6  #: Rate at which robots that take any velocity at once could reach their full speed [1/s]
_FAR = 4.0  #: Largest clearance that the model is told of, in safety distances


class PathFrame(NamedTuple):
    """A robot's path and the axes in which its motion is described; all float64."""

    reference: Floats  #: ``(POINTS + 1, 3)`` positions on the shortest path at equal distances, from start to goal [m]
    tangents: Floats  #: ``(POINTS + 1, 3)`` its direction at each, corners rounded; of at most unit length
    #: ``(P, 3)`` unit vectors about which directions turn to the side: up and down in the plane, and any four across
    #: the line from start to goal in space
    axes: Floats
    length: float  #: Of the path, at least the goal's radius [m]
    safety_distance: float  #: The distance that the robot's centre keeps from obstacles [m]
    speed: float  #: Limit of the robot [m/s]
    acceleration: float  #: Limit of the robot; for one without inertia, a very large one [m/s^2]
    quickest: float  #: Time that the path takes at full speed from rest [s]
    features: FloatArray  #: ``(P, FEATURES)`` what the model is told, per axis


def sine_table() -> Floats:
    """``(POINTS + 1, MODES)`` the modes' sines at every point; zero at both ends."""
    angle = np.pi / POINTS * np.arange(POINTS + 1)[:, None] * np.arange(1, MODES + 1)
    table = sin(angle)
    table[[0, -1]] = 0.0
    return table


def world_space(problem: Problem) -> Space:
    """The world as :func:`~d4orm_env.paths.spaces.clearance_at` reads it, with obstacles or without."""
    if problem.world.num_obstacles:
        return make_space(problem)
    bounds = np.tile([[-np.inf], [np.inf]], 3)
    bounds[:, : problem.dimension] = problem.world.bounds
    empty = np.zeros(3)
    # As those of an index are: one compilation serves worlds with obstacles and without.
    clearance, first, items = read_only((np.full(1, np.inf, np.float32), np.zeros(2, np.int32), np.zeros(0, np.int32)))
    return Space(
        low=empty,
        cell=1.0,
        scale=1.0,
        size=np.ones(3, np.int64),
        rounding=0.0,
        clearance=clearance,
        first=first,
        items=items,
        boxes=np.zeros((0, 7)),
        triangles=np.zeros((0, 6)),
        bounds=bounds,
        extent=np.tile([[-np.inf], [np.inf]], 3),
        pad=np.inf,
    )


def make_frame(problem: Problem, robot: int, space: Space, turn: Floats) -> PathFrame | None:
    """A robot's frame, ``None`` if it has no path to its goal; in space any ``turn`` ``(3,)`` chooses its axes."""
    corners = problem.shortest_paths.path(robot)
    if not len(corners):
        return None
    path = np.zeros((len(corners), 3))
    path[:, : problem.dimension] = corners
    reference = np.empty((POINTS + 1, 3))
    length = max(resample(path, reference), problem.goal_radius)
    limits = problem.team.limits[robot].astype(np.float64)
    safety_distance = float(problem.team.wall_radius[robot]) + problem.margin
    speed = float(limits[SPEED])
    acceleration = float(limits[ACCELERATION]) if problem.team.robot_models[robot].speed_indices else _ANY * speed
    tangents = np.empty_like(reference)
    round_tangents(reference, tangents)
    along = _unit(reference[-1] - reference[0], np.array([1.0, 0.0, 0.0]), length)
    axes = _axes(along, turn, problem.dimension)
    features = np.empty((len(axes), FEATURES), np.float32)
    for own, axis in zip(features, axes, strict=True):
        describe(space, reference, along, _cross(axis, along), length, safety_distance, own)
        own[-2:] = min(safety_distance / length, _FAR), min(speed * speed / (acceleration * length), _FAR)
    quickest = length / speed + speed / acceleration / 2
    return PathFrame(reference, tangents, axes, length, safety_distance, speed, acceleration, quickest, features)


def _axes(along: Floats, turn: Floats, dimension: int) -> Floats:
    """``(P, 3)`` unit vectors across ``along``, each with its opposite."""
    if dimension == 2:
        return np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    least = np.eye(3)[np.argmin(np.abs(along))]
    first = _unit(turn - along * _dot(turn, along), _unit(_cross(along, least), least))
    second = _cross(along, first)
    return np.stack([first, -first, second, -second])


# NumPy's inner products and norms choose versions by processor; three terms are as well written out.


def _dot(a: Floats, b: Floats) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _cross(a: Floats, b: Floats) -> Floats:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _unit(vector: Floats, otherwise: Floats, scale: float = 1.0) -> Floats:
    length = np.sqrt(_dot(vector, vector))
    return vector / length if length > 1e-6 * scale else otherwise


@cached_kernel(variant="resample", **OPTIONS)
def resample(path: Floats, reference: Floats) -> float:
    """Fill ``reference`` ``(N + 1, 3)`` with positions equally far apart on the path ``(w, 3)``; its length."""
    last = reference.shape[0] - 1
    total = 0.0
    for corner in range(1, path.shape[0]):
        total += segment_length(path, corner)
    corner, passed, own = 0, 0.0, 0.0
    for i in range(last + 1):
        arc = total * i / last
        while corner < path.shape[0] - 1 and (corner == 0 or passed + own < arc):
            passed += own
            corner += 1
            own = segment_length(path, corner)
        share = min((arc - passed) / own, 1.0) if own > 0.0 else 1.0
        for axis in range(3):
            before = path[max(corner - 1, 0), axis]
            reference[i, axis] = before + share * (path[corner, axis] - before)
    return total


@cached_kernel(variant="tangents", **OPTIONS)
def round_tangents(reference: Floats, tangents: Floats) -> None:
    """Fill ``tangents`` ``(N + 1, 3)`` with the mean direction of the path about each point."""
    last = reference.shape[0] - 1
    for i in range(last + 1):
        before, after = max(i - _ROUNDING, 0), min(i + _ROUNDING, last)
        # Its length is of the chord: shorter in corners, zero where the path turns back on itself.
        arc = 0.0
        for k in range(before, after):
            arc += segment_length(reference, k + 1)
        for axis in range(3):
            tangents[i, axis] = (reference[after, axis] - reference[before, axis]) / arc if arc > 0.0 else 0.0


@compiled
def locate(
    frame: PathFrame, axis: Floats, sines: Floats, deviation: Floats, motion: FloatArray, i: int, spot: Floats
) -> None:
    """Fill ``spot`` ``(4, 3)``: a motion's point [m], directions ahead and aside there, its point on the path [m].

    Args:
        frame: The robot's path.
        axis: ``(3,)`` one of the frame's.
        sines: ``(MODES,)`` of the point.
        deviation: ``(2 MODES,)`` of the modes.
        motion: ``(2 MODES,)`` whitened modes.
        i: Number of the point.
        spot: Output.
    """
    modes, last, ahead, aside = sines.shape[0], frame.reference.shape[0] - 1, 0.0, 0.0
    for mode in range(modes):
        ahead += motion[mode] * deviation[mode] * sines[mode]
        aside += motion[modes + mode] * deviation[modes + mode] * sines[mode]
    arc = min(max(i + last * ahead, 0.0), np.float64(last))
    k = min(np.int64(arc), last - 1)
    share = arc - k
    for x in range(3):
        spot[3, x] = frame.reference[k, x] + share * (frame.reference[k + 1, x] - frame.reference[k, x])
        spot[1, x] = frame.tangents[k, x] + share * (frame.tangents[k + 1, x] - frame.tangents[k, x])
    spot[2, 0] = axis[1] * spot[1, 2] - axis[2] * spot[1, 1]
    spot[2, 1] = axis[2] * spot[1, 0] - axis[0] * spot[1, 2]
    spot[2, 2] = axis[0] * spot[1, 1] - axis[1] * spot[1, 0]
    for x in range(3):
        spot[0, x] = spot[3, x] + frame.length * aside * spot[2, x]


@inlined
def trace(
    frame: PathFrame, axis: Floats, sines: Floats, deviation: Floats, motion: FloatArray, spot: Floats, points: Floats
) -> None:
    """Fill ``points`` ``(N + 1, 3)`` with those of a motion [m]; all else as of :func:`locate`, ``spot`` as scratch."""
    for i in range(points.shape[0]):
        locate(frame, axis, sines[i], deviation, motion, i, spot)
        for x in range(3):
            points[i, x] = spot[0, x]


@compiled
def segment_length(path: Floats, end: int) -> float:
    """Return the length of the segment that ends at this point of a path [m]."""
    a, b = path[end - 1], path[end]
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@cached_kernel(variant="describe", **OPTIONS)
def describe(
    space: Space,
    reference: Floats,
    along: Floats,
    across: Floats,
    length: float,
    safety_distance: float,
    features: FloatArray,
) -> None:
    """Fill in where the path leads and how much room is on it and on either side of it.

    Args:
        space: The world.
        reference: ``(N + 1, 3)`` the path [m].
        along: ``(3,)`` first axis.
        across: ``(3,)`` second axis.
        length: Of the path [m].
        safety_distance: Of the robot [m].
        features: ``(FEATURES,)``, output: five numbers at every look; in the last two nothing is written.
    """
    last = reference.shape[0] - 1
    looks = (features.shape[0] - 2) // 5
    for look in range(looks):
        i = last * (look + 1) // (looks + 1)
        x, y = 0.0, 0.0
        ahead, aside = 0.0, 0.0
        for axis in range(3):
            offset = reference[i, axis] - reference[0, axis]
            x += offset * along[axis]
            y += offset * across[axis]
            step = reference[min(i + 1, last), axis] - reference[max(i - 1, 0), axis]
            ahead += step * along[axis]
            aside += step * across[axis]
        norm = np.sqrt(ahead * ahead + aside * aside)
        ahead, aside = (ahead / norm, aside / norm) if norm > 0.0 else (1.0, 0.0)
        features[5 * look], features[5 * look + 1] = x / length, y / length
        for side in range(-1, 2):
            far = 2.0 * safety_distance * side
            dx, dy = -far * aside, far * ahead
            room = clearance_at(
                space,
                reference[i, 0] + dx * along[0] + dy * across[0],
                reference[i, 1] + dx * along[1] + dy * across[1],
                reference[i, 2] + dx * along[2] + dy * across[2],
            )
            features[5 * look + 3 + side] = max(min(room / safety_distance, _FAR), -_FAR)
