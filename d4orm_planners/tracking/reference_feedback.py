"""Feedback that brings robots back to a reference, whatever their model and the lag of their actuators.

A linear-quadratic regulator about the reference's present state and control (B. D. O. Anderson and J. B. Moore, Optimal
Control: Linear Quadratic Methods, 1990): what cannot be corrected, as the way aside of a car at rest, costs no control.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_planners.tracking.steering import (
    integrated,
    limit_controls,
    preferred_velocities,
    short_way_round,
    track_velocities,
)

HORIZON = 2.0
"""Time that the regulator looks ahead, in times in which the slowest robot gets to full speed."""
LOST = 1.0
"""Difference of a heading from the reference's beyond which its slopes say nothing [rad]."""
FAR = 2.0
"""Distance from the reference, in radii, from which on robots that are lost drive to it; nearer ones stand."""
DIFFERENCE = 1e-2
"""Share of a unit by which states and controls are varied to find the slopes of the motion."""


class Reference(NamedTuple):
    """Motion that robots follow, within a step; its own limits may be lower than theirs."""

    states: FloatArray  #: ``(K, n)`` now
    after: FloatArray  #: ``(K, n)`` at the end of the step
    controls: FloatArray  #: ``(K, m)``


class Actuators(NamedTuple):
    """Actuators that approach what they are told, with a lag of first order."""

    applied: Floats  #: ``(K, m)`` what they apply now
    remains: Floats  #: ``(K, 1)`` share of a difference from what they are told that is left after a step
    share: Floats  #: ``(K, 1)`` of such a difference in the mean over a step


def regulated(
    problem: Problem, states: FloatArray, reference: Reference, actuators: Actuators | None = None
) -> FloatArray:
    """``(K, m)`` controls within the limits that lead robots from ``states`` ``(K, n)`` back to a reference.

    Full control is worth a distance of a radius, or a radian. Who is lost drives to where the reference
    will be, or stands.

    Args:
        problem: The robots.
        states: Those of the robots.
        reference: Motion to go back to.
        actuators: Those that have a lag; by default none has.
    """
    limits = np.where(problem.team.control_limits > 0, problem.team.control_limits, np.float32(1))
    missed, by_state, by_control = _linearised(problem, reference, limits)
    made_good = np.einsum("kmn,kn->km", np.linalg.pinv(by_control), missed)
    missed -= np.einsum("knm,km->kn", by_control, made_good)
    controls, off = reference.controls + made_good, short_way_round(problem, (reference.states - states).astype(float))
    if actuators is not None:
        off = np.hstack([off, controls - actuators.applied])
        by_state, by_control = _lagging(by_state, by_control, actuators)
    # One more state, which is always one, has the reference go on to depart from its own controls as it does now.
    off, missed = np.pad(off, ((0, 0), (0, 1)), constant_values=1.0), _widened(missed[..., None], off.shape[1] + 1)
    by_state, by_control = np.dstack([_widened(by_state, off.shape[1]), missed]), _widened(by_control, off.shape[1])
    by_state[:, -1, -1] = 1.0
    weights = _widened(_weights(problem.team), off.shape[1])
    horizon = HORIZON * float((problem.team.max_speed / problem.team.max_acceleration).max()) / problem.dt
    controls += np.einsum("kmn,kn->km", _gains(weights, limits, by_state, by_control, max(horizon, 2.0)), off)
    controls, lost = limit_controls(problem, controls.astype(np.float32)), _lost(problem, states, reference)
    return np.where(lost[:, None], _found_again(problem, states, reference), controls) if lost.any() else controls


def _lost(problem: Problem, states: FloatArray, reference: Reference) -> BoolArray:
    """``(K,)`` robots with a heading that no small correction leads back: they face elsewhere, or have stopped far
    beside a reference that stands.
    """
    turns = np.array([model.heading_index is not None for model in problem.team.robot_models])
    facing = np.abs(problem.team.headings(short_way_round(problem, reference.states - states)))
    stands = (reference.after == reference.states).all(axis=1)
    return turns & ((facing > LOST) | (_is_far(problem, states, reference) & stands))


def _is_far(problem: Problem, states: FloatArray, reference: Reference) -> BoolArray:
    off = (reference.after - states)[:, : problem.dimension]
    return np.linalg.norm(off, axis=1) > FAR * problem.team.radius


