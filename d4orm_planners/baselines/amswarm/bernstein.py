"""Motions as Bernstein polynomials of the time, sampled at every step of a horizon.

R. T. Farouki, *The Bernstein polynomial basis: a centennial retrospective* (Computer Aided Geometric Design, 2012).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import Floats


class Basis(NamedTuple):
    """The basis of degree ``n`` over ``T`` steps: the samples of a motion are ``place @ c``, ``c`` being ``(n+1, d)``.

    Attributes:
        place: ``(T, n+1)`` positions at steps 1 to T.
        velocity: ``(T, n+1)`` [1/s].
        acceleration: ``(T, n+1)`` [1/s^2].
        jerk: ``(T, n+1)`` [1/s^3].
    """

    place: Floats
    velocity: Floats
    acceleration: Floats
    jerk: Floats


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


def first_coefficients(degree: int, duration: float, place: Floats, velocity: Floats, acceleration: Floats) -> Floats:
    """``(3, ...)`` the coefficients that a motion of ``duration`` [s] begins with in that state."""
    second = place + velocity * duration / degree
    third = 2 * second - place + acceleration * duration**2 / (degree * (degree - 1))
    return np.stack([place, second, third])


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
