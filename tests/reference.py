"""Samples rolled out and scored in float64 with plain NumPy, and how far each stays from every yes or no.

Float32 engines round, each in its own way, and a rollout has thousands of comparisons with a threshold: within the
margin or not, at the goal or not. A sample in which one of them is closer to its threshold than rounding may move it
can fall either way, and then its reward differs by a whole penalty. The reference says how close the closest was, so
that a comparison can leave such samples out, whatever the processor.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, TURN_RATE
from d4orm_planners.engine.sampling_types import SamplingTask

ROUNDOFF = 2.0**-24
"""Relative error of one float32 operation."""

ROUNDINGS = 16
"""Operations between a state and the next, at most, each with a rounding of its own."""


class Evaluated(NamedTuple):
    """``M`` samples of ``K`` robots.

    Attributes:
        rewards: ``(K, M)`` mean rewards over time.
        doubt: ``(M,)`` how near the nearest of all decisions was to falling the other way [m, or m/s for the speed at
            the goal].
        inverse_distance: ``(K,)`` what a metre further from the goal costs.
    """

    rewards: np.ndarray
    doubt: np.ndarray
    inverse_distance: np.ndarray


def evaluate(task: SamplingTask, controls: np.ndarray) -> Evaluated:
    """Roll out ``controls`` ``(M, H, K, m)`` and score them as the task says."""
    problem = task.problem
    num_samples, d = len(controls), problem.dimension
    states = np.repeat(problem.start[None].astype(np.float64), num_samples, axis=0)
    arrived = np.zeros(problem.num_robots, bool) if task.arrived is None else task.arrived
    arrived = np.repeat(np.asarray(arrived)[None], num_samples, axis=0)
    reference = np.linalg.norm(problem.goal - problem.start[:, :d].astype(np.float64), axis=1)
    inverse = 1 / np.maximum(reference, max(problem.goal_radius, task.reference_distance or 0))
    total, doubt = np.zeros((num_samples, problem.num_robots)), np.full(num_samples, np.inf)
    for t in range(controls.shape[1]):
        states, short = _step(problem, states, arrived, controls[:, t].astype(np.float64))
        position = states[..., :d]
        gaps = _gaps_to_robots(task, position, t), problem.world.clearance(position) - problem.team.radius
        beyond = [gap - problem.margin for gap in gaps]
        total += 1 - inverse * np.linalg.norm(problem.goal - position, axis=-1)
        total -= task.penalty * problem.collision_penalty * sum((gap <= 0).astype(float) for gap in beyond)
        doubt = np.minimum(doubt, np.abs(np.stack([short, *beyond])).min(axis=(0, 2)))
    return Evaluated(total.T / controls.shape[1], doubt, inverse)


def position_error(task: SamplingTask, controls: np.ndarray, control_error: float = 0.0) -> float:
    """How far a float32 rollout of ``controls`` may be from this one [m], if the controls are as exact as said.

    An error in a robot's place stays. One in its velocity ``V`` or, times ``V``, in its heading adds up over the time
    that is left, and one in an acceleration twice. Every quantity is rounded ``ROUNDINGS`` times a step, relative to
    its largest value. Roundings point either way, so that ``n`` of them amount to ``sqrt(n)`` rather than to ``n``, but
    for a factor that is hardly ever reached; three of these standard deviations are taken.
    """
    problem = task.problem
    limits, time = problem.team.limits, problem.horizon * problem.dt
    speed, turning = float(limits[:, SPEED].max()), time * float(limits[:, TURN_RATE].max())
    reach = float(np.abs(problem.start[:, : problem.dimension]).max()) + speed * time
    roundings = 3 * np.sqrt(ROUNDINGS * problem.horizon) * ROUNDOFF
    return float(roundings * (reach + time * speed * (1 + turning)) + control_error * time * max(time, 1))


def _step(problem: Any, states: Any, arrived: Any, controls: Any) -> tuple[Any, Any]:
    """States ``(M, K, n)`` after a step, and ``(M, K)`` how far each robot is from docking; ``arrived`` is updated."""
    states, short = states.copy(), np.full(arrived.shape, np.inf)
    docking_speed = problem.goal_speed + problem.team.max_speed / 2**13
    for k, name in enumerate(problem.team.models):
        after, speed = _MOVES[name](states[:, k], controls[:, k], problem.team.limits[k].astype(np.float64), problem.dt)
        gap = np.linalg.norm(after[:, : problem.dimension] - problem.goal[k], axis=1)
        moving = ~arrived[:, k]
        states[moving, k] = after[moving]
        # Docking needs both to be small, so the larger one decides.
        short[moving, k] = np.maximum(gap - problem.goal_radius, speed - docking_speed[k])[moving]
        arrived[:, k] |= short[:, k] <= 0
        at_rest = _at_rest(name, states[:, k])
        states[arrived[:, k], k] = at_rest[arrived[:, k]]
    return states, short


def _within(vector: Any, limit: float) -> Any:
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    return vector * np.minimum(1, limit / np.maximum(length, 1e-300))


def _double_integrator(x: Any, u: Any, limits: Any, dt: float, d: int) -> tuple[Any, Any]:
    position, velocity, push = x[:, :d], x[:, d : 2 * d], _within(u[:, :d], limits[ACCELERATION])
    after = _within(velocity + dt * push, limits[SPEED])
    rest = x[:, 2 * d :]
    return np.hstack([position + dt * velocity + dt**2 / 2 * push, after, rest]), np.linalg.norm(after, axis=1)


def _single_integrator(x: Any, u: Any, limits: Any, dt: float) -> tuple[Any, Any]:
    velocity = _within(u[:, :2], limits[SPEED])
    return np.hstack([x[:, :2] + dt * velocity, x[:, 2:]]), np.linalg.norm(velocity, axis=1)


def _differential_drive(x: Any, u: Any, limits: Any, dt: float) -> tuple[Any, Any]:
    """Heading and speed change evenly within a step, so that RK4 is Simpson's rule for the place."""
    turn = np.clip(u[:, 0], -limits[TURN_RATE], limits[TURN_RATE])
    push = np.clip(u[:, 1], -limits[ACCELERATION], limits[ACCELERATION])

    def velocity(time: float) -> Any:
        heading, speed = x[:, 2] + time * turn, x[:, 3] + time * push
        return speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)

    position = x[:, :2] + dt / 6 * (velocity(0) + 4 * velocity(dt / 2) + velocity(dt))
    speed = np.clip(x[:, 3] + dt * push, -limits[SPEED], limits[SPEED])
    return np.column_stack([position, x[:, 2] + dt * turn, speed]), np.abs(speed)


