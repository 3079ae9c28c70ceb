"""Coming to rest: primitives begin there, and a team that moves brakes before its manoeuvres."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.engine.types import Engine
from d4orm_planners.tracking.steering import advanced, limit_controls, rates

NEARLY = 2.0**-16
"""Largest part of what controls change in a step, at full, up to which a speed or an angle of wheels counts as zero."""


def first_inert(model: Model) -> int:
    """Number of the first state component beyond position and heading."""
    return model.dimension if model.heading_index is None else model.heading_index + 1


def motion(problem: Problem, states: FloatArray) -> FloatArray:
    """``(K, n)`` what of states is zero at rest, neither pose nor hitch angle: speeds, turn rates, wheels' angles."""
    moving = np.zeros_like(states)
    for robot, model in enumerate(problem.team.robot_models):
        if not model.trailers:  # these need not be in line
            first = first_inert(model)
            moving[robot, first:] = states[robot, first:]
    return moving


def can_brake(problem: Problem) -> bool:
    """Check whether all that moves is changed by a control each: not a speed that only its acceleration changes."""
    return not (motion(problem, problem.start).astype(bool) & ~_gains(problem).any(axis=2)).any()


def come_to_rest(problem: Problem, engine: Engine) -> tuple[FloatArray, Problem] | None:
    """Controls ``(T, K, m)`` that bring all to rest as soon as can be, and the problem from there.

    ``None`` if somebody would come too near to something before, or no time were left.
    """
    braking = np.zeros((0, problem.num_robots, problem.control_size), np.float32)
    if not motion(problem, problem.start).any():
        return braking, problem
    states, gains = problem.start, _gains(problem)
    change = NEARLY * problem.dt * np.abs(problem.team.control_bounds).min(axis=0)
    while (np.abs(moving := motion(problem, states)) > (np.abs(gains) * change[:, None]).sum(axis=2)).any():
        if len(braking) == problem.horizon - 1:
            return None
        controls = limit_controls(problem, -(gains * moving[:, :, None]).sum(axis=1) / np.float32(problem.dt))
        states, braking = advanced(problem, states, controls), np.concatenate([braking, controls[None]])
    if len(braking):
        trajectory = engine.rollout(problem.with_state(problem.start, problem.goal, horizon=len(braking)), braking)
        if trajectory.margin_violated.any():
            return None
        states, braking = trajectory.states[-1], trajectory.controls
    states = states - motion(problem, states)
    return braking, problem.with_state(states, problem.goal, horizon=problem.horizon - len(braking))


def _gains(problem: Problem) -> FloatArray:
    """``(K, n, m)`` rates of the states by controls of one."""
    still = np.zeros((problem.num_robots, problem.control_size), np.float32)
    coasting, ones = rates(problem, problem.start, still), np.eye(problem.control_size, dtype=np.float32)
    return np.stack([rates(problem, problem.start, still + one) - coasting for one in ones], axis=2)
