"""Driving to the goal as if alone: straight, or by curves to a goal heading where a robot turns only as it drives."""

from __future__ import annotations

from functools import partial

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.free_curves import free_curves
from d4orm_planners.tracking.pose_curves import first_stretches
from d4orm_planners.tracking.steering import (
    CREEPING,
    by_model,
    must_brake,
    preferred_velocities,
    rates,
    track_velocities,
)

TURNING, REVERSING = 1.5, 2.4
"""Angles from the heading to a velocity for which wheels turn as far as they go, forwards and in reverse [rad]."""
STEERING_FIRST = 10.0
"""By how much slower a robot drives while its wheels turn: shares of its pace by curvatures, of the smallest circle."""
UNNOTICED = 0.08
"""Share of what may be missed at a goal up to which a stretch on the way there is left out."""


def drive_to_goal(problem: Problem, states: FloatArray, goals: FloatArray) -> FloatArray:
    """``(K, m)`` controls inside each robot's limits, from states ``(K, n)`` to goals ``(K, d)`` [m]."""
    return track_velocities(problem, states, velocities_to_goals(problem, states, goals)[0])


def brake_to_dock(problem: Problem, robots: list[int], controls: FloatArray, joint: JointState) -> FloatArray:
    """``(N, m)`` the controls of some robots, replaced by those of go-to-goal for robots that must brake now."""
    braking = must_brake(problem, joint.states, joint.controls, joint.goals)[robots, None]
    return np.where(braking, drive_to_goal(problem, joint.states, joint.goals)[robots], controls)


def velocities_to_goals(problem: Problem, states: FloatArray, goals: FloatArray) -> tuple[FloatArray, BoolArray]:
    """``(K, d)`` velocities [m/s] to goals ``(K, d)`` [m], as :func:`preferred_velocities`; along the shortest free
    curves, from arc to arc, to goal headings of robots that turn only as they drive. And ``(K,)`` whose curves are free
    of the obstacles that there are.

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
    walls = problem.world.num_obstacles or problem.world.lower is not None
    choose = partial(free_curves, problem, robots, np.column_stack([states[robots, :2], headings])) if walls else None
    side, length, free[robots] = first_stretches(ahead, left, turns, UNNOTICED * missed, wheels, choose)
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
