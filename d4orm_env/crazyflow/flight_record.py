"""Figures of a flight, and the distances that they are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from d4orm_env.core.arrays import BoolArray, Floats


@dataclass(frozen=True, eq=False)
class FlightRecord:
    """Figures of a team's flight.

    Attributes:
        largest_error: ``(K,)`` largest distance of each drone from its setpoints [m].
        mean_squared_error: ``(K,)`` mean square of it [m^2].
        least_gap: ``(K,)`` least gap between a drone's sphere and another's [m].
        least_clearance: ``(K,)`` least gap between it and obstacles or bounds [m].
        fallen: ``(K,)`` bool: was on the floor, or out of control.
        samples: Moments that the mean is of.
    """

    largest_error: Floats
    mean_squared_error: Floats
    least_gap: Floats
    least_clearance: Floats
    fallen: BoolArray
    samples: int

    @classmethod
    def empty(cls, num_robots: int) -> FlightRecord:
        """The record before take-off."""
        nothing, far = np.zeros(num_robots), np.full(num_robots, np.inf)
        return cls(nothing, nothing, far, far, np.zeros(num_robots, np.bool_), 0)

    def joined(self, later: FlightRecord) -> FlightRecord:
        """The record of this flight and of what came after it."""
        samples = self.samples + later.samples
        total = self.samples * self.mean_squared_error + later.samples * later.mean_squared_error
        return replace(
            self,
            largest_error=np.maximum(self.largest_error, later.largest_error),
            mean_squared_error=total / samples,
            least_gap=np.minimum(self.least_gap, later.least_gap),
            least_clearance=np.minimum(self.least_clearance, later.least_clearance),
            fallen=self.fallen | later.fallen,
            samples=samples,
        )


def least_gaps(path: Floats, radius: Floats) -> Floats:
    """``(K,)`` least gaps to other robots along positions ``(S, K, d)``, joined by straight lines [m]."""
    if len(radius) < 2:
        return np.full(len(radius), np.inf)
    apart = path[:, :, None] - path[:, None]
    begin, change = apart[:-1], apart[1:] - apart[:-1]
    squared = (change * change).sum(axis=-1)
    nearest = np.clip(-(begin * change).sum(axis=-1) / np.maximum(squared, 1e-12), 0, 1)
    gaps = np.linalg.norm(begin + nearest[..., None] * change, axis=-1).min(axis=0) - (radius[:, None] + radius)
    np.fill_diagonal(gaps, np.inf)
    least: Floats = gaps.min(axis=1)
    return least
