"""Earliest times of a robot at the points of a motion: the network knows nothing of accelerations."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.engine.compiling import compiled

SHARE = 0.7
"""Share of its acceleration that a robot counts on, so that it can make up for what it is off."""


@compiled
def fill_clock(
    points: Floats, duration: float, speed: float, acceleration: float, paces: Floats, times: Floats
) -> None:
    """Fill ``times`` ``(N + 1,)`` with when a robot that starts from rest is at each point [s].

    Points follow each other at equal times, but for bends that are driven slower than that, and braking before them.

    Args:
        points: ``(N + 1, 3)`` [m].
        duration: Of the motion [s]; it takes no less.
        speed: Limit [m/s].
        acceleration: Limit [m/s^2].
        paces: ``(N + 1,)`` scratch [m/s].
        times: Output.
    """
    last, usable = points.shape[0] - 1, SHARE * acceleration
    paces[0], paces[last] = 0.0, speed
    for i in range(1, last):
        before, after = _length(points, i - 1), _length(points, i)
        square = 0.0
        for axis in range(3):
            turn = (points[i + 1, axis] - points[i, axis]) / after - (points[i, axis] - points[i - 1, axis]) / before
            square += turn * turn
        # A point that is waited at has no direction.
        bends = before > 0.0 and after > 0.0 and square > 0.0
        paces[i] = min(speed, np.sqrt(usable * (before + after) / (2 * np.sqrt(square)))) if bends else speed
    for i in range(last - 1, 0, -1):
        paces[i] = min(paces[i], np.sqrt(paces[i + 1] * paces[i + 1] + 2 * usable * _length(points, i)))
    times[0] = 0.0
    for i in range(last):
        length = _length(points, i)
        paces[i + 1] = min(paces[i + 1], np.sqrt(paces[i] * paces[i] + 2 * usable * length))
        pace = (paces[i] + paces[i + 1]) / 2
        times[i + 1] = times[i] + max(duration / last, length / pace if pace > 0.0 else 0.0)


@compiled
def _length(points: Floats, i: int) -> float:
    dx, dy, dz = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1], points[i + 1, 2] - points[i, 2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)
