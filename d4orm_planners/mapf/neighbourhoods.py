"""Neighbourhoods of large-neighbourhood search: robots that look for other paths together.

As in MAPF-LNS (J. Li, Z. Chen, D. Harabor, P. J. Stuckey and S. Koenig, IJCAI 2021), on a roadmap
(:mod:`~d4orm_planners.mapf.roadmap_team`) and under the robots' dynamics (:mod:`~d4orm_planners.mapf.lns`).
"""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray


def draw_neighbourhood(
    random: np.random.Generator,
    delay: Floats,
    places: FloatArray | Floats,
    until: IntArray,
    nearness: float,
    sizes: tuple[int, int],
) -> IntArray:
    """A robot that is late, and some that it comes near to, in random order.

    Args:
        random: Draws them.
        delay: ``(K,)`` chance of each to be the late one, in any unit.
        places: ``(T + 1, K, d)`` [m].
        until: ``(K,)`` the last step of each at which it may come near to others.
        nearness: Random distance by which a robot may be farther away and still be chosen [m].
        sizes: The least and the greatest number of robots.
    """
    robot = int(random.choice(len(delay), p=delay / delay.sum()))
    places = places[: until[robot] + 1]
    gaps = np.sqrt(((places - places[:, [robot]]) ** 2).sum(axis=2).min(axis=0))
    gaps += nearness * random.random(len(delay))
    gaps[robot] = -1.0
    return random.permutation(np.argsort(gaps, kind="stable")[: random.integers(*sizes, endpoint=True)])
