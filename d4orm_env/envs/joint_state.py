"""The joint state as one vector: what ``env.state()`` returns and how to read it.

The vector is the concatenation, in this order, of

====================  ==========  =====================================================================
Part                  Size        Meaning
====================  ==========  =====================================================================
states                ``K * n``   states of the robots, row by row, padded with zeros
goals                 ``K * d``   present goal positions [m]
controls              ``K * m``   controls executed in the last step; zero after a reset
arrived               ``K``       1 for a robot that has docked, else 0
steps                 1           steps taken since the reset
bodies                ``N * b``   position, velocity and radius of bodies that move among the robots and are none
====================  ==========  =====================================================================

with ``b = 2 d + 1``. Bodies there are only under a disturbance that brings them, such as
:class:`~d4orm_env.disturbances.Intruder`; one that is not seen is all zeros. With disturbances of what is seen states,
controls and bodies are those seen.

Together with the problem that is all there is to know about an episode's present, so a planner can go on from it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, BoolArray, FloatArray, Floats, frozen_array, short_repr
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_env.core.winding import MAX_ANGLE
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED

__all__ = ["JointState", "join_state", "split_state"]


class JointState(NamedTuple):
    """A joint state, taken apart."""

    states: FloatArray  #: ``(K, n)`` states of the robots
    goals: FloatArray  #: ``(K, d)`` present goals [m]
    controls: FloatArray  #: ``(K, m)`` controls executed in the last step
    arrived: BoolArray  #: ``(K,)`` bool, docked robots
    steps: int  #: Steps taken since the reset
    #: ``(N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is none
    bodies: FloatArray = frozen_array((), "bodies", (0,))


def join_state(joint: JointState) -> FloatArray:
    """The float32 vector of a joint state, freshly allocated."""
    flags_and_steps = np.array([*joint.arrived, joint.steps], np.float32)
    parts = (joint.states, joint.goals, joint.controls, flags_and_steps, joint.bodies)
    return np.concatenate([part.ravel() for part in parts])


def split_state(problem: Problem, state: ArrayLike) -> JointState:
    """Take the vector that ``env.state()`` returned apart.

    Args:
        problem: The problem of the environment, ``env.unwrapped.problem``.
        state: ``(K * (n + d + m + 1) + 1 + N * (2 d + 1),)`` the vector.

    Returns:
        The parts, as copies.

    Raises:
        ValueError: If it is no vector of finite numbers, or its length does not fit the problem.
    """
    check_is_problem(problem)
    try:
        vector = np.array(state, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"state is {short_repr(state)}; give the vector that env.state() returns") from None
    if vector.ndim == 1 and not (finite := np.isfinite(vector)).all():
        entry = finite.argmin()
        raise ValueError(f"state[{entry}] is {vector[entry]}; every value must be finite, as env.state() returns them")
    team_size = problem.num_robots
    widths = (problem.state_size, problem.dimension, problem.control_size, 1)
    expected, body = team_size * sum(widths) + 1, 2 * problem.dimension + 1
    if vector.ndim != 1 or not _fits(vector[expected - team_size - 1 :], team_size, body):
        raise ValueError(
            f"state has shape {vector.shape}; a state of this problem has shape ({expected},), and {body} more for "
            "every body that is no robot"
        )
    ends = np.cumsum([*(team_size * width for width in widths), 1])
    states, goals, controls, arrived, steps, bodies = np.split(vector, ends)
    return JointState(
        states.reshape(team_size, widths[0]),
        goals.reshape(team_size, widths[1]),
        controls.reshape(team_size, widths[2]),
        arrived > 0.5,
        round(float(steps[0])),
        bodies.reshape(-1, body),
    )


def _fits(rest: FloatArray, team_size: int, body: int) -> bool:
    """Check whether the end of a state vector is that of such a team: flags, steps, bodies of ``body`` numbers."""
    flags, steps, bodies = rest[:team_size], rest[team_size : team_size + 1], rest[team_size + 1 :]
    if len(steps) == 0 or len(bodies) % body:
        return False
    # A longer vector might be one of another problem.
    plausible = np.isin(flags, (0, 1)).all() and steps[0] >= 0 and (bodies.reshape(-1, body)[:, -1] >= 0).all()
    return len(bodies) == 0 or bool(plausible)


def state_bounds(
    problem: Problem, positions: FloatArray, max_cycles: int, slack: BoundsSlack, num_bodies: int
) -> tuple[FloatArray, FloatArray]:
    """Finite bounds that every joint state of an episode keeps: the lowest and the highest vector.

    A robot gets no farther from its start, in the box ``positions`` ``(2, d)`` [m], than its limits and the slack allow
    in ``max_cycles`` steps, and angles do not wind up.
    """
    low, high = _robot_bounds(problem, positions, max_cycles * problem.dt, slack)
    limits = problem.team.control_limits
    controls = np.where(limits > 0, limits, 1.0).ravel()
    lowest = np.concatenate([low.ravel(), np.tile(positions[0], problem.num_robots), -controls])
    highest = np.concatenate([high.ravel(), np.tile(positions[1], problem.num_robots), controls])
    lowest, highest = lowest - 1e-3 * (1 + np.abs(lowest)), highest + 1e-3 * (1 + np.abs(highest))
    flags = np.ones(problem.num_robots)
    # An unseen body is all zeros, and its like may be anywhere round the team.
    far = np.abs(positions).max() + 2 * np.linalg.norm(np.ptp(positions, axis=0)) + slack.distance + 1.0
    fastest = float(problem.team.max_speed.max()) + slack.speed
    d = problem.dimension
    body = np.tile([far] * d + [fastest] * d + [max(slack.radius, 1.0)], num_bodies)
    nearest = np.tile([-far] * d + [-fastest] * d + [0.0], num_bodies)
    return (
        np.concatenate([lowest, 0 * flags, [0], nearest]).astype(np.float32),
        np.concatenate([highest, flags, [max_cycles], body]).astype(np.float32),
    )


def _robot_bounds(
    problem: Problem, positions: FloatArray, duration: float, slack: BoundsSlack
) -> tuple[Floats, Floats]:
    """``(K, n)`` lowest and highest states within that time [s]."""
    team, dimension = problem.team, problem.dimension
    limits = team.limits.astype(np.float64)
    speed, acceleration = limits[:, SPEED], limits[:, ACCELERATION]
    # Within a step a robot may exceed the speed limit, which is applied at its end.
    travel = (speed + acceleration * problem.dt / 2 + slack.drift) * duration + slack.distance
    high = np.ones((problem.num_robots, problem.state_size))
    for robot, model in enumerate(team.robot_models):
        high[robot, dimension : model.state_size] = LARGEST  # what no limit bounds
        high[robot, list(model.speed_indices)] = speed[robot] + slack.speed
        high[robot, list(model.angles)] = MAX_ANGLE + slack.heading
        for index, column in model.state_limits:
            high[robot, index] = limits[robot, column]
    low = -high
    low[:, :dimension] = positions[0] - travel[:, None]
    high[:, :dimension] = positions[1] + travel[:, None]
    return low, high
