"""A team's footprints as the engines read them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Ints
from d4orm_env.footprints import MAX_CORNERS, Disc, Ellipsoid, Footprint, Planar


class FootprintArrays(NamedTuple):
    """A team's footprints as the engines read them, float32 unless said.

    Attributes:
        corners: ``(K, 8, 2)`` of the cores, the last one repeated.
        num_corners: ``(K,)`` int32.
        axes: ``(K, 8, 2)`` see :attr:`Core.axes`, zeros on padding.
        extents: ``(K, 8)`` how far the core reaches along each.
        num_axes: ``(K,)`` int32.
        rounding: ``(K,)``.
        inner: ``(K,)`` inner radii, a little less for rounding.
        heading: ``(K,)`` int32 number of the state component that turns the footprint, -1 for none.
        semi_axes: ``(K, 3)`` of ellipsoids and balls; zero in the plane.
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


def as_arrays(footprints: tuple[Footprint, ...], headings: list[int | None]) -> FootprintArrays:
    """The arrays of these; ``headings`` are the numbers of the state components that are headings."""
    size = len(footprints)
    arrays = FootprintArrays(
        np.zeros((size, MAX_CORNERS, 2), np.float32), np.zeros(size, np.int32),
        np.zeros((size, MAX_CORNERS, 2), np.float32), np.zeros((size, MAX_CORNERS), np.float32),
        np.zeros(size, np.int32), np.zeros(size, np.float32), np.zeros(size, np.float32),
        np.full(size, -1, np.int32), np.zeros((size, 3), np.float32),
    )  # fmt: skip
    for robot, footprint in enumerate(footprints):
        arrays.inner[robot] = footprint.inner_radius * (1 - 2.0**-20)
        if isinstance(footprint, Disc | Ellipsoid):
            arrays.semi_axes[robot] = footprint.semi_axes
        if not isinstance(footprint, Disc | Planar):
            continue
        corners, rounding = footprint.core
        axes, extents = footprint.core.axes
        arrays.corners[robot, : len(corners)] = corners
        arrays.corners[robot, len(corners) :] = corners[-1]
        arrays.num_corners[robot], arrays.num_axes[robot] = len(corners), len(axes)
        arrays.axes[robot, : len(axes)], arrays.extents[robot, : len(axes)] = axes, extents
        arrays.rounding[robot] = rounding
        heading = headings[robot]
        arrays.heading[robot] = -1 if heading is None else heading
    for array in arrays:
        array.setflags(write=False)
    return arrays
