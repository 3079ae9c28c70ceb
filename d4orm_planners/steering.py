"""Tracking a velocity, and driving straight to the goal as if nobody else were there: one law for every model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.dynamics import MODELS
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.robot_model import Model
from d4orm_env.core.transition import TimeStep

NEAR_VIA = np.float32(0.25)
"""Square of how near to a point on its way a robot turns to its goal [m^2]."""


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
    h = TimeStep(*problem.arrays.time_step)
    for model, robots in _by_model(problem):
        x, goal, limits = (tuple(rows[robots].T) for rows in (states, goals, problem.team.limits))
        velocities[robots] = np.stack(model.functions.approach(x, goal, limits, h, NUMPY_OPS), axis=1)
    return velocities


def track_velocities(problem: Problem, states: FloatArray, velocities: FloatArray) -> FloatArray:
    """``(K, m)`` controls inside each robot's limits that bring the team to these velocities as soon as they allow.

    Args:
        problem: Whose robots they are.
        states: ``(K, n)``.
        velocities: ``(K, d)`` wanted [m/s].
    """
    controls = np.zeros((problem.num_robots, problem.control_size), np.float32)
    h = TimeStep(*problem.arrays.time_step)
    for model, robots in _by_model(problem):
        x, velocity, limits = (tuple(rows[robots].T) for rows in (states, velocities, problem.team.limits))
        wanted = model.functions.track(x, velocity, limits, h, NUMPY_OPS)
        allowed = model.functions.limit_control(wanted, limits, NUMPY_OPS)
        controls[robots, : model.control_size] = np.stack(allowed, axis=1)
    # The norm may come out above the limit by a rounding error.
    limit = problem.team.control_limits
    return np.clip(controls, -limit, limit)


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


def closing_stretches(problem: Problem, states: FloatArray, controls: FloatArray, switch_times: ArrayLike) -> Drives:
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


def prepare_drives(problem: Problem) -> None:
    """Compile what drives of this team need, if it is not yet."""
    from d4orm_env.engine.drives import drive_kernel

    if not all(drive_kernel(name).signatures for name in set(problem.team.models)):
        straight_drives(problem)


def straight_drives(problem: Problem) -> Drives:
    """Drive from the start straight to the goal: a single way for every robot."""
    return closing_stretches(problem, *_standing(problem), np.zeros((problem.num_robots, 1), int))


def _standing(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """States and controls of robots that stay where they start."""
    states = np.repeat(np.asarray(problem.start)[None], problem.horizon + 1, axis=0)
    return states, np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)


def _drive_teams(
    problem: Problem, states: FloatArray, controls: FloatArray, switch: IntArray, vias: FloatArray
) -> Drives:
    """Every robot on each of its ways: as controlled until ``switch`` ``(R, V)``, then by ``vias`` ``(R, V, d)``."""
    # Here, because importing numba takes long.
    from d4orm_env.engine.drives import DrivenWays, DriveRules, drive_kernel

    num_ways, arrays = switch.shape[1], problem.arrays
    u = np.repeat(np.asarray(controls, np.float32)[:, :, None], num_ways, axis=2)
    x = np.repeat(np.asarray(states, np.float32)[:, :, None], num_ways, axis=2)
    arrived = np.zeros(switch.shape, bool)
    docking = np.array([arrays.squared_goal_radius, arrays.squared_goal_speed])
    rules = DriveRules(arrays.time_step, docking, arrays.docks, NEAR_VIA)
    for model, robots in _by_model(problem):
        # One lane for every robot and way.
        lanes_x, lanes_u = (array[:, robots].reshape(len(array), -1, array.shape[-1]) for array in (x, u))
        limits, goals = (np.repeat(rows[robots], num_ways, axis=0) for rows in (arrays.limits, problem.goal))
        targets = np.ascontiguousarray(vias[robots], np.float32).reshape(goals.shape)
        lanes_arrived = np.empty(len(goals), bool)
        ways = DrivenWays(limits, goals, targets, switch[robots].ravel())
        drive_kernel(model.name)(rules, ways, lanes_x, lanes_u, lanes_arrived)
        x[:, robots] = lanes_x.reshape(len(x), len(robots), num_ways, -1)
        u[:, robots] = lanes_u.reshape(len(u), len(robots), num_ways, -1)
        arrived[robots] = lanes_arrived.reshape(len(robots), num_ways)
    return Drives(u, x[..., : problem.dimension], arrived)
