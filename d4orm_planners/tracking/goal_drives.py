"""Driving to the goal as if alone: straight, or by curves to a goal heading where a robot turns only as it drives.

Curves are those of J. A. Reeds and L. A. Shepp, "Optimal paths for a car that goes both forwards and backwards",
Pacific Journal of Mathematics, 1990: arcs of the smallest circle and a straight between them. Models back up on such
arcs only, so that straights are driven forwards. Lengths are in turning radii, so that an arc's is its angle; backwards
they are negative.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.free_curves import free_curves
from d4orm_planners.tracking.steering import (
    CREEPING,
    by_model,
    must_brake,
    preferred_velocities,
    rates,
    track_velocities,
)

LEFT, STRAIGHT, RIGHT = 1.0, 0.0, -1.0
QUARTER = np.pi / 2
Word: TypeAlias = tuple[tuple[float, ...], BoolArray, tuple[Floats | float, ...]]
"""Sides of a curve's stretches, where it exists, and their lengths."""
CUSP, WHEELS = 0.5, 0.1
"""Lengths that a change of gear and turning wheels from straight ahead as far as they go count for: of two curves as
long as each other a robot keeps to one."""


class FirstStretch(NamedTuple):
    """The first arc or straight of a curve each."""

    side: Floats  #: ``(K,)`` :data:`LEFT`, :data:`STRAIGHT` or :data:`RIGHT`
    length: Floats  #: ``(K,)`` negative backwards; zero if there is nothing to drive
    free: BoolArray  #: ``(K,)`` whether it was chosen


def first_stretches(
    ahead: Floats, left: Floats, turns: Floats, short: Floats, wheels: Floats,
    choose: Callable[[Floats, Floats], IntArray] | None = None, runs: Floats | None = None,
) -> FirstStretch:  # fmt: skip
    """First stretches of the shortest curves.

    Args:
        ahead: ``(K,)`` from the robots to their goals.
        left: ``(K,)`` likewise, to the left.
        turns: ``(K,)`` from the robots' headings to their goals' [rad].
        short: ``(K,)`` length up to which a stretch is left out.
        wheels: ``(K,)`` present curvatures; NaN for robots that take any at once.
        choose: ``(K,)`` which is taken of the sides and lengths ``(W, K, 5)`` of all curves, the shortest first; -1
            for none, and so for the shortest.
        runs: ``(V, K)`` lengths of straights at their ends; none by default.
    """
    sides, lengths = curves(ahead, left, turns, short) if runs is None else _run_in(ahead, left, turns, short, runs)
    gears = np.where(np.abs(lengths) > short[:, None], np.sign(lengths), 0.0)
    costs, first = np.abs(lengths).sum(axis=-1), (gears != 0).argmax(axis=-1)
    gear, side, inert = np.zeros_like(costs), np.broadcast_to(wheels, costs.shape), ~np.isnan(wheels)
    for own_gear, own_side in zip(np.moveaxis(gears, -1, 0), np.moveaxis(sides, -1, 0), strict=True):
        driven = own_gear != 0
        costs += CUSP * (own_gear * gear < 0) + np.where(driven & inert, WHEELS * np.abs(own_side - side), 0)
        gear, side = np.where(driven, own_gear, gear), np.where(driven, own_side, side)
    best, every, found = costs.argmin(axis=0), np.arange(len(turns)), np.full(len(turns), -1)
    if choose is not None:
        order = costs.argsort(axis=0, kind="stable")
        found = choose(sides[order, every], lengths[order, every])
        best = order[np.maximum(found, 0), every]
    chosen = best, every, first[best, every]
    return FirstStretch(sides[chosen], np.where(gears[chosen] != 0, lengths[chosen], 0.0), found >= 0)


def curves(ahead: Floats, left: Floats, turns: Floats, short: Floats) -> tuple[Floats, Floats]:
    """Sides and lengths ``(W, K, 5)`` of the stretches of all curves, infinite for one that does not lead there."""
    # As they are, seen in a mirror, driven in the other gear, and from the goal to the robot.
    gear, mirror = np.array([1.0, 1.0, -1.0, -1.0])[:, None], np.array([1.0, -1.0, 1.0, -1.0])[:, None]
    x, y, turn = gear * ahead, mirror * left, gear * mirror * turns
    sine, cosine = portable.sin(turn), portable.cos(turn)
    forth, back = (
        _words(x, y, turn, sine, cosine, short),
        _words(x * cosine + y * sine, x * sine - y * cosine, turn, sine, cosine, short),
    )
    sides, lengths = [], []
    for words, order in ((forth, slice(None)), (back, slice(None, None, -1))):
        for pattern, exists, stretches in words:
            row = np.stack(np.broadcast_arrays(*stretches), axis=-1) * gear[..., None]
            side = np.array(pattern) * mirror[..., None] + np.zeros_like(row)
            exists = exists & ~((side == STRAIGHT) & (row < -short[:, None])).any(axis=-1)
            sides.append(side[..., order])
            lengths.append(np.where(exists[..., None], row, np.inf)[..., order])
    return np.concatenate(sides), np.concatenate(lengths)


