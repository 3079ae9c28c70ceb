"""Disturbances of an execution, for pictures of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class DisturbanceEvents:
    """Disturbances that a team met in ``T`` steps.

    Attributes:
        pushed: ``(T + 1, K, d)`` velocity that the step before gave to each robot [m/s]; zero for none.
        stalled: ``(T + 1, K)`` bool: does not obey.
        bodies: ``(T + 1, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots.
    """

    pushed: FloatArray
    stalled: BoolArray
    bodies: FloatArray

    def until(self, step: int) -> DisturbanceEvents:
        """The same up to that step."""
        return DisturbanceEvents(self.pushed[: step + 1], self.stalled[: step + 1], self.bodies[: step + 1])

    @property
    def stall_starts(self) -> BoolArray:
        """``(T + 1, K)`` bool: where a robot stops obeying."""
        before = np.concatenate([np.zeros_like(self.stalled[:1]), self.stalled[:-1]])
        starts: BoolArray = self.stalled & ~before
        return starts
