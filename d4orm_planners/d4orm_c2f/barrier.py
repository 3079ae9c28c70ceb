"""A safety filter: the last resort where following the fine plan would end in contact."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS
from d4orm_env.envs.joint_state import JointState

NEAR, STOPS = 10 / 3, 2.0  #: Range of the barriers, in radii of the largest robot plus stops from full speed
PARTING = 2.0  #: Rate at which robots separate where they are too near, per missing distance [1/s]
SWEEPS = 400  #: Most sweeps over all barriers; after so many there hardly are velocities that keep to all
EXACT = 1e-6  #: Largest change that counts as none, as a share of the largest speed limit
_STEP = 1 / 150  #: Step for the direction away from an obstacle, in radii of the largest robot


def safe_velocities(
    problem: Problem, joint: JointState, wanted: FloatArray, free: BoolArray, gap: float, speed_slack: float = 0.0
) -> FloatArray:
    """Velocities near those wanted, at which all can still brake before a collision.

    Two robots may close in on each other no faster than both together can brake within what is left between them,
    ``n (v_i - v_j) >= -sqrt(2 (a_i + a_j) (d - gap))``: the braking-distance barrier of Wang, Ames and Egerstedt
    (Safety barrier certificates for collisions-free multirobot systems, IEEE Trans. Robotics 33, 2017), here for the
    velocities of the next step. On a dynamic obstacle, a side of the bounds, or the nearest obstacle, the robot
    does all the braking. Robots of first order can stop within a time step. Taken are the nearest velocities to those
    wanted.

    Args:
        problem: The robots and obstacles.
        joint: State of everything.
        wanted: ``(K, d)`` [m/s].
        free: ``(K,)`` robots that can be told other velocities; the others are at rest.
        gap: Distance to leave between surfaces [m].
        speed_slack: Robots may come to be so much faster towards anything than they are told [m/s]. If any, they are
            also taken to go on for a time step before they brake.

    Returns:
        ``(K, d)`` [m/s]; zero for robots for which there are none.
    """
    barriers = _barriers(problem, joint, free, gap, speed_slack)
    velocities = np.where(free[:, None], wanted, 0).astype(np.float64)
    if not (barriers.missing(velocities) > 0).any():
        return velocities.astype(np.float32)
    speed = problem.team.limits[:, SPEED, None].astype(np.float64)
    if not find_nearest(*barriers, velocities, EXACT * float(speed.max())):
        return np.zeros_like(wanted)
    pace = np.linalg.norm(velocities, axis=1, keepdims=True)
    return (velocities * (speed / np.maximum(pace, speed))).astype(np.float32)


def prepare_barriers() -> None:
    """Compile what velocities are found by, if it is not yet."""
    none = np.zeros(0, np.int64)
    find_nearest(none, none, np.zeros((0, 2)), np.zeros(0), np.zeros((1, 2)), EXACT)


class Barriers(NamedTuple):
    """``normals @ (v_one - v_other) >= least`` for velocities; -1 is no robot, and at rest."""

    one: IntArray  #: ``(R,)`` robots
    other: IntArray  #: ``(R,)`` robots
    normals: Floats  #: ``(R, d)`` unit vectors
    least: Floats  #: ``(R,)`` [m/s]

    def missing(self, velocities: Floats) -> Floats:
        """``(R,)`` violations of the barriers by velocities ``(K, d)``, negative for none [m/s]."""
        padded = np.vstack([velocities, np.zeros((1, velocities.shape[1]))])
        return self.least - (self.normals * (padded[self.one] - padded[self.other])).sum(axis=1)


def _steepest(normal: Floats, room: float, flat: Floats) -> tuple[Floats, float]:
    """Unit vector along the steepest way out of an ellipsoid, a ball where ``flat``, and the room along it [m]."""
    if flat[-1] == 1:
        return normal, room
    way = normal * flat * flat
    length = float(np.linalg.norm(way))
    return way / length, room / length


def _least(room: float, brakes: float, speed_slack: float, reaction: float) -> float:
    """The least speed away from each other of two that have so much room [m/s]."""
    if room <= 0:
        return -PARTING * room
    lost = brakes * reaction
    # As long as there is room no robot has to back off: zero velocities keep to all barriers.
    return min(speed_slack + lost - float(np.sqrt(2 * brakes * room + lost**2)), 0.0)


def _barriers(problem: Problem, joint: JointState, free: BoolArray, gap: float, speed_slack: float) -> Barriers:
    d = problem.dimension
    positions = joint.states[:, :d].astype(np.float64)
    radius, wall_radius = (np.asarray(of, np.float64) for of in (problem.team.girth, problem.team.wall_radius))
    flat = np.where(np.arange(d) == 2, problem.team.flattening(max(gap, 0.0)), 1.0)
    acceleration, speed = (problem.team.limits[:, limit].astype(np.float64) for limit in (ACCELERATION, SPEED))
    at_once = np.array([model.first_order for model in problem.team.robot_models])
    braking = np.where(free, np.where(at_once, speed / problem.dt, acceleration), 0)
    rows: list[tuple[int, int, Floats, float]] = []

    def add(one: int, other: int, normal: Floats, room: float, brakes: float, speed: float = 0.0) -> None:
        rows.append((one, other, normal, _least(room, brakes, speed_slack, reaction) + speed))

    reaction = problem.dt if speed_slack else 0.0
    near = NEAR * problem.team.largest_radius + STOPS * float((speed**2 / (2 * acceleration)).max())
    offsets = positions[:, None] - positions
    separation = np.linalg.norm(offsets * flat, axis=2)
    for i, j in np.argwhere(np.triu((separation > 0) & (separation < near) & (free[:, None] | free))).tolist():
        normal, room = offsets[i, j] / separation[i, j], float(separation[i, j]) - radius[i] - radius[j] - gap
        normal, room = _steepest(normal, room, flat)
        add(i if free[i] else -1, j if free[j] else -1, normal, room, braking[i] + braking[j])
    able = np.flatnonzero(free).tolist()
    for body in joint.bodies[joint.bodies[:, -1] > 0] if len(joint.bodies) else ():
        for i in able:
            offset = positions[i] - body[:d]
            away = float(np.linalg.norm(offset))
            if 0 < away < near:
                normal = offset / away
                leaving = float((normal * body[d : 2 * d]).sum())
                add(i, -1, normal, away - wall_radius[i] - float(body[-1]) - gap, braking[i], leaving)
    for i, normal, room in _walls(problem, positions[able], able, near):
        add(i, -1, normal, room - wall_radius[i] - gap, braking[i])
    one, other, normals, least = zip(*rows) if rows else ((), (), (), ())
    return Barriers(
        np.array(one, np.int64), np.array(other, np.int64), np.array(normals).reshape(-1, d), np.array(least, float)
    )


@cached_kernel(variant="nearest", **OPTIONS)
def find_nearest(one: Any, other: Any, normals: Any, least: Any, velocities: Any, exact: float) -> Any:
    """Move ``velocities`` ``(K, d)`` to the nearest that keep to all barriers; whether any were found.

    Changes below ``exact`` [m/s] are none.

    Every barrier in turn is met exactly, by as little as is needed in view of what it has been given so far (Hildreth,
    A quadratic programming procedure, Naval Research Logistics Quarterly 4, 1957), until none changes anything.
    """
    given = np.zeros(len(least))
    for _ in range(SWEEPS):
        largest = 0.0
        for row in range(len(least)):
            i, j = one[row], other[row]
            lacking = least[row]
            for axis in range(normals.shape[1]):
                if i >= 0:
                    lacking -= normals[row, axis] * velocities[i, axis]
                if j >= 0:
                    lacking += normals[row, axis] * velocities[j, axis]
            movable = (1 if i >= 0 else 0) + (1 if j >= 0 else 0)
            change = max(lacking / movable, -given[row])
            given[row] += change
            largest = max(largest, abs(change))
            for axis in range(normals.shape[1]):
                if i >= 0:
                    velocities[i, axis] += change * normals[row, axis]
                if j >= 0:
                    velocities[j, axis] -= change * normals[row, axis]
        if largest < exact:
            return True
    return False


def _walls(problem: Problem, positions: Floats, robots: list[int], near: float) -> Iterator[tuple[int, Floats, float]]:
    """Yield what is near robots at ``positions`` ``(R, d)``: which robot, the direction away from it, the distance."""
    d, (lower, upper), shapes = problem.dimension, problem.world.bounds.astype(np.float64), problem.world.shapes
    axes = np.eye(d)
    inward, sides = np.concatenate([axes, -axes]), np.concatenate([positions - lower, upper - positions], axis=1)
    for row, side in np.argwhere(sides < near).tolist():
        yield robots[row], inward[side], float(sides[row, side])
    rows, items = shapes.within(positions, near)
    away = shapes.signed_distance(positions[rows], items)
    kept = away < near
    rows, items, away, at = rows[kept], items[kept], away[kept], positions[rows[kept]]
    steps = _STEP * problem.team.largest_radius * axes
    slopes = np.stack([shapes.signed_distance(at + s, items) - shapes.signed_distance(at - s, items) for s in steps], 1)
    lengths = np.linalg.norm(slopes, axis=1)
    for n in np.flatnonzero(lengths).tolist():
        yield robots[rows[n]], slopes[n] / lengths[n], float(away[n])
