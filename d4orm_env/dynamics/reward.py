"""The reward of one robot at one step, in scalar style (paper, section III-D, with the obstacle term of section IV)."""

from __future__ import annotations

from d4orm_env.dynamics.robot_model import N


def step_reward(distance: N, inverse_initial_distance: N, violations: tuple[N, N, N], penalty: N, one: N) -> N:
    """``1 - distance / initial distance``, minus a penalty for each kind of body within the margin.

    ``violations`` are 0 or 1 for any robot, for any obstacle or the bounds, and for any dynamic obstacle; ``penalty``
    is 1 in the paper, and ``one`` is 1, all in the caller's precision.
    """
    robot, obstacle, dynamic = violations
    progress = one - distance * inverse_initial_distance
    return progress - penalty * robot - penalty * obstacle - penalty * dynamic
