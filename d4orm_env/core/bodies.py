"""The rigid bodies that a team consists of, robots and their trailers: checks, their poses, and arrays for engines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats, Ints, frozen_per_robot, read_only, short_repr
from d4orm_env.dynamics.robot_model import Limit, Model
from d4orm_env.footprints import MAX_CORNERS, Disc, Ellipsoid, Footprint, Planar, Polygon, Train


class Body(NamedTuple):
    """A rigid body of a robot: its own one, or a trailer."""

    robot: int  #: Number of the robot
    footprint: Footprint  #: What it covers
    heading: int | None  #: Number of the state component that turns it, or ``None`` for none
    #: Distance of a trailer's reference point behind that of the body before it [m]; zero for the robot itself
    hitch: float


def checked_footprints(given: Footprint | Sequence[Footprint], models: Sequence[Model]) -> tuple[Footprint, ...]:
    """``K`` footprints, given as one for all or one each, of the robots' dimension and with their trailers."""
    footprints = tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else (given,) * len(models)
    if len(footprints) != len(models):
        raise ValueError(
            f"footprint has {len(footprints)} entries for {len(models)} robots; give one for each, such as "
            "Box(0.5, 0.25), or one for all"
        )
    for robot, (footprint, model) in enumerate(zip(footprints, models, strict=True)):
        where = f"footprint of robot_{robot}"
        if not isinstance(footprint, Footprint):
            raise ValueError(f"{where} is {short_repr(footprint)}; give one such as Box(0.5, 0.25)")
        if footprint.dimension != model.dimension and not isinstance(footprint, Disc):
            raise ValueError(
                f"{where}, {footprint}, lies in {footprint.dimension} dimensions and the team moves in "
                f"{model.dimension}; choose another"
            )
        pulled = len(footprint.trailers) if isinstance(footprint, Train) else 0
        if pulled != len(model.trailers):
            raise ValueError(
                f"{where} has {pulled} trailers, and a {model.name} pulls {len(model.trailers)}; give such as "
                "Train(Box(0.5, 0.25), [Box(0.3, 0.25)])"
            )
    return footprints


def discs_of(radii: FloatArray, models: Sequence[Model]) -> list[Footprint]:
    """Discs of these radii ``(K,)``, and as many behind each as a model has trailers."""
    discs = [Disc(float(str(size))) for size in radii]  # the decimal that files have
    pulled = [(disc,) * len(model.trailers) for disc, model in zip(discs, models, strict=True)]
    return [Train(disc, trailers) if trailers else disc for disc, trailers in zip(discs, pulled, strict=True)]


def outer_radius(footprint: Footprint, model: Model, limits: FloatArray) -> float:
    """Radius of the disc about a robot's reference point that its trailers do not leave either [m]."""
    radius, distance = footprint.outer_radius, 0.0
    if isinstance(footprint, Train):
        for trailer, (_, column) in zip(footprint.trailers, model.trailers, strict=True):
            distance += float(limits[column])
            radius = max(radius, distance + trailer.outer_radius)
    return radius


def complete_own_limits(given: Mapping[str, ArrayLike], models: Sequence[Model]) -> dict[str, FloatArray]:
    """``(K,)`` values by name of every limit that a model has for itself, given or default."""
    if not isinstance(given, Mapping):
        raise ValueError(f"own_limits must be a mapping such as {{'wheelbase': 0.3}}, not {short_repr(given)}")
    known = [{limit.name: limit for limit in model.own_limits} for model in models]
    names = dict.fromkeys(name for limits in known for name in limits)
    for name in given:
        if name not in names:
            raise ValueError(
                f"own_limits holds {short_repr(name)}, which no model of the team has; "
                f"it has {', '.join(names) or 'none of its own'}"
                f"{'; YAML wants a space after a colon' if ':' in str(name) else ''}"
            )
    return {name: _per_robot(name, given.get(name), [limits.get(name) for limits in known]) for name in names}


def _per_robot(name: str, value: ArrayLike | None, limits: list[Limit | None]) -> FloatArray:
    """``(K,)`` values of a limit, given or default, of robots that have it or ``None``."""
    if value is None:
        value = [1.0 if limit is None else limit.default for limit in limits]
    values = frozen_per_robot(value, name, len(limits))
    for robot, limit in enumerate(limits):
        if limit is not None and values[robot] > limit.most:
            raise ValueError(f"{name} of robot_{robot} is {values[robot]:g}; it must be at most {limit.most:g}")
    return values


def find_bodies(footprints: Sequence[Footprint], models: Sequence[Model], hitches: Iterable[float]) -> tuple[Body, ...]:
    """The robots' bodies, and then those of their trailers, robot by robot."""
    robots, trailers, lengths = [], [], iter(hitches)
    for robot, (shape, model) in enumerate(zip(footprints, models, strict=True)):
        front, others = (shape.front, shape.trailers) if isinstance(shape, Train) else (shape, ())
        robots.append(Body(robot, front, model.heading_index, 0.0))
        for footprint, (component, _) in zip(others, model.trailers, strict=True):
            trailers.append(Body(robot, footprint, component, next(lengths)))
    return (*robots, *trailers)


