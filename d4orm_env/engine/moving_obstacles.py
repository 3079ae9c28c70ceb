"""Dynamic obstacles: bodies that move among the robots."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS


@cached_kernel(**OPTIONS)
def meet_bodies(
    states: FloatArray, radius: FloatArray, bodies: FloatArray, margin: np.float32, touched: BoolArray, near: BoolArray
) -> None:
    """Find the robots in contact with a body, and those within the margin of one.

    Args:
        states: ``(B, K, n)``, positions first [m].
        radius: ``(K,)`` of the robots [m].
        bodies: ``(B, N, 2 d + 1)`` position, velocity and radius.
        margin: Float32 [m].
        touched: ``(B, K)`` bool, output.
        near: ``(B, K)`` bool, output.
    """
    dimension = (bodies.shape[2] - 1) // 2
    for b in range(states.shape[0]):
        for k in range(states.shape[1]):
            touched[b, k] = near[b, k] = False
            for i in range(bodies.shape[1]):
                gap2 = np.float32(0)
                for axis in range(dimension):
                    gap = bodies[b, i, axis] - states[b, k, axis]
                    gap2 += gap * gap
                reach = radius[k] + bodies[b, i, 2 * dimension]
                touched[b, k] |= gap2 <= reach * reach
                near[b, k] |= gap2 <= (reach + margin) * (reach + margin)
