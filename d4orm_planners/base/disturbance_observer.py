"""An estimate of constant disturbances: a thrust that is too weak, a slope, a steady wind."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pettingzoo import ParallelEnv

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray, short_repr
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.controls import Lag
from d4orm_planners.tracking.reference_feedback import ActuatorLag
from d4orm_planners.tracking.steering import limit_controls, rates, short_way_round

GAIN = 0.1  #: Share of a step's residual that goes into the estimate
MOST = 0.5  #: Largest estimate, as a share of the control's limit: the rest is needed to steer
LAGS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)  #: Time constants that are told apart where none is given, in time steps
KEPT, STEPS, BETTER, DRIVEN = 0.95, 15, 0.6, 0.2
"""Share of what is known of them that a step keeps, steps after which they are compared, the share of its residual with
which another one than the present must explain what robots did, and the deviation that their controls must have had, as
a share of their limits: those of robots at rest answer to noise."""


def check_lag(lag: ArrayLike) -> ArrayLike:
    """Return time constants of actuators [s], one or one per robot, as they are; ValueError unless zero or more."""
    try:
        constants: Floats = np.asarray(lag, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"lag is {short_repr(lag)}; give one number or one per robot [s]") from None
    if not (np.isfinite(constants) & (constants >= 0)).all():
        raise ValueError(f"lag is {short_repr(lag)}; it must be finite and not negative")
    return lag


def with_lag_of(env: ParallelEnv) -> Problem:
    """The problem of an environment; if its team has a lag, with that of the environment's ``Lag``, or without."""
    problem: Problem = env.unwrapped.problem
    if not problem.team.lag.any():
        return problem
    lag = sum(one.time_constant for one in env.unwrapped.options.disturbances if isinstance(one, Lag))
    team = problem.team.replace(lag=np.where(problem.team.lag > 0, lag, 0.0))
    return problem.with_state(problem.start, problem.goal, team=team)