def _run_in(ahead: Floats, left: Floats, turns: Floats, short: Floats, runs: Floats) -> tuple[Floats, Floats]:
    """The same, ``(V W, K, 6)``, of curves that end by straights forwards."""
    sine, cosine = portable.sin(turns), portable.cos(turns)
    begins = (ahead - runs * cosine).ravel(), (left - runs * sine).ravel()
    found = curves(*begins, np.tile(turns, len(runs)), np.tile(short, len(runs)))  # all at once
    sides, lengths = (
        part.reshape(-1, *runs.shape, part.shape[-1]).swapaxes(0, 1).reshape(-1, len(ahead), part.shape[-1])
        for part in found
    )
    last = np.repeat(runs, len(lengths) // len(runs), axis=0)[..., None]
    return np.concatenate([sides, 0 * last], axis=-1), np.concatenate([lengths, last], axis=-1)


def _words(x: Floats, y: Floats, turn: Floats, sine: Floats, cosine: Floats, short: Floats) -> list[Word]:
    """The paper's curves that begin forwards to the left, equations 8.1 to 8.11; those of four arcs are left out.

    The same with arcs backwards lead there too: a robot that has driven past the end of one has not lost its curve.
    """
    same, other = (x - sine, y - 1 + cosine), (x + sine, y - 1 - cosine)
    (near, bearing), (far, angle) = _polar(*same), _polar(*other)
    last = _within(turn - bearing)
    words: list[Word] = [((LEFT, STRAIGHT, LEFT, 0, 0), near >= 0, (bearing, near, last, 0, 0))]
    straight = np.sqrt(np.maximum(far * far - 4, 0))
    first = _within(angle + portable.arctan2(np.full_like(far, 2.0), straight))
    last = _within(first - turn)
    apart = far >= 2
    words.append(((LEFT, STRAIGHT, RIGHT, 0, 0), apart, (first, straight, last, 0, 0)))
    # Two cusps, the straight between quarter circles.
    straight = 4 - straight
    first = _within(
        portable.arctan2((4 - straight) * other[0] - 2 * other[1], -2 * other[0] + (straight - 4) * other[1])
    )
    last = _within(first - turn)
    exists = apart & (straight <= short)
    words.append(((LEFT, RIGHT, STRAIGHT, LEFT, RIGHT), exists, (first, -QUARTER, straight, -QUARTER, last)))
    half = np.minimum(near / 4, 1)
    middle = -2 * portable.arctan2(half, np.sqrt(1 - half * half))
    first = _within(bearing + middle / 2 + np.pi)
    last = _within(turn - first + middle)
    words.append(((LEFT, RIGHT, LEFT, 0, 0), near <= 4, (first, middle, last, 0, 0)))
    reach = np.sqrt(np.maximum(near * near - 4, 0))
    first = _within(bearing + portable.arctan2(reach, np.full_like(reach, -2.0)))
    last = _within(turn - QUARTER - first)
    exists = (near >= 2) & (reach >= 2 - short)
    words.append(((LEFT, RIGHT, STRAIGHT, LEFT, 0), exists, (first, -QUARTER, 2 - reach, last, 0)))
    first = _polar(-other[1], other[0])[1]
    last = _within(first + QUARTER - turn)
    exists = apart
    words.append(((LEFT, RIGHT, STRAIGHT, RIGHT, 0), exists, (first, -QUARTER, 2 - far, last, 0)))
    return words


def _polar(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Length and angle of vectors."""
    return np.sqrt(x * x + y * y), portable.arctan2(y, x)


def _within(angle: Floats) -> Floats:
    """Angles from -pi to pi, without whole turns."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))


TURNING, REVERSING = 1.5, 2.4  #: Angles from heading to velocity at which wheels turn fully, forwards and back [rad]
STEERING_FIRST = 10.0
"""By how much slower a robot drives while its wheels turn: shares of its pace by curvatures, of the smallest circle."""
RUNS = 0.0, 1.0, 2.0, 3.0, 5.0
"""Lengths of straights at the ends of curves, on which trailers come into line: sums of their hitches' lengths."""
UNNOTICED = 0.08  #: Share of what may be missed at a goal up to which a stretch on the way there is left out


def drive_to_goal(problem: Problem, states: FloatArray, goals: FloatArray) -> FloatArray:
    """``(K, m)`` controls inside each robot's limits, from states ``(K, n)`` to goals ``(K, d)`` [m]."""
    return track_velocities(problem, states, velocities_to_goals(problem, states, goals)[0])


def brake_to_dock(problem: Problem, robots: list[int], controls: FloatArray, joint: JointState) -> FloatArray:
    """``(N, m)`` the controls of some robots, replaced by those of go-to-goal for robots that must brake now."""
    braking = must_brake(problem, joint.states, joint.controls, joint.goals)[robots, None]
    return np.where(braking, drive_to_goal(problem, joint.states, joint.goals)[robots], controls)


def velocities_to_goals(problem: Problem, states: FloatArray, goals: FloatArray) -> tuple[FloatArray, BoolArray]:
    """``(K, d)`` velocities [m/s] to goals ``(K, d)`` [m], as :func:`preferred_velocities`; along the shortest free
    curves, from arc to arc, to goal headings, and hitch angles, of robots that turn only as they drive. And ``(K,)``
    whose curves are free of the obstacles that there are.

    Nothing is remembered: where a robot does not follow a curve, it goes on by the one from where it is.
    """
    circle, robots = problem.team.turning_radius, np.flatnonzero(curving(problem))
    free = np.zeros(problem.num_robots, bool)
    if not len(robots):
        return preferred_velocities(problem, states, goals), free
    radius, headings = (part[robots].astype(np.float64) for part in (circle, problem.team.headings(states)))
    ahead, left = _turned((goals - states[:, :2])[robots].astype(np.float64), -headings).T / radius
    wheels, turns = _curvatures(problem, states)[robots] * radius, problem.goal_heading[robots] - headings
    missed = np.minimum(problem.goal_heading_tolerance[robots], problem.goal_radius / radius)
    walls, trains = problem.world.num_obstacles or problem.world.lower is not None, _trains(problem)[robots]
    runs = np.outer(RUNS, trains / radius) if trains.any() else None
    looks = bool(walls) or runs is not None
    choose = partial(free_curves, problem, robots, _poses(problem, states)[robots]) if looks else None
    side, length, free[robots] = first_stretches(ahead, left, turns, UNNOTICED * missed, wheels, choose, runs)
    aims, turn = goals.copy(), side * np.where(length < 0, -REVERSING, TURNING)
    away = np.stack([np.abs(length) * radius, np.zeros_like(radius)], axis=1)
    aims[robots] = states[robots, :2] + _turned(away, headings + turn)
    velocities = preferred_velocities(problem, states, aims)
    off = np.nan_to_num(np.abs(side - wheels))
    velocities[robots] *= np.maximum(1 - STEERING_FIRST * off, CREEPING)[:, None]
    return velocities, free


def curving(problem: Problem) -> BoolArray:
    """``(K,)`` robots with a goal heading that turn only as they drive."""
    circle = problem.team.turning_radius
    return ~np.isnan(problem.goal_heading) & (circle > 0) & np.isfinite(circle)


def curving_room(problem: Problem, circles: float) -> Floats:
    """``(K,)`` so many turning radii and the longest straight on which trailers come into line [m]."""
    return circles * problem.team.turning_radius + RUNS[-1] * _trains(problem)


def _trains(problem: Problem) -> Floats:
    """``(K,)`` lengths of all hitches of robots with goal hitch angles [m]; zero for others."""
    models = zip(problem.team.robot_models, problem.team.limits, strict=True)
    lengths = np.array([sum(float(limits[column]) for _, column in model.trailers) for model, limits in models])
    return np.where(np.isnan(problem.goal_hitches).all(axis=1), 0.0, lengths)


def _poses(problem: Problem, states: FloatArray) -> Floats:
    """``(K, 3 + T)`` positions, headings and hitch angles."""
    poses = np.zeros((problem.num_robots, 3 + MOST_TRAILERS))
    poses[:, :2], poses[:, 2] = states[:, :2], problem.team.headings(states)
    for model, robots in by_model(problem):
        for number, (hitch, _) in enumerate(model.trailers, 3):
            poses[robots, number] = states[robots, hitch]
    return poses


def _turned(vectors: Floats, angles: Floats) -> Floats:
    """``(R, 2)`` vectors turned by angles ``(R,)``."""
    cosine, sine, (x, y) = portable.cos(angles), portable.sin(angles), vectors.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def _curvatures(problem: Problem, states: FloatArray) -> Floats:
    """``(K,)`` curvatures that robots drive by their states [1/m]; NaN for models that take any at once."""
    moving, curvatures = states.copy(), np.full(problem.num_robots, np.nan)
    for model, robots in by_model(problem):
        moving[np.ix_(robots, model.speed_indices)] = 1
    turning = rates(problem, moving, np.zeros((problem.num_robots, problem.control_size), np.float32))
    for model, robots in by_model(problem):
        if model.heading_index is not None and not model.first_order:
            curvatures[robots] = turning[robots, model.heading_index]
    return curvatures
