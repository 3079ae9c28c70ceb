"""A problem as the engines read it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.footprint_arrays import FootprintArrays
from d4orm_env.geometry.world_index import WorldIndex


class ProblemArrays(NamedTuple):
    """A problem as the engines read it: plain arrays, float32 unless said, one struct for numba and JAX alike.

    Attributes:
        model_codes: ``(K,)`` int32.
        limits: ``(K, L)`` see :attr:`~d4orm_env.core.team.Team.limits`.
        radius: ``(K,)``.
        start: ``(K, n)``.
        goal: ``(K, d)``.
        inverse_initial_distance: ``(K,)`` one over the distance from start to goal (at least the goal radius).
        boxes: ``(., 2 d + 1)`` obstacles, see :class:`~d4orm_env.geometry.shapes.Shapes`.
        triangles: ``(., 6)`` more of them.
        grid: Their index.
        bounds: ``(2, d)``, infinite where open.
        time_step: ``(4,)`` dt, dt/2, dt/3, dt/6.
        margin: ``()``.
        squared_goal_radius: ``()``.
        squared_goal_speed: ``(K,)`` with the allowance for rounding; infinite without a limit.
        docks: ``()`` bool: a robot that has arrived stays there for good.
        collision_penalty: ``()``.
        turns_at_goals: ``()`` bool, true; ``None`` if no robot has a goal heading, and so are the next two.
        goal_direction: ``(K, 2)`` goal headings as unit vectors, zero for none.
        squared_goal_chord: ``(K,)`` square of the chord by which they may be missed, infinite for none.
        footprints: Of a team that is not all discs; the radii are then those of discs round them. Else ``None``:
            numba leaves out of a kernel what asks whether an argument is ``None`` and would go on if it were not.
    """

    model_codes: NDArray[np.int32]
    limits: FloatArray
    radius: FloatArray
    start: FloatArray
    goal: FloatArray
    inverse_initial_distance: FloatArray
    boxes: FloatArray
    triangles: FloatArray
    grid: WorldIndex
    bounds: FloatArray
    time_step: FloatArray
    margin: np.float32
    squared_goal_radius: np.float32
    squared_goal_speed: FloatArray
    docks: np.bool_
    collision_penalty: np.float32
    turns_at_goals: np.bool_ | None
    goal_direction: FloatArray | None
    squared_goal_chord: FloatArray | None
    footprints: FootprintArrays | None


def goal_directions(headings: FloatArray) -> FloatArray:
    """``(K, 2)`` goal headings ``(K,)`` as unit vectors; zero for none."""
    known = ~np.isnan(headings)
    sine, cosine = portable.sin_cos(np.where(known, headings, 0).astype(np.float64))
    return (np.stack([cosine, sine], axis=1) * known[:, None]).astype(np.float32)


def squared_chords(headings: FloatArray, tolerance: FloatArray) -> FloatArray:
    """``(K,)`` squares of the chords by which unit vectors may miss goal headings; infinite for none."""
    half = portable.sin_cos(tolerance.astype(np.float64) / 2)[0]
    return np.where(np.isnan(headings), np.inf, 4 * half * half).astype(np.float32)


def inverse_initial_distance(positions: FloatArray, goal: FloatArray, goal_radius: float) -> FloatArray:
    """``(K,)`` one over the start distance; a robot that starts at its goal counts from the goal radius."""
    inverse: FloatArray = (1.0 / np.maximum(np.linalg.norm(goal - positions, axis=-1), goal_radius)).astype(np.float32)
    return inverse