class DisturbanceObserver:
    """Estimator of the disturbance of each robot, for models whose controls are derivatives.

    ``y(t+1) = y(t) + dt (u(t) + bias)``, where ``y`` is the velocity of double integrators and the position of
    first-order ones, and ``u`` follows the control with a first-order lag.

    Args:
        problem: The team.
        lag: Time constant of the actuators [s], one or ``K``; ``None`` finds it out (:class:`LagFinder`).

    Attributes:
        lag: That of the actuators, of whatever model.
        applied: ``(K, m)`` what the actuators apply now, but for the disturbance.
        bias: ``(K, d)`` the estimate, in units of the controls; zero for other models.

    Raises:
        ValueError: If the lag is negative, or neither one number nor one per robot.
    """

    def __init__(self, problem: Problem, lag: ArrayLike | None = 0.0) -> None:
        self.problem, count, d = problem, problem.num_robots, problem.dimension
        self._summed = summed_controls(problem)
        self._finder = LagFinder(problem, self._summed) if lag is None else None
        lag = 0.0 if lag is None else lag
        given: Floats = np.asarray(check_lag(lag), np.float64)
        if given.shape not in ((), (1,), (count,)):
            raise ValueError(f"lag has shape {given.shape}; give one number or one per robot ({count})")
        constants = np.broadcast_to(given, (count,))
        names = problem.team.models
        columns = {"holonomic2d": range(d, 2 * d), "holonomic3d": range(d, 2 * d), "velocity2d": range(d)}
        self._observed: BoolArray = np.array([name in columns for name in names])
        self._columns = np.array([columns.get(name, range(d)) for name in names])
        self._most = MOST * problem.team.control_limits[:, :d].astype(np.float64)
        fastest = np.where([name == "velocity2d" for name in names], np.inf, problem.team.max_speed.astype(np.float64))
        self._fastest = fastest[:, None]
        self._set_lag(constants)
        self.bias, self.applied = np.zeros((count, d)), np.zeros((count, problem.control_size))
        self._explained: Floats | None = None
        self._before: Floats | None = None

    def go_on_from(self, other: DisturbanceObserver) -> None:
        """Keep what another has learned of the same robots."""
        self.bias = other.bias
        if self._finder is not None:
            self._finder.constants = other.lag.constants
            self._set_lag(other.lag.constants)

    def _set_lag(self, constants: Floats) -> None:
        self.lag = ActuatorLag(constants, self.problem.dt)
        self._trust = self.problem.dt / (self.problem.dt + 2 * constants[:, None])

    def observe(self, states: FloatArray, known: BoolArray) -> bool:
        """Learn from measured states ``(K, n)``, where they are known ``(K,)``, now and a step ago.

        Returned is whether another lag than before has been found.
        """
        now = np.take_along_axis(states, self._columns, axis=1).astype(np.float64)
        now[~known] = np.nan
        if self._before is not None and self._explained is not None:
            expected = self._before + self.problem.dt * (self._explained + self.bias)
            size = np.linalg.norm(expected, axis=1, keepdims=True)
            expected /= np.maximum(size / self._fastest, 1.0)
            left = (now - expected) / self.problem.dt
            better = np.clip(self.bias + GAIN * left, -self._most, self._most)
            self.bias = np.where(self._observed[:, None] & np.isfinite(left), better, self.bias)
        self._before = now
        if self._finder is None or not self._finder.observe(states, known):
            return False
        self._set_lag(self._finder.constants)
        self.applied = self._finder.applied
        return True

    @property
    def driven(self) -> FloatArray:
        """``(K, m)`` controls without a lag or disturbance that do as robots do now."""
        driven = self.applied.copy()
        driven[:, : self.problem.dimension] += self.bias
        return driven.astype(np.float32)

    def undelayed(self, states: FloatArray, known: BoolArray) -> FloatArray:
        """``(K, n)`` states that obey the models as if there were no lag; those of robots that are not ``known``
        ``(K,)`` as they are.

        With a lag ``tau`` these are ``x + tau dx/dt``: where models are linear they move as the control itself has it.
        """
        lag, rate = np.where(known, self.lag.constants, 0.0), rates(self.problem, states, self.driven)
        return states + (lag[:, None] * rate).astype(np.float32)

    def shifted(self, lead: Floats, reference: FloatArray, states: FloatArray, known: BoolArray) -> Floats:
        """``(K, d)`` a lead of setpoints, shifted against a lasting distance from the reference, up to the margin."""
        d, margin = self.problem.dimension, self.problem.margin
        error = np.where(known[:, None], reference[:, :d] - states[:, :d], 0.0)
        return np.clip(lead + GAIN * error, -margin, margin)

    def blended(self, states: FloatArray, reference: FloatArray) -> FloatArray:
        """``(K, n)`` the states of a reference, moved towards measured ones by the share that no lag explains."""
        off = short_way_round(self.problem, states - reference)
        return reference + (self._trust * off).astype(np.float32)

    def executed(self, before: FloatArray, after: FloatArray, controls: FloatArray) -> FloatArray:
        """``(K, m)`` controls with which robots without limits on their states do as their models did, by their
        ``controls``.

        A model that is at its speed limit does not obey a control that speeds it up; a robot does. It is in state
        ``before``, the model ``after`` the step in another ``(K, n)``.
        """
        swallowed = (after - before) / np.float32(self.problem.dt) - rates(self.problem, before, controls)
        return controls + np.einsum("kn,knm->km", swallowed, self._summed)

    def compensated(self, controls: FloatArray, resting: BoolArray) -> FloatArray:
        """``(K, m)`` controls with the same effect as these without the disturbance; unchanged for robots at rest."""
        d, wanted = self.problem.dimension, controls.copy()
        wanted[:, :d] -= np.where(resting[:, None], 0.0, self.bias).astype(np.float32)
        sent = limit_controls(self.problem, wanted)
        self._explained = self.lag.mean(sent.astype(float), self.applied)[:, :d]
        self._explained[resting] = np.nan
        self.applied = self.lag.after(sent.astype(float), self.applied)
        if self._finder is not None:
            self._finder.send(sent)
        return sent


