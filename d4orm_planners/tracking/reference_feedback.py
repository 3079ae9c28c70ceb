"""Feedback that brings robots back to a reference, whatever their model and the lag of their actuators.

A linear-quadratic regulator about the reference's present state and control (B. D. O. Anderson and J. B. Moore, Optimal
Control: Linear Quadratic Methods, 1990): what cannot be corrected, as the way aside of a car at rest, costs no control.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_planners.tracking.steering import (
    integrated,
    limit_controls,
    preferred_velocities,
    present_velocities,
    short_way_round,
    track_velocities,
)

HORIZON = 2.0  #: Time that the regulator looks ahead, in times in which the slowest robot gets to full speed
LOST = 1.0  #: Difference of a heading from the reference's beyond which its slopes say nothing [rad]
NEAR = 2.0  #: Distance from the reference, in radii, at which lost robots stand; from further they drive to it
DIFFERENCE = 1e-2  #: Share of a unit by which states and controls are varied to find the slopes of the motion


class Reference(NamedTuple):
    """Motion that robots follow, within a step; its own limits may be lower than theirs."""

    states: FloatArray  #: ``(K, n)`` now
    after: FloatArray  #: ``(K, n)`` at the end of the step
    controls: FloatArray  #: ``(K, m)`` what its actuators are told
    applied: FloatArray  #: ``(K, m)`` what they apply now


@dataclass(frozen=True, eq=False)
class ControlSetpoint:
    """Setpoint of a team until the next step; its arrays are read-only."""

    position: Floats  #: ``(K, d)`` where robots are to be at the end of the period [m]
    velocity: Floats  #: ``(K, d)`` their velocity then [m/s]
    acceleration: Floats  #: ``(K, d)`` on the way there [m/s^2]
    heading: Floats  #: ``(K,)`` heading at the end of the period [rad]; zero for robots whose model has none
    control: FloatArray  #: ``(K, m)`` controls of the robots' models, within each robot's limits
    arrived: BoolArray  #: ``(K,)`` bool: it stays at its goal from now on
    held: bool  #: True if the policy did not answer in time: robots brake


class ActuatorLag:
    """Lag of first order with which actuators approach what they are told, by time constants ``(K,)`` [s]."""

    def __init__(self, constants: Floats, dt: float) -> None:
        self.constants = constants  #: ``(K,)`` time constants [s]
        #: ``(K, 1)`` share of a difference from what they are told that is left after a step
        self.remains: Floats = np.where(constants > 0, np.exp(-dt / np.maximum(constants, 1e-12)), 0.0)[:, None]
        self.share: Floats = (constants / dt)[:, None] * (1 - self.remains)  #: ``(K, 1)`` of it in the mean over a step

    def mean(self, told: Floats, applied: Floats) -> Floats:
        """``(K, m)`` what they apply in the mean over a step, and ``applied`` when it begins."""
        return told + self.share * (applied - told)

    def after(self, told: Floats, applied: Floats) -> Floats:
        """``(K, m)`` what they apply at the end of such a step."""
        return told + self.remains * (applied - told)


class LaggedReference:
    """Another reference, followed as by robots whose actuators lag: those can drive so, and need no control beyond it.

    Its states are that one's by a low-pass filter, which is what linear models do. All of a team lag as the slowest, so
    that none gets ahead of the others. They begin in ``states`` ``(K, n)``.
    """

    def __init__(self, problem: Problem, states: FloatArray, lag: ActuatorLag) -> None:
        self._problem = problem
        self.adopt(lag)
        at_rest, self._behind = np.zeros((len(states), problem.control_size), np.float32), np.zeros(states.shape)
        self._behind[:, : problem.dimension] -= self._slowest * present_velocities(problem, states, at_rest)
        self._filtered = self.applied = at_rest.astype(np.float64)

    def adopt(self, lag: ActuatorLag) -> None:
        """Go on as by actuators with another lag."""
        self.lag, self._slowest = lag, float(lag.constants.max())
        self._filter = ActuatorLag(np.full_like(lag.constants, self._slowest), self._problem.dt)
        self._ratio = (lag.constants / max(self._slowest, 1e-12))[:, None]

    def follow(self, states: FloatArray, after: FloatArray, controls: FloatArray) -> Reference:
        """Return what follows a step of the other from states to others ``(K, n)`` by controls ``(K, m)``."""
        passed: Floats = short_way_round(self._problem, (after - states).astype(np.float64))
        behind, applied, wanted = self._behind, self.applied, controls.astype(np.float64)
        self._behind = self._filter.after(-self._slowest / self._problem.dt * passed, behind)
        # Quicker actuators are told less than the slowest, whose filter is the reference's.
        mean = self._filter.mean(wanted, self._filtered)
        told = mean + self._ratio * (wanted - mean)
        self._filtered, self.applied = self._filter.after(wanted, self._filtered), self.lag.after(told, applied)
        rows = states + behind, after + self._behind, told, applied
        return Reference(*(row.astype(np.float32) for row in rows))


def regulated(
    problem: Problem, states: FloatArray, reference: Reference, applied: Floats, lag: ActuatorLag
) -> FloatArray:
    """``(K, m)`` controls within the limits that lead robots from ``states`` ``(K, n)`` back to a reference.

    Full control is worth a distance of a radius, or a radian. Who is lost drives to where the reference
    will be, or stands.

    Args:
        problem: The robots.
        states: Those of the robots.
        reference: Motion to go back to.
        applied: ``(K, m)`` what their actuators apply now.
        lag: Theirs.
    """
    limits = np.where(problem.team.control_limits > 0, problem.team.control_limits, np.float32(1))
    mean = lag.mean(reference.controls.astype(np.float64), reference.applied.astype(np.float64))
    missed, by_state, by_control = _linearised(problem, reference, mean.astype(np.float32), limits)
    made_good = np.einsum("kmn,kn->km", np.linalg.pinv(by_control), missed)
    missed -= np.einsum("knm,km->kn", by_control, made_good)
    controls, off = reference.controls + made_good, short_way_round(problem, (reference.states - states).astype(float))
    by_state, by_control = _augmented(by_state, by_control, missed, lag)
    lags = (reference.applied + made_good - applied)[:, : applied.shape[1] if lag.constants.any() else 0]
    off = np.hstack([off, lags, np.ones((len(off), 1))])
    weights = np.hstack([_weights(problem.team), np.zeros((len(off), lags.shape[1] + 1))])
    horizon = HORIZON * float((problem.team.max_speed / problem.team.max_acceleration).max()) / problem.dt
    controls += np.einsum("kmn,kn->km", _gains(weights, limits, by_state, by_control, max(horizon, 2.0)), off)
    return _unless_lost(problem, states, reference, limit_controls(problem, controls.astype(np.float32)))


def _unless_lost(problem: Problem, states: FloatArray, reference: Reference, controls: FloatArray) -> FloatArray:
    """``controls`` ``(K, m)``, but of robots with a heading that no small correction leads back, as they face elsewhere
    or have stopped far beside a reference that stands: those drive to where it will be, and stand where that is near.
    """
    goals = reference.after[:, : problem.dimension]
    far = np.linalg.norm(goals - states[:, : problem.dimension], axis=1) > NEAR * problem.team.girth
    turns = np.array([model.heading_index is not None for model in problem.team.robot_models])
    facing = np.abs(problem.team.headings(short_way_round(problem, reference.states - states)))
    stands = (reference.after == reference.states).all(axis=1)
    lost = turns & ((facing > LOST) | (far & stands))
    if not lost.any():
        return controls
    wanted = preferred_velocities(problem, states, goals) * far[:, None]
    return np.where(lost[:, None], track_velocities(problem, states, wanted.astype(np.float32)), controls)


def _linearised(
    problem: Problem, reference: Reference, controls: FloatArray, limits: FloatArray
) -> tuple[Floats, Floats, Floats]:
    """``(K, n)`` what ``controls`` ``(K, m)`` lack to the end of a reference, and the slopes of states a step later by
    states ``(K, n, n)`` and by controls ``(K, n, m)``, varied by a share of their ``limits`` ``(K, m)``.

    Motions are the same everywhere: at the origin positions lose least to rounding. Limits have no part in it: next to
    them slopes would be those of one side.
    """
    now, after, *_ = reference
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


def _augmented(by_state: Floats, by_control: Floats, missed: Floats, lag: ActuatorLag) -> tuple[Floats, Floats]:
    """Slopes ``(K, N, N)`` and ``(K, N, m)`` of the states, of what actuators with a lag apply, and of a last one.

    That is always one: it has the reference go on to depart from its own controls as it does now, by ``missed``.
    """
    count, n, m = by_control.shape
    if lag.constants.any():
        remains, share, kept = lag.remains, lag.share, np.broadcast_to(np.eye(m), (count, m, m))
        missed = np.pad(missed, ((0, 0), (0, m)))
        rows = [np.dstack([by_state, share[..., None] * by_control])]
        rows.append(np.dstack([np.zeros((count, m, n)), remains[..., None] * kept]))
        by_state = np.concatenate(rows, axis=1)
        by_control = np.concatenate([(1 - share[..., None]) * by_control, (1 - remains[..., None]) * kept], axis=1)
    last = np.broadcast_to(np.append(np.zeros(by_state.shape[1]), 1.0), (count, 1, by_state.shape[1] + 1))
    slopes = np.concatenate([np.dstack([by_state, missed[..., None]]), last], axis=1)
    return slopes, np.pad(by_control, ((0, 0), (0, 1), (0, 0)))


def _weights(team: Team) -> Floats:
    """``(K, n)`` of squared distances from the reference."""
    weights, headings = np.zeros((team.num_robots, team.state_size)), [m.heading_index for m in team.robot_models]
    weights[:, : team.dimension] = 1 / team.girth[:, None].astype(np.float64) ** 2
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