def _found_again(problem: Problem, states: FloatArray, reference: Reference) -> FloatArray:
    """``(K, m)`` controls of robots that drive to where the reference will be, or stand where that is near."""
    goals = reference.after[:, : problem.dimension]
    wanted = preferred_velocities(problem, states, goals) * _is_far(problem, states, reference)[:, None]
    return track_velocities(problem, states, wanted.astype(np.float32))


def _widened(rows: Floats, size: int) -> Floats:
    """``(K, size, ...)`` rows with zeros behind their own ``(K, n, ...)``."""
    return np.pad(rows, ((0, 0), (0, size - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)))


def _linearised(problem: Problem, reference: Reference, limits: FloatArray) -> tuple[Floats, Floats, Floats]:
    """``(K, n)`` what the controls of a reference lack to its end, and the slopes of states a step later by states
    ``(K, n, n)`` and by controls ``(K, n, m)``, varied by a share of their ``limits`` ``(K, m)``.

    Motions are the same everywhere: at the origin positions lose least to rounding. Limits have no part in it: next to
    them slopes would be those of one side.
    """
    now, after, controls = reference
    d, n = problem.dimension, now.shape[1]
    here = np.hstack([np.zeros_like(now[:, :d]), now[:, d:], controls])
    sizes = DIFFERENCE * np.hstack([np.ones_like(now), limits])
    changes = sizes * np.eye(sizes.shape[1], dtype=np.float32)[:, None]
    rows = here + np.concatenate([changes, -changes, np.zeros_like(changes[:1])])
    ends = integrated(problem, rows[..., :n], rows[..., n:]).astype(np.float64)
    more, less = ends[:-1].reshape(2, *changes.shape[:2], n)
    slopes = np.moveaxis((more - less) / (2 * sizes.T[..., None]), 0, 2)
    missed = after.astype(np.float64) - ends[-1]
    missed[:, :d] -= now[:, :d]
    return short_way_round(problem, missed), slopes[..., :n], slopes[..., n:]


def _lagging(by_state: Floats, by_control: Floats, actuators: Actuators) -> tuple[Floats, Floats]:
    """Slopes ``(K, n+m, n+m)`` and ``(K, n+m, m)`` of states and of what actuators apply."""
    (_, remains, share), (count, n, m) = actuators, by_control.shape
    kept = np.broadcast_to(np.eye(m), (count, m, m))
    states = np.concatenate([by_state, share[..., None] * by_control], axis=2)
    applied = np.concatenate([np.zeros((count, m, n)), remains[..., None] * kept], axis=2)
    controls = np.concatenate([(1 - share[..., None]) * by_control, (1 - remains[..., None]) * kept], axis=1)
    return np.concatenate([states, applied], axis=1), controls


def _weights(team: Team) -> Floats:
    """``(K, n)`` of squared distances from the reference."""
    weights, headings = np.zeros((team.num_robots, team.state_size)), [m.heading_index for m in team.robot_models]
    weights[:, : team.dimension] = 1 / team.radius[:, None].astype(np.float64) ** 2
    for robot, heading in enumerate(headings):
        if heading is not None:
            weights[robot, heading] = 1.0
    return weights


def _gains(weights: Floats, limits: FloatArray, by_state: Floats, by_control: Floats, horizon: float) -> Floats:
    """``(K, m, n)`` of the regulator for the motion's slopes by states ``(K, n, n)`` and controls ``(K, n, m)``.

    It looks ahead by a power of two of steps, at least ``horizon``, found by doubling (E. K.-W. Chu, H.-Y. Fan, W.-W.
    Lin and C.-S. Wang, International Journal of Control, 2004).
    """
    cost, price = (rows[:, None] * np.eye(rows.shape[1]) for rows in (weights, 1 / limits.astype(np.float64) ** 2))
    turned: Any = by_control.transpose(0, 2, 1)
    effect, a, value = by_control @ np.linalg.solve(price, turned), by_state, cost
    for _ in range(int(np.ceil(np.log2(horizon)))):
        halves = np.linalg.inv(np.eye(a.shape[1]) + effect @ value)
        once, back = halves @ a, a.transpose(0, 2, 1)
        value, effect, a = value + back @ value @ once, effect + a @ halves @ effect @ back, a @ once
    left = turned @ value
    gains: Floats = np.linalg.solve(price + left @ by_control, left @ by_state)
    return gains
