"""Quintic splines: near numbers or through them, from a velocity to rest, and their integrals over steps."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import csc_array, diags_array, eye_array, kron
from scipy.sparse.linalg import splu

from d4orm_env.core.arrays import Floats

DEGREE = 5
NODES = 3  #: Points of Gauss and Legendre's quadrature in a step


def fit_spline(values: Floats, velocity: Floats, dt: float, smoothness: float) -> BSpline:
    """A quintic P-spline near ``values`` ``(N+1, ...)``, one every ``dt``, from a velocity to rest.

    It begins and ends at the first and the last of them without acceleration.
    """
    steps, shape = len(values) - 1, values.shape[1:]
    times, knots = _knots(steps, dt)
    count = steps + DEGREE
    coefficients = np.zeros((count, int(np.prod(shape))))
    first, rows = values[0].ravel(), values.reshape(len(values), -1)
    coefficients[0], coefficients[1] = first, first + velocity.ravel() * dt / DEGREE
    coefficients[2] = 3 * coefficients[1] - 2 * first
    coefficients[-4:] = rows[-1]
    basis = BSpline.design_matrix(times, knots, DEGREE).tocsc()
    matrix = (basis.T @ basis + smoothness * _roughness(count)).tocsc()
    free = np.arange(3, count - 4)
    fixed = np.setdiff1d(np.arange(count), free)
    target = (basis.T @ rows)[free] - matrix[free][:, fixed] @ coefficients[fixed]
    coefficients[free] = splu(matrix[free][:, free].tocsc()).solve(target)
    return BSpline(knots, coefficients.reshape(count, *shape), DEGREE)


def _knots(steps: int, dt: float) -> tuple[Floats, Floats]:
    """Times of steps ``(N+1,)``, and the knots of splines over them."""
    times = np.linspace(0, steps * dt, steps + 1)
    return times, np.concatenate([np.zeros(DEGREE), times, np.full(DEGREE, times[-1])])


def _roughness(count: int) -> csc_array:
    """``(C, C)`` form of squared third differences of so many coefficients."""
    differences = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count)).tocsc()
    return csc_array(differences.T @ differences)


def through(times: Floats, values: Floats, velocity: Floats, acceleration: Floats) -> BSpline:
    """The quintic spline through ``values`` ``(T, ...)`` at times ``(T,)``, with such derivatives at first, to rest."""
    begin, end = [(1, velocity), (2, acceleration)], [(order, np.zeros(values.shape[1:])) for order in (1, 2)]
    return make_interp_spline(times, values, k=DEGREE, bc_type=(begin, end))


def quadrature(step: float) -> tuple[Floats, Floats, Floats]:
    """Points ``(G,)`` in a step, weights ``(G,)`` of an integral over it, and ``(G, G)`` of those until each point."""
    points, weights = np.polynomial.legendre.leggauss(NODES)
    points, orders = (points + 1) * step / 2, np.arange(NODES)
    powers = points[:, None] ** orders
    return points, weights * step / 2, points[:, None] * powers / (orders + 1) @ np.linalg.inv(powers)


class Steps:
    """Quintic splines over ``N`` steps, of ``C`` coefficients for each of ``R`` robots, and integrals of them."""

    def __init__(self, steps: int, dt: float, robots: int) -> None:
        self.steps, self.dt, self.size, each = steps, dt, steps + DEGREE, eye_array(robots)
        self.times, self.knots = _knots(steps, dt)
        points, weights, until = quadrature(dt)
        times = (self.times[:-1, None] + points).ravel()
        change = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(steps, steps + 1))
        #: ``(R N G, R C)`` values and derivatives at the quadrature's points
        self.value, self.slope = (csc_array(kron(each, part)) for part in (self._values(times), self._slopes(times)))
        #: ``(R (N+1), R C)`` values at all steps, and ``(R C, R C)`` the form of squared third differences
        self.at_steps = csc_array(kron(each, self._values(self.times)))
        self.roughness = csc_array(kron(each, _roughness(self.size)))
        #: ``(R N, R N G)`` integrals over each step, and ``(R N G, R N G)`` from its beginning until each point
        self.over = csc_array(kron(eye_array(robots * steps), weights[None]))
        self.until = csc_array(kron(eye_array(robots * steps), until))
        #: ``(R N G, R (N+1))`` what there is at the beginning of its step, and ``(R N, R (N+1))`` changes within each
        self.begin = csc_array(kron(each, kron(eye_array(steps, steps + 1), np.ones((NODES, 1)))))
        self.change = csc_array(kron(each, change))

    def _values(self, times: Floats) -> csc_array:
        return csc_array(BSpline.design_matrix(times, self.knots, DEGREE))

    def _slopes(self, times: Floats) -> csc_array:
        width = self.knots[DEGREE + 1 : DEGREE + self.size] - self.knots[1 : self.size]
        differences = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(self.size - 1, self.size))
        lower = BSpline.design_matrix(times, self.knots[1:-1], DEGREE - 1)
        return csc_array(lower @ diags_array(DEGREE / width) @ differences)