def body_poses(bodies: Sequence[Body], states: FloatArray, d: int) -> Floats:
    """``(..., F, d + 1)`` reference points and headings of the bodies in states ``(..., K, n)``."""
    last = dict[int, int]()
    poses = np.zeros((*states.shape[:-2], len(bodies), d + 1))
    for i, body in enumerate(bodies):
        column = body.heading
        turn: Floats = (
            np.zeros(states.shape[:-2]) if column is None else states[..., body.robot, column].astype(np.float64)
        )
        if body.robot in last:
            before = poses[..., last[body.robot], :]
            turn = before[..., d] - turn
            sine, cosine = portable.sin_cos(turn)
            poses[..., i, 0] = before[..., 0] - body.hitch * cosine
            poses[..., i, 1] = before[..., 1] - body.hitch * sine
        else:
            poses[..., i, :d] = states[..., body.robot, :d]
        poses[..., i, d] = turn
        last[body.robot] = i
    return poses


class FootprintArrays(NamedTuple):
    """Footprints of a team's ``F`` bodies as the engines read them, float32 unless said.

    The first ``K`` are the robots' own, those of trailers follow.
    """

    corners: FloatArray  #: ``(F, 8, 2)`` of the cores, the last one repeated
    num_corners: Ints  #: ``(F,)`` int32
    axes: FloatArray  #: ``(F, 8, 2)`` see :attr:`Core.axes`, zeros on padding
    extents: FloatArray  #: ``(F, 8)`` how far the core reaches along each
    num_axes: Ints  #: ``(F,)`` int32
    rounding: FloatArray  #: ``(F,)``
    inner: FloatArray  #: ``(F,)`` inner radii, a little less for rounding
    heading: Ints  #: ``(F,)`` int32 number of the state component that turns the footprint, -1 for none
    semi_axes: FloatArray  #: ``(F, 3)`` of ellipsoids and balls; zero in the plane
    wall_axes: FloatArray  #: ``(F, 3)`` of what obstacles and bounds meet of these
    #: ``(F, 3)`` of cores that are rectangles, segments or points: half of the length and of the width, and how far
    #: ahead of the reference point the centre lies; -1 of others
    rectangles: FloatArray
    hitch: FloatArray  #: ``(F,)`` distance behind the body before it
    before: Ints  #: ``(F,)`` int32 number of the body that it is hitched to, its own for a robot's
    following: Ints  #: ``(F,)`` int32 number of the trailer that is hitched to it, -1 for none
    robot: Ints  #: ``(F,)`` int32


def as_arrays(bodies: Sequence[Body]) -> FootprintArrays:
    """The arrays of these: one of each robot, in order, and then the trailers, those of a robot from its front on."""
    size = len(bodies)
    semi_axes, wall_axes = np.zeros((2, size, 3), np.float32)
    arrays = FootprintArrays(
        np.zeros((size, MAX_CORNERS, 2), np.float32), np.zeros(size, np.int32),
        np.zeros((size, MAX_CORNERS, 2), np.float32), np.zeros((size, MAX_CORNERS), np.float32),
        np.zeros(size, np.int32), np.zeros(size, np.float32), np.zeros(size, np.float32),
        np.full(size, -1, np.int32), semi_axes, wall_axes, np.full((size, 3), -1, np.float32),
        np.zeros(size, np.float32), np.arange(size, dtype=np.int32), np.full(size, -1, np.int32),
        np.zeros(size, np.int32),
    )  # fmt: skip
    last: dict[int, int] = {}
    for i, (robot, footprint, heading, hitch) in enumerate(bodies):
        arrays.robot[i], arrays.hitch[i], arrays.before[i] = robot, hitch, last.get(robot, i)
        if robot in last:
            arrays.following[last[robot]] = i
        last[robot] = i
        arrays.heading[i] = -1 if heading is None else heading
        _fill_shape(arrays, i, footprint)
    return read_only(arrays)


def _fill_shape(arrays: FootprintArrays, i: int, footprint: Footprint) -> None:
    arrays.inner[i] = footprint.inner_radius * (1 - 2.0**-20)
    if isinstance(footprint, Disc | Ellipsoid):
        arrays.semi_axes[i], arrays.wall_axes[i] = footprint.semi_axes, footprint.wall_axes
    if not isinstance(footprint, Planar):
        return
    corners, rounding = footprint.core
    axes, extents = footprint.core.axes
    arrays.corners[i, : len(corners)] = corners
    arrays.corners[i, len(corners) :] = corners[-1]
    arrays.num_corners[i], arrays.num_axes[i] = len(corners), len(axes)
    arrays.axes[i, : len(axes)], arrays.extents[i, : len(axes)] = axes, extents
    arrays.rounding[i] = rounding
    if not isinstance(footprint, Polygon):
        low, high = corners.min(axis=0), corners.max(axis=0)
        arrays.rectangles[i] = (*((high - low) / 2), (low[0] + high[0]) / 2)
