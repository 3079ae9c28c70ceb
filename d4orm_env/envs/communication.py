"""Links between robots within a communication range, and within sight if asked."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO
from d4orm_env.engine.ray_shapes import is_blocked


@cached_kernel(**OPTIONS)
def _link(
    positions: FloatArray, boxes: FloatArray, triangles: FloatArray, squared_range: np.float32, sight: bool,
    links: BoolArray,
) -> None:  # fmt: skip
    ray = np.empty((5, 1), np.float32)
    for k in range(len(positions)):
        for other in range(len(positions)):
            gap2 = ZERO
            for axis in range(positions.shape[1]):
                gap = positions[other, axis] - positions[k, axis]
                gap2 += gap * gap
            links[k, other] = k != other and gap2 <= squared_range
            if sight and links[k, other] and gap2 > ZERO:
                links[k, other] = not is_blocked(positions[k], positions[other], boxes, triangles, ray)


def communication_links(
    problem: Problem, positions: FloatArray, communication_range: float | None, line_of_sight: bool
) -> BoolArray:
    """``(K, K)`` bool: robot ``k`` knows of another one, as observations have it.

    Args:
        problem: Its obstacles hide robots.
        positions: ``(K, d)``.
        communication_range: Distance of centres beyond which nobody is known [m]; ``None`` for no limit.
        line_of_sight: Whether those behind obstacles are not known either.
    """
    links = np.empty((len(positions), len(positions)), np.bool_)
    square = np.float32(np.inf if communication_range is None else communication_range**2)
    places = np.ascontiguousarray(positions, np.float32)
    _link(places, problem.arrays.boxes, problem.arrays.triangles, square, line_of_sight, links)
    return links