_MOVES = {
    "holonomic2d": lambda x, u, limits, dt: _double_integrator(x, u, limits, dt, 2),
    "holonomic3d": lambda x, u, limits, dt: _double_integrator(x, u, limits, dt, 3),
    "velocity2d": _single_integrator,
    "differential_drive": _differential_drive,
}
_SPEEDS = {"holonomic2d": [2, 3], "holonomic3d": [3, 4, 5], "velocity2d": [], "differential_drive": [3]}


def _at_rest(name: str, states: Any) -> Any:
    states = states.copy()
    states[:, _SPEEDS[name]] = 0
    return states


def _gaps_to_robots(task: SamplingTask, position: Any, time: int) -> Any:
    """``(M, K)`` from every robot's surface to the nearest other robot's or moving body's."""
    nearest = np.full(position.shape[:2], np.inf)
    if not task.collisions:
        return nearest
    radius = np.asarray(task.problem.team.radius, np.float64)
    gaps = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) - radius[:, None] - radius
    gaps[:, range(len(radius)), range(len(radius))] = np.inf
    nearest = gaps.min(axis=2)
    if task.moving is not None:
        bodies = task.moving.positions[time].astype(np.float64)
        gaps = np.linalg.norm(position[:, :, None] - bodies, axis=-1) - radius[:, None] - task.moving.radius
        nearest = np.minimum(nearest, gaps.min(axis=2))
    return nearest
