"""Motions as Bernstein polynomials of the time, sampled at every step of a horizon, and systems for their coefficients.

R. T. Farouki, *The Bernstein polynomial basis: a centennial retrospective* (Computer Aided Geometric Design, 2012).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.engine.compiling import compiled


class Basis(NamedTuple):
    """The basis of degree ``n`` over ``T`` steps: a motion with coefficients ``c`` ``(n+1, d)`` is ``position @ c``."""

    position: Floats  #: ``(T, n+1)`` positions at steps 1 to T
    velocity: Floats  #: ``(T, n+1)`` [1/s]
    acceleration: Floats  #: ``(T, n+1)`` [1/s^2]
    jerk: Floats  #: ``(T, n+1)`` [1/s^3]


def sample_basis(degree: int, steps: int, dt: float) -> Basis:
    """The basis of a degree of at least 3, sampled after each of so many steps of ``dt`` [s]."""
    times = np.arange(1, steps + 1) / steps
    scale, derivatives = 1.0, []
    for order in range(4):
        values = scale * _polynomials(degree - order, times)
        # A polynomial's derivative is n times the difference of two of degree n - 1.
        for _ in range(order):
            values = -np.diff(values, axis=1, prepend=0, append=0)
        derivatives.append(values)
        scale *= (degree - order) / (steps * dt)
    return Basis(*derivatives)


def first_coefficients(
    degree: int, duration: float, position: Floats, velocity: Floats, acceleration: Floats
) -> Floats:
    """``(3, ...)`` the coefficients that a motion of ``duration`` [s] begins with in that state."""
    second = position + velocity * duration / degree
    third = 2 * second - position + acceleration * duration**2 / (degree * (degree - 1))
    return np.stack([position, second, third])


def _polynomials(degree: int, times: Floats) -> Floats:
    """``(T, degree+1)`` values of the Bernstein polynomials at times from 0 to 1."""
    values = np.empty((len(times), degree + 1))
    for index in range(degree + 1):
        values[:, index] = math.comb(degree, index) * _power(times, index) * _power(1 - times, degree - index)
    return values


def _power(base: Floats, exponent: int) -> Floats:
    """Return a power by multiplication, which has the same bits on every processor."""
    result = np.ones_like(base)
    for _ in range(exponent):
        result = result * base
    return result


class Method(NamedTuple):
    """Weights and limits of the alternation, with its basis."""

    position: Floats  #: ``(T, n+1)`` see :class:`Basis`
    velocity: Floats  #: ``(T, n+1)``
    acceleration: Floats  #: ``(T, n+1)``
    #: ``(4, n+1, n+1)`` sums of squares over all steps: of the constraints on positions, velocities and accelerations,
    #: and of the objective
    squares: Floats
    goal: Floats  #: ``(n+1,)`` what the objective wants of the coefficients, per metre of goal
    barrier: float  #: Share ``gamma`` of its distance beyond the safety distance that a robot may use up in a step
    lookout: float  #: Bodies are avoided that come within the safety distance and this [m]
    penalty: float  #: First weight ``rho`` of the constraints
    growth: float  #: Factor by which it grows from one alternation to the next
    alternations: int  #: At most
    tolerance: float  #: Largest violation, and change of a position, at which it ends, in SI units


class Guess(NamedTuple):
    """Samples of a motion at steps 1 to T, each ``(T, d)``: positions [m], velocities [m/s], accelerations [m/s^2]."""

    position: Floats
    velocity: Floats
    acceleration: Floats


class Targets(NamedTuple):
    """Sums over all constraints that directions and lengths make of a :class:`Guess`, each ``(T, d)``."""

    position: Floats
    velocity: Floats
    acceleration: Floats


@compiled
def raise_multiplier(squares: Floats, motion: Floats, right: Floats, penalty: float, multiplier: Floats) -> None:
    """Add to the multiplier ``(n+1, d)`` what the constraints are violated by."""
    size, d = motion.shape
    for i in range(size):
        for axis in range(d):
            now = 0.0
            for j in range(size):
                now += squares[i, j] * motion[j, axis]
            multiplier[i, axis] -= penalty * (now - right[i, axis])


@compiled
def accumulate(method: Method, targets: Targets, bends: float, right: Floats) -> None:
    """Add up the targets' share of the coefficients: ``F^T`` of them, into ``right`` ``(n+1, d)``."""
    (steps, size), d = method.position.shape, right.shape[1]
    for i in range(size):
        for axis in range(d):
            total = 0.0
            for step in range(steps):
                total += method.position[step, i] * targets.position[step, axis]
                total += method.velocity[step, i] * targets.velocity[step, axis]
                total += bends * method.acceleration[step, i] * targets.acceleration[step, axis]
            right[i, axis] = total


@compiled
def solve(matrix: Floats, right: Floats, fixed: int, motion: Floats) -> None:
    """The free coefficients of a positive definite system, by Cholesky's method; overwrites its arguments."""
    size, d = motion.shape
    for i in range(fixed, size):
        for axis in range(d):
            for j in range(fixed):
                right[i, axis] -= matrix[i, j] * motion[j, axis]
        for j in range(fixed, i + 1):
            for k in range(fixed, j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(matrix[i, i]) if i == j else matrix[i, j] / matrix[j, j]
    for axis in range(d):
        for i in range(fixed, size):
            for k in range(fixed, i):
                right[i, axis] -= matrix[i, k] * right[k, axis]
            right[i, axis] /= matrix[i, i]
        for i in range(size - 1, fixed - 1, -1):
            for k in range(i + 1, size):
                right[i, axis] -= matrix[k, i] * right[k, axis]
            right[i, axis] /= matrix[i, i]
            motion[i, axis] = right[i, axis]


@compiled
def sample(method: Method, motion: Floats, guess: Guess) -> float:
    """Make the guess the samples of a motion; return the largest change of a position along an axis [m]."""
    (steps, size), d, change = method.position.shape, motion.shape[1], 0.0
    for step in range(steps):
        for axis in range(d):
            position = velocity = acceleration = 0.0
            for i in range(size):
                position += method.position[step, i] * motion[i, axis]
                velocity += method.velocity[step, i] * motion[i, axis]
                acceleration += method.acceleration[step, i] * motion[i, axis]
            change = max(change, abs(position - guess.position[step, axis]))
            guess.position[step, axis] = position
            guess.velocity[step, axis] = velocity
            guess.acceleration[step, axis] = acceleration
    return change
