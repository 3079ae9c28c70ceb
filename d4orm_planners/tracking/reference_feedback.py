"""Feedback that brings robots with a heading back to a reference, whatever their model.

A linear-quadratic regulator about the reference's present state and control (B. D. O. Anderson and J. B. Moore, Optimal
Control: Linear Quadratic Methods, 1990): what cannot be corrected, as the way aside of a car at rest, costs no control.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_planners.tracking.steering import advanced, limit_controls, short_way_round, track_velocities

HORIZON = 20
"""Steps that the regulator looks ahead."""
DIFFERENCE = 1e-2
"""Share of a unit by which states and controls are varied to find the slopes of the motion."""


class Reference(NamedTuple):
    """Motion that robots follow, within a step; its own limits may be lower than theirs."""

    states: FloatArray  #: ``(K, n)`` now
    after: FloatArray  #: ``(K, n)`` at the end of the step
    controls: FloatArray  #: ``(K, m)``


def with_feedback(problem: Problem, states: FloatArray, velocities: FloatArray, reference: Reference) -> FloatArray:
    """``(K, m)`` controls within the limits that lead robots from ``states`` ``(K, n)`` back to a reference.

    Those with a heading by the regulator, to which full control is worth a distance of a radius, or a radian; others
    directly.

    Args:
        problem: The robots.
        states: Those of the robots.
        velocities: ``(K, d)`` that lead directly to the reference [m/s].
        reference: Motion to go back to.
    """
    directly = track_velocities(problem, states, velocities)
    turning = np.array([model.heading_index is not None for model in problem.team.robot_models])
    if not turning.any():
        return directly
    limits = np.where(problem.team.control_limits > 0, problem.team.control_limits, np.float32(1))
    missed, by_state, by_control = _linearised(problem, reference, limits)
    off = short_way_round(problem, (reference.states - states).astype(np.float64))
    regulated = reference.controls + np.einsum("kmn,kn->km", np.linalg.pinv(by_control), missed)
    regulated += np.einsum("kmn,kn->km", _gains(_weights(problem.team), limits, by_state, by_control), off)
    return np.where(turning[:, None], limit_controls(problem, regulated.astype(np.float32)), directly)


def _linearised(problem: Problem, reference: Reference, limits: FloatArray) -> tuple[Floats, Floats, Floats]:
    """``(K, n)`` what the controls of a reference lack to its end, and the slopes of states a step later by states
    ``(K, n, n)`` and by controls ``(K, n, m)``, varied by a share of their ``limits`` ``(K, m)``.

    Motions are the same everywhere: at the origin positions lose least to rounding.
    """
    now, after, controls = reference
    d, n = problem.dimension, now.shape[1]
    here = np.hstack([np.zeros_like(now[:, :d]), now[:, d:], controls])
    sizes = DIFFERENCE * np.hstack([np.ones_like(now), limits])
    changes = sizes * np.eye(sizes.shape[1], dtype=np.float32)[:, None]
    rows = here + np.concatenate([changes, -changes, np.zeros_like(changes[:1])])
    ends = advanced(problem, rows[..., :n], rows[..., n:]).astype(np.float64)
    more, less = ends[:-1].reshape(2, *changes.shape[:2], n)
    slopes = np.moveaxis((more - less) / (2 * sizes.T[..., None]), 0, 2)
    missed = after.astype(np.float64) - ends[-1]
    missed[:, :d] -= now[:, :d]
    return short_way_round(problem, missed), slopes[..., :n], slopes[..., n:]


def _weights(team: Team) -> Floats:
    """``(K, n)`` of squared distances from the reference."""
    weights, headings = np.zeros((team.num_robots, team.state_size)), [m.heading_index for m in team.robot_models]
    weights[:, : team.dimension] = 1 / team.radius[:, None].astype(np.float64) ** 2
    for robot, heading in enumerate(headings):
        if heading is not None:
            weights[robot, heading] = 1.0
    return weights


def _gains(weights: Floats, limits: FloatArray, by_state: Floats, by_control: Floats) -> Floats:
    """``(K, m, n)`` of the regulator for the motion's slopes by states ``(K, n, n)`` and controls ``(K, n, m)``."""
    cost, price = (rows[:, None] * np.eye(rows.shape[1]) for rows in (weights, 1 / limits.astype(np.float64) ** 2))
    value, gains = cost, np.zeros(by_control.transpose(0, 2, 1).shape)
    for _ in range(HORIZON):
        left = by_control.transpose(0, 2, 1) @ value
        gains[:] = np.linalg.solve(price + left @ by_control, left @ by_state)
        value = cost + by_state.transpose(0, 2, 1) @ value @ (by_state - by_control @ gains)
    return gains
