"""Tracking a velocity, and driving straight to the goal as if nobody else were there: one law for every model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.dynamics import MODELS, TURN_RATE, Model
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.transition import TimeStep, advance, arrives

VIA_RADIUS = 0.5
"""How near to a point on its way a robot turns to its goal [m]."""


def drive_to_goal(problem: Problem, states: FloatArray, goals: FloatArray) -> FloatArray:
    """``(K, m)`` controls inside each robot's limits.

    Args:
        problem: Whose robots they are.
        states: ``(K, n)``.
        goals: ``(K, d)`` [m].
    """
    return track_velocities(problem, states, preferred_velocities(problem, states, goals))


def preferred_velocities(problem: Problem, states: FloatArray, goals: FloatArray) -> FloatArray:
    """``(K, d)`` velocities straight to the goals, from which every robot can still stop there [m/s].

    Args:
        problem: Whose robots they are.
        states: ``(K, n)``.
        goals: ``(K, d)`` [m].
    """
    velocities = np.zeros(goals.shape, np.float32)
    for model, robots in _by_model(problem):
        velocities[robots] = approach(model, states[robots], goals[robots], problem.team.limits[robots], problem.dt)
    return velocities


def track_velocities(problem: Problem, states: FloatArray, velocities: FloatArray) -> FloatArray:
    """``(K, m)`` controls inside each robot's limits that bring the team to these velocities as soon as they allow.

    Args:
        problem: Whose robots they are.
        states: ``(K, n)``.
        velocities: ``(K, d)`` wanted [m/s].
    """
    controls = np.zeros((problem.num_robots, problem.control_size), np.float32)
    for model, robots in _by_model(problem):
        limits = problem.team.limits[robots]
        wanted = track(model, states[robots], velocities[robots], limits, problem.dt)
        allowed = model.functions.limit_control(tuple(wanted.T), tuple(limits.T), NUMPY_OPS)
        controls[robots, : model.control_size] = np.stack(allowed, axis=1)
    # The norm may come out above the limit by a rounding error.
    limit = problem.team.control_limits
    return np.clip(controls, -limit, limit)


def steer(model: Model, states: FloatArray, goals: FloatArray, limits: FloatArray, dt: float) -> FloatArray:
    """``(B, m)`` controls of ``B`` robots of one model towards their goals, braking in time to stop there.

    They may exceed the limits.

    Args:
        model: The model.
        states: ``(B, n)``.
        goals: ``(B, d)`` [m].
        limits: ``(B, 3)`` speed, acceleration and turn rate.
        dt: Time step [s].
    """
    return track(model, states, approach(model, states, goals, limits, dt), limits, dt)


def approach(model: Model, states: FloatArray, goals: FloatArray, limits: FloatArray, dt: float) -> FloatArray:
    """``(B, d)`` fastest velocities straight to the goals from which the robots can still stop there [m/s].

    Args: as :func:`steer`.
    """
    speed, acceleration, _ = limits.T
    to_goal = goals - states[:, : model.dimension]
    distance = np.sqrt((to_goal * to_goal).sum(axis=1))
    direction = to_goal / np.maximum(distance, 1e-6)[:, None]
    if model.name == "velocity2d":
        # A first-order robot stops at once, and need only not overshoot within a step.
        return direction * np.minimum(speed, distance / dt)[:, None]
    # Braking begins with the next step.
    lost = acceleration * (dt / 2)
    stopping = np.sqrt(2 * acceleration * distance + lost * lost) - lost
    return direction * np.minimum(speed, stopping)[:, None]


def track(model: Model, states: FloatArray, velocities: FloatArray, limits: FloatArray, dt: float) -> FloatArray:
    """``(B, m)`` controls that would bring ``B`` robots of one model to these velocities within a step.

    A robot with a heading turns to the wanted direction, and drives as fast as it faces that way. The controls may
    exceed the limits.

    Args:
        model: The model.
        states: ``(B, n)``.
        velocities: ``(B, d)`` wanted [m/s].
        limits: ``(B, 3)`` speed, acceleration and turn rate.
        dt: Time step [s].
    """
    if model.name == "velocity2d":
        return velocities
    if model.heading_index is None:
        return (velocities - states[:, list(model.speed_indices)]) / dt
    turn_rate, speed = limits[:, TURN_RATE], np.sqrt((velocities * velocities).sum(axis=1))
    turn = portable.arctan2(velocities[:, 1], velocities[:, 0]) - states[:, model.heading_index]
    # To stand still no heading is better than the present one.
    turn = np.where(speed > 0, (turn + np.pi) % (2 * np.pi) - np.pi, 0)
    push = (speed * np.maximum(portable.cos(turn), 0) - states[:, model.speed_indices[0]]) / dt
    return np.stack([np.clip(turn / dt, -turn_rate, turn_rate), push], axis=1)


def _by_model(problem: Problem) -> Iterator[tuple[Model, list[int]]]:
    """The models of the team, each with its robots."""
    models = problem.team.models
    for name in dict.fromkeys(models):
        yield MODELS[name], [robot for robot, model in enumerate(models) if model == name]


@dataclass(frozen=True)
class Drives:
    """Ways that robots could take, each robot alone: ``R`` robots, ``V`` ways each.

    Attributes:
        controls: ``(H, R, V, m)``, zero after arrival.
        positions: ``(H+1, R, V, d)`` [m].
        arrived: ``(R, V)`` bool.
    """

    controls: FloatArray
    positions: FloatArray
    arrived: BoolArray

    def of(self, robot: int) -> Drives:
        """The ways of one robot, without the axis of robots."""
        return Drives(self.controls[:, robot], self.positions[:, robot], self.arrived[robot])

    def joined(self, other: Drives) -> Drives:
        """These ways and others of the same robots."""
        return Drives(
            np.concatenate([self.controls, other.controls], axis=-2),
            np.concatenate([self.positions, other.positions], axis=-2),
            np.concatenate([self.arrived, other.arrived], axis=-1),
        )


def closing_stretches(problem: Problem, states: FloatArray, controls: FloatArray, switch_times: Any) -> Drives:
    """Follow the controls up to a time and drive straight to the goal from there.

    Args:
        problem: The robots.
        states: ``(H+1, R, n)`` their states under ``controls``.
        controls: ``(H, R, m)`` as executed: clipped, zero for docked robots.
        switch_times: ``(R, V)`` time steps.
    """
    switch = np.asarray(switch_times)
    vias = np.repeat(problem.goal[:, None], switch.shape[1], axis=1)
    return _drive_teams(problem, states, controls, switch, vias)


def detours(problem: Problem, vias: FloatArray) -> Drives:
    """Drive from the start straight towards a point ``(R, V, d)`` [m], and half a metre before it on to the goal."""
    return _drive_teams(problem, *_standing(problem), np.zeros(vias.shape[:2], int), vias)


def straight_drives(problem: Problem) -> Drives:
    """Drive from the start straight to the goal: a single way for every robot."""
    return closing_stretches(problem, *_standing(problem), np.zeros((problem.num_robots, 1), int))


def _standing(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """States and controls of robots that stay where they start."""
    states = np.repeat(np.asarray(problem.start)[None], problem.horizon + 1, axis=0)
    return states, np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)


def _drive_teams(problem: Problem, states: FloatArray, controls: FloatArray, switch: Any, vias: FloatArray) -> Drives:
    """Every robot on each of its ways: as controlled until ``switch`` ``(R, V)``, then by ``vias`` ``(R, V, d)``."""
    num_ways = switch.shape[1]
    u = np.repeat(np.asarray(controls, np.float32)[:, :, None], num_ways, axis=2)
    x = np.repeat(np.asarray(states, np.float32)[:, :, None], num_ways, axis=2)
    arrived = np.zeros(switch.shape, bool)
    for model, robots in _by_model(problem):
        # One lane for every robot and way.
        x_lanes, u_lanes = (array[:, robots].reshape(len(array), -1, array.shape[-1]) for array in (x, u))
        goals, limits = (
            np.repeat(np.asarray(rows)[robots], num_ways, axis=0) for rows in (problem.goal, problem.team.limits)
        )
        targets = vias[robots].reshape(-1, vias.shape[2])
        arrivals = _drive(model, problem, x_lanes, u_lanes, goals, limits, switch[robots].ravel(), targets)
        x[:, robots] = x_lanes.reshape(len(x), len(robots), num_ways, -1)
        u[:, robots] = u_lanes.reshape(len(u), len(robots), num_ways, -1)
        arrived[robots] = arrivals.reshape(len(robots), num_ways)
    return Drives(u, x[..., : problem.dimension], arrived)


def _drive(
    model: Model,
    problem: Problem,
    x: FloatArray,
    u: FloatArray,
    goals: FloatArray,
    limits: FloatArray,
    switch: Any,
    targets: FloatArray,
) -> BoolArray:
    """Fill in states ``(H+1, B, n)`` and controls ``(H, B, m)`` from the ``switch`` times on; returns who arrives."""
    n, m, d = model.state_size, model.control_size, model.dimension
    step = TimeStep(*(np.float32(problem.dt / part) for part in (1, 2, 3, 6)))
    goal_speed = np.inf if problem.goal_speed is None else problem.goal_speed

    def home(t: int) -> BoolArray:
        """Who docks, or has docked, with the step that ends at ``t``."""
        velocity = model.functions.velocity(tuple(x[t, :, :n].T), tuple(u[t - 1, :, :m].T), NUMPY_OPS)
        gap2 = ((x[t, :, :d] - goals[:, :d]) ** 2).sum(axis=1)
        speed2 = sum(np.square(part) for part in velocity)
        return arrives(gap2, speed2, problem.goal_radius * problem.goal_radius, goal_speed * goal_speed)

    first = int(switch.min())
    arrived = home(first) if first > 0 else np.zeros(len(switch), bool)
    for t in range(first, problem.horizon):
        if arrived.all():
            x[t + 1 :, :, :n] = x[t, :, :n]
            u[t:, :, :m] = 0
            break
        passed = ((x[t, :, :d] - targets[:, :d]) ** 2).sum(axis=1) < VIA_RADIUS * VIA_RADIUS
        targets = np.where(passed[:, None], goals, targets)
        steered = steer(model, x[t, :, :n], targets[:, :d], limits, problem.dt)
        wanted = np.where((t >= switch)[:, None], steered, u[t, :, :m]).astype(np.float32)
        clipped = model.functions.limit_control(tuple(wanted.T), tuple(limits.T), NUMPY_OPS)
        after = advance(model.functions, tuple(x[t, :, :n].T), clipped, tuple(limits.T), step, NUMPY_OPS)
        x[t + 1, :, :n] = np.where(arrived[:, None], x[t, :, :n], np.stack(after, axis=1))
        u[t, :, :m] = np.where(arrived[:, None], 0, np.stack(clipped, axis=1))
        arrived |= home(t + 1)
    return arrived
