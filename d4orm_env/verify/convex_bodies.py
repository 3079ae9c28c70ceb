"""The bodies of a team that are no discs, written again from its footprints' corners, roundings and semi-axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env.core import portable
from d4orm_env.verify.contact import Indices
from d4orm_env.verify.geometry import Floats

if TYPE_CHECKING:
    from d4orm_env.core.team import Team


@dataclass(frozen=True, eq=False)
class ConvexBodies:
    """Convex bodies, one row each."""

    corners: Floats  #: ``(B, n, 2)`` of planar cores, the last one repeated; of no use in space
    rounding: Floats  #: ``(B,)``
    semi_axes: Floats  #: ``(B, 3)`` in space
    outer: Floats  #: ``(B,)`` radii of the discs or balls round them
    stretch: Floats  #: ``(B,)`` how much faster a gap may change than a body moves

    @classmethod
    def of(cls, team: Team) -> ConvexBodies:
        """The footprints of a team: of its robots, and then of their trailers."""
        bodies: list[Any] = [getattr(footprint, "front", footprint) for footprint in team.footprint]
        bodies += [trailer for footprint in team.footprint for trailer in getattr(footprint, "trailers", ())]
        size, most = len(bodies), 1 if team.dimension == 3 else max(len(footprint.core[0]) for footprint in bodies)
        corners, rounding, semi_axes = np.zeros((size, most, 2)), np.zeros(size), np.ones((size, 3))
        for robot, footprint in enumerate(bodies):
            if team.dimension == 3:
                semi_axes[robot] = footprint.semi_axes
                continue
            own, rounding[robot] = footprint.core
            corners[robot, : len(own)], corners[robot, len(own) :] = own, own[-1]
        outer = np.array([footprint.outer_radius for footprint in bodies]).astype(np.float32).astype(np.float64)
        return cls(corners, rounding, semi_axes, outer, semi_axes.max(axis=1) / semi_axes.min(axis=1))

    def take(self, index: Indices) -> ConvexBodies:
        """Some of them, in the order given."""
        return ConvexBodies(
            self.corners[index], self.rounding[index], self.semi_axes[index], self.outer[index], self.stretch[index]
        )

    def placed(self, index: Indices, position: Floats, turn: Floats) -> Floats:
        """``(N, n, 2)`` corners of bodies at positions ``(N, 2)`` turned by ``(N,)``."""
        sine, cosine = (part[:, None] for part in portable.sin_cos(turn))
        x, y = self.corners[index, :, 0], self.corners[index, :, 1]
        return position[:, None] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
