"""A roundabout: all drive round the point where most paths cross, on the same side.

The oldest rule for many that cross at one point, as in L. Pallottino, V. G. Scordio, A. Bicchi and E. Frazzoli,
*Decentralized cooperative policy for conflict resolution in multivehicle systems* (IEEE Transactions on Robotics,
2007).
Search among single robots' paths does not find it, because none gains by beginning alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.portable import arctan2, cos, sin
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.types import Engine
from d4orm_planners.tracking.steering import track_velocities

SLACK = 1 / 75  #: Added to the distance that robots keep from each other in it, in radii of the largest robot
PARALLEL = 1e-6  #: Paths are parallel whose directions differ by less, squared [rad^2]
CORRECTION = 1.0  #: Share of its distance from where it should be that a robot makes good in a second [1/s]


class Bends(NamedTuple):
    """Paths of a line, an arc and a line."""

    centre: Floats  #: ``(K, 2)`` of the arcs [m]
    radius: Floats  #: ``(K,)`` of the arcs [m]
    first: Floats  #: ``(K,)`` length of the lines up to the arcs [m]
    angles: Floats  #: ``(K, 2)`` at which the arcs begin and how far they go round, positive to the left [rad]

    def at(self, lengths: Floats) -> tuple[Floats, Floats]:
        """``(K, 2)`` positions and unit directions so far along the paths ``(K,)``."""
        round_ = np.clip((lengths - self.first) / self.radius, 0, np.abs(self.angles[:, 1]))
        side = np.sign(self.angles[:, 1])
        angle = self.angles[:, 0] + side * round_
        spoke = np.stack([cos(angle), sin(angle)], axis=1)
        direction = side[:, None] * np.stack([-spoke[:, 1], spoke[:, 0]], axis=1)
        rest = lengths - self.first - self.radius * round_
        return self.centre + self.radius[:, None] * spoke + rest[:, None] * direction, direction


def drive_roundabout(problem: Problem, engine: Engine, side: int) -> FloatArray | None:
    """Controls ``(H, K, m)`` of a team that passes the middle to the left of it, side 1, or to the right, side -1.

    ``None`` in space, where paths do not cross, where a robot begins or ends within the roundabout, or comes within the
    margin of anything.
    """
    if problem.dimension != 2 or problem.num_robots < 2:
        return None
    bends = _bends(problem, side)
    if bends is None:
        return None
    speed, acceleration = (problem.team.limits[:, column].astype(np.float64) for column in (SPEED, ACCELERATION))
    # Who accelerates has the velocity at the end of a step, and who sets its velocity has it all the time.
    lead = np.array([1.0 if ACCELERATION in model.control_limits else 0.5 for model in problem.team.robot_models])

    def wanted(t: int, states: FloatArray) -> Floats:
        now, then = problem.dt * t, problem.dt * (t + lead)
        due, _ = bends.at(_driven(now, speed, acceleration))
        _, direction = bends.at(_driven(then, speed, acceleration))
        return direction * np.minimum(speed, acceleration * then)[:, None] + CORRECTION * (due - states[:, :2])

    states, arrived = problem.start, np.zeros(problem.num_robots, bool)
    controls = np.empty((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    for t in range(problem.horizon):
        controls[t] = track_velocities(problem, states, wanted(t, states).astype(np.float32))
        after = engine.step(problem.arrays, states, arrived, controls[t])
        if after.margin_violated.any():
            return None
        states, arrived = after.states, after.arrived & problem.docks
    return controls


def _driven(time: float | Floats, speed: Floats, acceleration: Floats) -> Floats:
    """Return the distance driven by robots that set out at time zero, as fast as they can."""
    gaining = np.minimum(time, speed / acceleration)
    driven: Floats = 0.5 * acceleration * gaining**2 + speed * (time - gaining)
    return driven


def _bends(problem: Problem, side: int) -> Bends | None:
    begin, end = problem.start[:, :2].astype(np.float64), problem.goal.astype(np.float64)
    along = end - begin
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    across = side * np.stack([-along[:, 1], along[:, 0]], axis=1)
    middle = _nearest_to_all(begin, across)
    if middle is None:
        return None
    limits, radius = problem.team.limits.astype(np.float64), np.asarray(problem.team.radius, np.float64)
    separation = 2 * radius.max() + problem.margin + SLACK * problem.team.largest_radius
    least = separation / (2 * float(sin(np.pi / problem.num_robots)))
    bend = np.maximum(limits[:, SPEED] ** 2 / limits[:, ACCELERATION], least)
    # Where robots cannot turn that sharply the arc reaches round the middle on the far side too.
    centre = middle - (bend - least)[:, None] * across
    before, behind = begin - centre, end - centre
    away = np.linalg.norm([before, behind], axis=2)
    if (away <= bend).any():
        return None
    straight = np.sqrt(away**2 - bend**2)
    spread = arctan2(straight, np.stack([bend, bend]))
    turns = arctan2(np.stack([before[:, 1], behind[:, 1]]), np.stack([before[:, 0], behind[:, 0]]))
    # To the left of the middle is clockwise round it.
    first, last = turns[0] - side * spread[0], turns[1] + side * spread[1]
    angle = -side * np.mod(-side * (last - first), 2 * np.pi)
    return Bends(centre, bend, straight[0], np.stack([first, angle], axis=1))


def _nearest_to_all(positions: Floats, normals: Floats) -> Floats | None:
    """``(2,)`` the position nearest to straight paths through ``positions`` ``(K, 2)``; ``None`` if they are parallel.

    By normal equations whose sums are exact, so that it is the same on every processor.
    """
    offset = (normals * positions).sum(axis=1)
    x, y = normals.T
    xx, xy, yy = (math.fsum((a * b).tolist()) for a, b in ((x, x), (x, y), (y, y)))
    right, up = (math.fsum((a * offset).tolist()) for a in (x, y))
    determinant = xx * yy - xy * xy
    if determinant < PARALLEL * len(positions) ** 2:
        return None
    return np.array([yy * right - xy * up, xx * up - xy * right]) / determinant
