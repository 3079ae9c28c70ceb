"""A team's footprints as the engines read them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Ints
from d4orm_env.core.bodies import Body
from d4orm_env.footprints import MAX_CORNERS, Disc, Ellipsoid, Footprint, Planar, Polygon


class FootprintArrays(NamedTuple):
    """Footprints of a team's ``F`` bodies as the engines read them, float32 unless said.

    The first ``K`` are the robots' own, those of trailers follow.

    Attributes:
        corners: ``(F, 8, 2)`` of the cores, the last one repeated.
        num_corners: ``(F,)`` int32.
        axes: ``(F, 8, 2)`` see :attr:`Core.axes`, zeros on padding.
        extents: ``(F, 8)`` how far the core reaches along each.
        num_axes: ``(F,)`` int32.
        rounding: ``(F,)``.
        inner: ``(F,)`` inner radii, a little less for rounding.
        heading: ``(F,)`` int32 number of the state component that turns the footprint, -1 for none.
        semi_axes: ``(F, 3)`` of ellipsoids and balls; zero in the plane.
        rectangles: ``(F, 3)`` of cores that are rectangles, segments or points: half of the length and of the width,
            and how far ahead of the reference point the centre lies; -1 of others.
        hitch: ``(F,)`` distance behind the body before it.
        before: ``(F,)`` int32 number of the body that it is hitched to, its own for a robot's.
        following: ``(F,)`` int32 number of the trailer that is hitched to it, -1 for none.
        robot: ``(F,)`` int32.
    """

    corners: FloatArray
    num_corners: Ints
    axes: FloatArray
    extents: FloatArray
    num_axes: Ints
    rounding: FloatArray
    inner: FloatArray
    heading: Ints
    semi_axes: FloatArray
    rectangles: FloatArray
    hitch: FloatArray
    before: Ints
    following: Ints
    robot: Ints


def as_arrays(bodies: Sequence[Body]) -> FootprintArrays:
    """The arrays of these: one of each robot, in order, and then the trailers, those of a robot from its front on."""
    size = len(bodies)
    arrays = FootprintArrays(
        np.zeros((size, MAX_CORNERS, 2), np.float32), np.zeros(size, np.int32),
        np.zeros((size, MAX_CORNERS, 2), np.float32), np.zeros((size, MAX_CORNERS), np.float32),
        np.zeros(size, np.int32), np.zeros(size, np.float32), np.zeros(size, np.float32),
        np.full(size, -1, np.int32), np.zeros((size, 3), np.float32), np.full((size, 3), -1, np.float32),
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
    for array in arrays:
        array.setflags(write=False)
    return arrays


def _fill_shape(arrays: FootprintArrays, i: int, footprint: Footprint) -> None:
    arrays.inner[i] = footprint.inner_radius * (1 - 2.0**-20)
    if isinstance(footprint, Disc | Ellipsoid):
        arrays.semi_axes[i] = footprint.semi_axes
    if not isinstance(footprint, Disc | Planar):
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
