"""A safety filter: the last resort where following the fine plan would end in contact."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.robot_model import ACCELERATION, SPEED
from d4orm_env.joint_state import JointState

NEAR = 1.5
"""Only what is this near is minded [m]."""

PARTING = 2.0
"""With what is nearer than it should be, robots part at so much of what is missing per second [1/s]."""

_STEP = 1e-3
"""For the direction away from an obstacle [m]."""

Array = NDArray[np.float64]


def safe_velocities(problem: Problem, joint: JointState, wanted: FloatArray, free: BoolArray, gap: float) -> FloatArray:
    """Velocities near those wanted, at which everybody can still brake before it touches anything.

    Two robots may close in on each other no faster than both together can brake within what is left between them,
    ``n (v_i - v_j) >= -sqrt(2 (a_i + a_j) (d - gap))``: the braking-distance barrier of Wang, Ames and Egerstedt
    (Safety barrier certificates for collisions-free multirobot systems, IEEE Trans. Robotics 33, 2017), here for the
    velocities of the next step. On a body that obeys nobody, a side of the bounds, or the nearest obstacle, the robot
    does all the braking. The nearest velocities to those wanted are a least-distance problem, solved by non-negative
    least squares (Lawson and Hanson, Solving Least Squares Problems, chapter 23).

    Args:
        problem: The robots and obstacles.
        joint: Where everything is.
        wanted: ``(K, d)`` [m/s].
        free: ``(K,)`` who can be told other velocities; the others stand.
        gap: What is to be left between surfaces [m].

    Returns:
        ``(K, d)`` [m/s]; zero for robots for which there are none.
    """
    rows, least = _barriers(problem, joint, free, gap)
    present = np.where(free[:, None], wanted, 0).astype(np.float64)
    missing = least - rows @ present.ravel()
    if not (missing > 0).any():
        return present.astype(np.float32)
    change = _least_change(rows, missing)
    if change is None:
        return np.zeros_like(wanted)
    speed = problem.team.limits[:, SPEED, None].astype(np.float64)
    safe = present + change.reshape(present.shape)
    pace = np.linalg.norm(safe, axis=1, keepdims=True)
    return (safe * np.minimum(1, speed / np.maximum(pace, 1e-9))).astype(np.float32)


def _least_change(rows: Array, least: Array) -> Array | None:
    """The smallest ``x`` with ``rows @ x >= least``; ``None`` if there is none."""
    # Here, because importing SciPy's optimisation takes long.
    from scipy.optimize import nnls

    system = np.vstack([rows.T, least])
    target = np.zeros(len(system))
    target[-1] = 1
    weights, residual = nnls(system, target)
    left = system @ weights - target
    if residual < 1e-9:
        return None
    change: Array = -left[:-1] / left[-1]
    return change


def _barriers(problem: Problem, joint: JointState, free: BoolArray, gap: float) -> tuple[Array, Array]:
    """``rows @ v >= least`` for the velocities ``v`` ``(K d,)`` of all robots."""
    d, count = problem.dimension, problem.num_robots
    places, radius = joint.states[:, :d].astype(np.float64), np.asarray(problem.team.radius, np.float64)
    braking = np.where(free, problem.team.limits[:, ACCELERATION].astype(np.float64), 0)
    rows: list[Array] = []
    least: list[float] = []

    def add(towards: dict[int, Array], room: float, brakes: float, speed: float = 0.0) -> None:
        row = np.zeros((count, d))
        for robot, normal in towards.items():
            row[robot] = normal if free[robot] else 0
        rows.append(row.ravel())
        least.append((-np.sqrt(2 * brakes * room) if room > 0 else -PARTING * room) + speed)

    offsets = places[:, None] - places
    apart = np.linalg.norm(offsets, axis=2)
    for i, j in np.argwhere(np.triu((apart > 0) & (apart < NEAR) & (free[:, None] | free))).tolist():
        normal, away = offsets[i, j] / apart[i, j], float(apart[i, j])
        add({i: normal, j: -normal}, away - radius[i] - radius[j] - gap, braking[i] + braking[j])
    able = np.flatnonzero(free).tolist()
    for body in joint.bodies[joint.bodies[:, -1] > 0] if len(joint.bodies) else ():
        for i in able:
            offset = places[i] - body[:d]
            away = float(np.linalg.norm(offset))
            if 0 < away < NEAR:
                normal = offset / away
                room = away - radius[i] - float(body[-1]) - gap
                add({i: normal}, room, braking[i], float(normal @ body[d : 2 * d]))
    for i, normal, room in _walls(problem, places[able], able):
        add({i: normal}, room - radius[i] - gap, braking[i])
    return np.array(rows).reshape(-1, count * d), np.array(least)


def _walls(problem: Problem, places: Array, robots: list[int]) -> Iterator[tuple[int, Array, float]]:
    """What stands near robots at ``places`` ``(R, d)``: of which one, the direction away from it, and how far it is."""
    d, (lower, upper) = problem.dimension, problem.world.bounds.astype(np.float64)
    axes, nearest = np.eye(d), problem.world.clearance(places)
    for robot, place, clearance in zip(robots, places, nearest):
        if clearance >= NEAR:
            continue
        sides = np.concatenate([place - lower, upper - place])
        for side in np.flatnonzero(sides < NEAR):
            yield robot, axes[side] if side < d else -axes[side - d], float(sides[side])
        if clearance < sides.min():
            around = problem.world.clearance(place + _STEP * np.concatenate([axes, -axes]))
            slope = around[:d] - around[d:]
            if (length := np.linalg.norm(slope)) > 0:
                yield robot, slope / length, float(clearance)
