"""Waypoint that a robot can drive to straight."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem

LEAST = 5
"""Waypoints that a subgoal is ahead all the same: nearer ones hardly pull."""

_SHARES = np.linspace(0, 1, 9)[1:]
"""Shares of the straight line at which its clearance from obstacles is looked at."""


def visible_subgoals(
    problem: Problem, positions: FloatArray, path: FloatArray, indices: IntArray, targets: IntArray, docked: BoolArray,
    walls: bool,
) -> IntArray:  # fmt: skip
    """The furthest waypoint up to its subgoal that a robot can drive to straight, past what is at rest.

    A subgoal behind a corner, or behind a robot that has docked, would hold it there.

    Args:
        problem: The robots, the obstacles and the margin.
        positions: ``(K, d)`` where the robots are [m].
        path: ``(H+1, K, d)`` [m].
        indices: ``(K,)`` where on the path they are.
        targets: ``(K,)`` their subgoals.
        docked: ``(K,)`` robots at rest.
        walls: Whether obstacles count too.

    Returns:
        ``(K,)`` indices.
    """
    radius, standing = np.asarray(problem.team.radius), np.flatnonzero(docked)
    result = targets.copy()
    waiting = np.flatnonzero(~docked & (targets > indices + LEAST))
    while len(waiting):
        offset = path[result[waiting], waiting] - positions[waiting]
        blocked = _meets_standing(
            positions[waiting], offset, radius[waiting] + problem.margin / 2, positions[standing], radius[standing]
        )
        if walls:
            places = positions[waiting] + _SHARES[:, None, None] * offset
            clearance = problem.world.clearance(places.reshape(-1, places.shape[-1])).reshape(places.shape[:-1])
            blocked |= (clearance <= radius[waiting] + problem.margin / 2).any(axis=0)
        waiting = waiting[blocked]
        result[waiting] -= 1
        waiting = waiting[result[waiting] > indices[waiting] + LEAST]
    return result


def _meets_standing(
    begin: FloatArray, offset: FloatArray, reach: FloatArray, others: FloatArray, radius: FloatArray
) -> BoolArray:
    """``(N,)`` whether the straight path from ``begin`` by ``offset`` comes within reach of one of the others."""
    gap = others - begin[:, None]
    square = (offset**2).sum(axis=1)[:, None]
    share = np.clip((gap * offset[:, None]).sum(axis=2) / np.where(square > 0, square, 1), 0, 1)
    away = ((gap - share[:, :, None] * offset[:, None]) ** 2).sum(axis=2)
    meets: BoolArray = (away <= (reach[:, None] + radius) ** 2).any(axis=1)
    return meets
