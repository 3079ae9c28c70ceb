"""One robot's motion by alternating minimisation with polar collision constraints, compiled with numba.

After V. K. Adajania, S. Zhou, A. K. Singh and A. P. Schoellig, *AMSwarm: An alternating minimization approach for safe
motion planning of quadrotor swarms in cluttered environments* (ICRA 2023). A body at ``x_j`` is kept clear of by
``p = x_j + d w``, a unit vector ``w`` (which the publication writes by its angles) and a distance ``d`` of at least the
safety distance; velocity and acceleration are a direction and a length within the limits. With directions and lengths
held, the coefficients follow from one linear system; with coefficients held, directions and lengths are closed forms.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, Floats, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled

MOST_PENALTY = 5e7  #: Largest weight of the constraints, as in the authors' code: it would overflow in the end


class Method(NamedTuple):
    """Weights and limits of the alternation, with its basis."""

    position: Floats  #: ``(T, n+1)`` samples of the basis, as the next two
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


class MotionSamples(NamedTuple):
    """Samples at steps 1 to T, each ``(T, d)``: positions [m], velocities [m/s], accelerations [m/s^2].

    They are those of a motion, or, as targets of one, sums over all constraints that directions and lengths make of it.
    """

    position: Floats
    velocity: Floats
    acceleration: Floats


class Neighbourhood(NamedTuple):
    """Surroundings that a team keeps clear of."""

    paths: Floats  #: ``(K, T, d)`` where robots are predicted to be [m]
    radius: Floats  #: ``(K,)`` of the robots [m]
    margin: float  #: Between surfaces [m]
    boxes: Floats  #: ``(B, 2 d + 1)`` obstacles, see :class:`~d4orm_env.geometry.shapes.Shapes`
    bounds: Floats  #: ``(2, d)`` of the world, infinite where open [m]


@cached_kernel(**OPTIONS)
def alternate(
    method: Method,
    bodies: Neighbourhood,
    robot: Whole,
    limits: Floats,
    goal: Floats,
    fixed: int,
    motion: Floats,
    guess: MotionSamples,
) -> float:
    """Alternate until no constraint is violated and no position changes, to the tolerance, or as often as may be.

    Args:
        method: :class:`Method`.
        bodies: :class:`Neighbourhood`.
        robot: Its number among them.
        limits: ``(2,)`` of speed and acceleration [m/s, m/s^2], infinite where there is none.
        goal: ``(d,)`` [m].
        fixed: Number of first coefficients that are given.
        motion: ``(n+1, d)`` coefficients; the given ones are read and the others written.
        guess: Samples to begin with, and the motion's in the end.

    Returns:
        The largest violation that is left, in SI units.
    """
    (steps, size), d = method.position.shape, len(goal)
    targets = MotionSamples(np.empty((steps, d)), np.empty((steps, d)), np.empty((steps, d)))
    multiplier, right, matrix = np.zeros((size, d)), np.empty((size, d)), np.empty((size, size))
    active = np.zeros(len(bodies.radius) + len(bodies.boxes), np.bool_)
    _activate(method, bodies, robot, guess, active)
    rows = np.count_nonzero(active) + 1  # the bounds always are
    bends = 1.0 if limits[1] < math.inf else 0.0
    squares = rows * method.squares[0] + method.squares[1] + bends * method.squares[2]
    violation, penalty = _project(method, bodies, robot, limits, active, motion[0], guess, targets), method.penalty
    for _ in range(method.alternations):
        _accumulate(method, targets, bends, right)
        for i in range(size):
            for j in range(size):
                matrix[i, j] = method.squares[3, i, j] + penalty * squares[i, j]
            for axis in range(d):
                right[i, axis] = method.goal[i] * goal[axis] + multiplier[i, axis] + penalty * right[i, axis]
        _solve(matrix, right, fixed, motion)
        change = _sample(method, motion, guess)
        violation = _project(method, bodies, robot, limits, active, motion[0], guess, targets)
        if max(violation, change) <= method.tolerance:
            break
        _accumulate(method, targets, bends, right)
        _raise_multiplier(squares, motion, right, penalty, multiplier)
        penalty = min(penalty * method.growth, MOST_PENALTY)
    return violation


@compiled
def _activate(method: Method, bodies: Neighbourhood, robot: Whole, guess: MotionSamples, active: BoolArray) -> None:
    """Mark the bodies near the guess, whose constraints are active."""
    for body in range(len(active)):
        if body == robot:
            continue
        for step in range(len(guess.position)):
            low, high, radius = _box(bodies, body, step)
            near = bodies.radius[robot] + radius + bodies.margin + method.lookout
            if _square_gap(guess.position[step], low, high) < near * near:
                active[body] = True
                break


@compiled
def _box(bodies: Neighbourhood, body: int, step: int) -> tuple[Floats, Floats, float]:
    """Lower and upper corner ``(d,)`` of the box that a body is at a step, a robot's a point, and radius about it."""
    d = bodies.paths.shape[2]
    if body < len(bodies.radius):
        return bodies.paths[body, step], bodies.paths[body, step], bodies.radius[body]
    box = bodies.boxes[body - len(bodies.radius)]
    return box[:d], box[d : 2 * d], box[2 * d]


