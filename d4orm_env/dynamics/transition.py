"""One time step of one robot, in scalar style: clip, integrate, limit the speed, dock, and the reward.

The order is the definition of a step for every engine: the control is clipped to the limits, RK4 integrates the model
over ``dt``, the speed limit is applied, and a robot within its goal radius at no more than the goal speed, at its goal
heading where it has one, has arrived.
From then on it is at rest where it docked (paper, section III; docking as in the paper's reference code), unless the
problem says that a robot may be moved again: then it has arrived for as long as it is there.
"""

from __future__ import annotations

from d4orm_env.dynamics.robot_model import Flag, ModelFunctions, N, Number, Ops, TimeStep, Truth

__all__ = ["TimeStep", "advance", "arrives", "step_reward"]

SPEED_ALLOWANCE = 2**-13
"""Share of the speed limit by which a robot may exceed its goal speed: many come down to just that and a rounding."""


def advance(
    model: ModelFunctions, x: tuple[N, ...], u: tuple[N, ...], limits: tuple[N, ...], h: TimeStep, ops: Ops
) -> tuple[N, ...]:
    """The state after one step under a control that :meth:`ModelFunctions.limit_control` has clipped."""
    return model.limit_state(model.integrate(x, u, limits, h, ops), limits, ops)


def arrives(
    squared_distance: Number, squared_speed: Number, squared_goal_radius: Number, squared_goal_speed: Number
) -> Flag:
    """Check whether a robot at this distance from its goal, at this speed, arrives there."""
    return (squared_distance <= squared_goal_radius) & (squared_speed <= squared_goal_speed)


def faces(cosine: Number, sine: Number, goal_cosine: Number, goal_sine: Number, squared_chord: Number) -> Flag:
    """Check whether a heading differs from the goal's, both as unit vectors, by no more than this chord."""
    gap_x, gap_y = cosine - goal_cosine, sine - goal_sine
    return gap_x * gap_x + gap_y * gap_y <= squared_chord


def docking_speed(goal_speed: N, max_speed: N) -> N:
    """Speed up to which a robot docks: its goal speed, and what rounding makes of that."""
    return goal_speed + max_speed * SPEED_ALLOWANCE


def absorbed(arrived: Truth, docks: Truth) -> Flag:
    """Check whether a robot that has arrived stays at rest, whatever its control; ``docks`` says whether any does."""
    return arrived & docks


def step_reward(distance: N, inverse_initial_distance: N, violations: tuple[N, N, N], penalty: N, one: N) -> N:
    """``1 - distance / initial distance``, minus a penalty for each kind of body within the margin (paper, section
    III-D, with the obstacle term of section IV).

    ``violations`` are 0 or 1 for any robot, for any obstacle or the bounds, and for any dynamic obstacle; ``penalty``
    is 1 in the paper, and ``one`` is 1, all in the caller's precision.
    """
    robot, obstacle, dynamic = violations
    progress = one - distance * inverse_initial_distance
    return progress - penalty * robot - penalty * obstacle - penalty * dynamic