class LagFinder:
    """Estimator of the lag of each robot's actuators: of a few time constants (:data:`LAGS`) the one from which what
    robots did follows best by a straight line, so that neither a steady push nor weak actuators make a difference.

    Robots whose controls do not sum up to a state are taken to have none; ``summed`` ``(K, n, m)`` is
    :func:`summed_controls`.
    """

    def __init__(self, problem: Problem, summed: FloatArray) -> None:
        self._problem, self._summed, count = problem, summed, problem.num_robots
        self._lags = [ActuatorLag(np.full(count, steps * problem.dt), problem.dt) for steps in LAGS]
        self._applied = np.zeros((len(LAGS), count, problem.control_size))
        self._means = self._applied.copy()
        self._moments = np.zeros((6, *self._applied.shape))
        self._before: FloatArray | None = None
        self.constants = np.zeros(count)  #: ``(K,)`` time constants found so far [s]

    @property
    def applied(self) -> Floats:
        """``(K, m)`` what the actuators apply now."""
        return self._applied[self._present, np.arange(len(self.constants))]

    @property
    def _present(self) -> IntArray:
        return np.abs(np.array(LAGS)[:, None] * self._problem.dt - self.constants).argmin(axis=0)

    def send(self, controls: FloatArray) -> None:
        """Note the controls ``(K, m)`` of the next step."""
        pairs = list(zip(self._lags, self._applied))
        self._means = np.stack([lag.mean(controls.astype(float), applied) for lag, applied in pairs])
        self._applied = np.stack([lag.after(controls.astype(float), applied) for lag, applied in pairs])

    def observe(self, states: FloatArray, known: BoolArray) -> bool:
        """Learn from measured states ``(K, n)``; return whether another lag than before has been found."""
        before, self._before = self._before, np.where(known[:, None], states, np.nan)
        if before is None:
            return False
        done = np.einsum("kn,knm->km", (self._before - before) / self._problem.dt, self._summed)
        seen = np.isfinite(done).all(axis=1, keepdims=True)
        counted = seen & self._summed.any(axis=1)
        x, y = np.where(counted, self._means, 0.0), np.broadcast_to(np.where(counted, done, 0.0), self._means.shape)
        new = np.stack([np.broadcast_to(seen, x.shape), x, y, x * x, x * y, y * y])
        self._moments = KEPT * self._moments + new
        weight = self._moments[0]
        x, y, xx, xy, yy = self._moments[1:] / np.maximum(weight, 1e-9)
        spread = xx - x * x
        fitted = np.divide((xy - x * y) ** 2, spread, out=np.zeros_like(spread), where=spread > 0)
        left = (yy - y * y - fitted).sum(axis=2)
        best, rows = left.argmin(axis=0), np.arange(len(self.constants))
        driven = spread[0] > (DRIVEN * self._problem.team.control_limits.astype(np.float64)) ** 2
        enough = (weight[0, :, 0] > (1 - KEPT**STEPS) / (1 - KEPT)) & driven.any(axis=1)
        better = enough & (left[best, rows] < BETTER * left[self._present, rows])
        self.constants = np.where(better, np.array(LAGS)[best] * self._problem.dt, self.constants)
        return bool(better.any())


def summed_controls(problem: Problem) -> FloatArray:
    """``(K, n, m)`` one where a state other than a position or heading is the sum of a control over time, else zero."""
    rest, still = np.zeros_like(problem.start), np.zeros((problem.num_robots, problem.control_size), np.float32)
    summed = np.zeros((*rest.shape, problem.control_size), np.float32)
    for number, unit in enumerate(np.eye(problem.control_size, dtype=np.float32)):
        summed[..., number] = rates(problem, rest, still + unit) == 1
    summed[:, : problem.dimension] = 0
    for robot, model in enumerate(problem.team.robot_models):
        summed[robot, [] if model.heading_index is None else model.heading_index] = 0
    return summed
