"""Quintic splines: near numbers or through them, from a velocity to rest."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import diags_array
from scipy.sparse.linalg import splu

from d4orm_env.core.arrays import Floats

DEGREE = 5


def fit_spline(values: Floats, velocity: Floats, dt: float, smoothness: float) -> BSpline:
    """A quintic P-spline near ``values`` ``(N+1, ...)``, one every ``dt``, from a velocity to rest.

    It begins and ends at the first and the last of them without acceleration.
    """
    steps, shape = len(values) - 1, values.shape[1:]
    knots = np.concatenate([np.zeros(DEGREE), np.linspace(0, steps * dt, steps + 1), np.full(DEGREE, steps * dt)])
    count = steps + DEGREE
    coefficients = np.zeros((count, int(np.prod(shape))))
    first, rows = values[0].ravel(), values.reshape(len(values), -1)
    coefficients[0], coefficients[1] = first, first + velocity.ravel() * dt / DEGREE
    coefficients[2] = 3 * coefficients[1] - 2 * first
    coefficients[-4:] = rows[-1]
    basis = BSpline.design_matrix(np.linspace(0, steps * dt, steps + 1), knots, DEGREE).tocsc()
    differences = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count)).tocsc()
    matrix = (basis.T @ basis + smoothness * (differences.T @ differences)).tocsc()
    free = np.arange(3, count - 4)
    fixed = np.setdiff1d(np.arange(count), free)
    target = (basis.T @ rows)[free] - matrix[free][:, fixed] @ coefficients[fixed]
    coefficients[free] = splu(matrix[free][:, free].tocsc()).solve(target)
    return BSpline(knots, coefficients.reshape(count, *shape), DEGREE)


def through(times: Floats, values: Floats, velocity: Floats, acceleration: Floats) -> BSpline:
    """The quintic spline through ``values`` ``(T, ...)`` at times ``(T,)``, with such derivatives at first, to rest."""
    begin, end = [(1, velocity), (2, acceleration)], [(order, np.zeros(values.shape[1:])) for order in (1, 2)]
    return make_interp_spline(times, values, k=DEGREE, bc_type=(begin, end))