@compiled
def _project(
    method: Method,
    bodies: Neighbourhood,
    robot: Whole,
    limits: Floats,
    active: BoolArray,
    here: Floats,
    guess: MotionSamples,
    targets: MotionSamples,
) -> float:
    """Sum the nearest samples that limits and the bodies ``active`` ``(K + B,)`` allow into ``targets``.

    The robot is at ``here`` ``(d,)`` now; all else is as of :func:`alternate`. Returns the largest violation.
    """
    radius = bodies.radius[robot]
    worst = _stay_within(bodies.bounds, radius, limits, guess, targets)
    for body in range(len(active)):
        if not active[body]:
            continue
        low, high, own = _box(bodies, body, 0)
        safety_distance, before = radius + own + bodies.margin, math.sqrt(_square_gap(here, low, high))
        for step in range(len(guess.position)):
            least = safety_distance + (1.0 - method.barrier) * max(before - safety_distance, 0.0)
            low, high, own = _box(bodies, body, step)
            before = _push(guess.position[step], low, high, least, targets.position[step])
            worst = max(worst, safety_distance - before)
    return worst


@compiled
def _stay_within(bounds: Floats, radius: float, limits: Floats, guess: MotionSamples, targets: MotionSamples) -> float:
    """Write the targets of the bounds and of the limits of speed and acceleration; return the largest violation."""
    (steps, d), worst = guess.position.shape, 0.0
    for step in range(steps):
        for axis in range(d):
            low, high = bounds[0, axis] + radius, bounds[1, axis] - radius
            x = guess.position[step, axis]
            targets.position[step, axis] = min(max(x, low), high)
            worst = max(worst, low - x, x - high)
        worst = max(worst, _shorten(guess.velocity[step], limits[0], targets.velocity[step]))
        worst = max(worst, _shorten(guess.acceleration[step], limits[1], targets.acceleration[step]))
    return worst


@compiled
def _square_gap(position: Floats, low: Floats, high: Floats) -> float:
    """Square of the distance of a position from a box, zero within."""
    square = 0.0
    for axis in range(len(position)):
        gap = max(low[axis] - position[axis], position[axis] - high[axis], 0.0)
        square += gap * gap
    return square


@compiled
def _push(position: Floats, low: Floats, high: Floats, least: float, target: Floats) -> float:
    """Add to ``target`` the point nearest to ``position`` that is ``least`` from a box, which may be a point.

    Returns how far ``position`` is from the box, negative within.
    """
    distance = math.sqrt(_square_gap(position, low, high))
    if distance > 0.0:
        factor = max(least / distance, 1.0)
        for axis in range(len(position)):
            nearest = min(max(position[axis], low[axis]), high[axis])
            target[axis] += nearest + factor * (position[axis] - nearest)
        return distance
    depth, out, side = math.inf, 0, 1.0
    for axis in range(len(position)):
        target[axis] += position[axis]
        if position[axis] - low[axis] < depth:
            depth, out, side = position[axis] - low[axis], axis, -1.0
        if high[axis] - position[axis] < depth:
            depth, out, side = high[axis] - position[axis], axis, 1.0
    target[out] += side * (depth + least)
    return -depth


@compiled
def _shorten(vector: Floats, most: float, target: Floats) -> float:
    """Write to ``target`` the vector no longer than ``most`` nearest to it; return by how much it is too long."""
    square = 0.0
    for axis in range(len(vector)):
        square += vector[axis] * vector[axis]
    length = math.sqrt(square)
    factor = most / length if length > most else 1.0
    for axis in range(len(vector)):
        target[axis] = factor * vector[axis]
    return length - most


@compiled
def _raise_multiplier(squares: Floats, motion: Floats, right: Floats, penalty: float, multiplier: Floats) -> None:
    """Add to the multiplier ``(n+1, d)`` what the constraints are violated by."""
    size, d = motion.shape
    for i in range(size):
        for axis in range(d):
            now = 0.0
            for j in range(size):
                now += squares[i, j] * motion[j, axis]
            multiplier[i, axis] -= penalty * (now - right[i, axis])


@compiled
def _accumulate(method: Method, targets: MotionSamples, bends: float, right: Floats) -> None:
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
def _solve(matrix: Floats, right: Floats, fixed: int, motion: Floats) -> None:
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
def _sample(method: Method, motion: Floats, guess: MotionSamples) -> float:
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
